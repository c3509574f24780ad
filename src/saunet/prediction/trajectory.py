"""Where the camera went, written as KITTI poses and drawn from above."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

from saunet.io.images import write_image
from saunet.io.trajectories import write_kitti

_PAPER, _GRID, _INK, _TRACK, _START, _END = (
    (250, 250, 250), (222, 222, 222), (60, 60, 60), (31, 90, 180), (40, 140, 60), (200, 60, 40),
)  # fmt: skip


def write_trajectory(picture: Path, T_world_cam: Float64[np.ndarray, "n 4 4"], metric: bool) -> None:
    """Write a trajectory twice: drawn from above, and beside it as KITTI poses, whose name ends in ``.txt``."""
    write_kitti(picture.with_suffix(".txt"), T_world_cam)
    write_image(picture, draw_from_above(T_world_cam, metric))


def draw_from_above(
    T_world_cam: Float64[np.ndarray, "n 4 4"], metric: bool, size: int = 800
) -> UInt8[np.ndarray, "{size} {size} 3"]:
    """Draw where the camera went, seen from above: x to the right, z (ahead at the start) up, both at one scale."""
    x, z = T_world_cam[:, 0, 3], T_world_cam[:, 2, 3]
    extent = max(float(np.ptp(x)), float(np.ptp(z)), 1e-9) * 1.15
    margin, top = size // 16, size // 10
    zoom = (size - margin - top) / extent
    middle = (float(x.max() + x.min()) / 2, float(z.max() + z.min()) / 2)
    center = (size / 2, top + (size - margin - top) / 2)
    pixels = np.stack([center[0] + (x - middle[0]) * zoom, center[1] - (z - middle[1]) * zoom], axis=-1)
    canvas = np.full((size, size, 3), _PAPER, np.uint8)
    step = _round_step(extent / 5)
    for axis in (0, 1):
        first = middle[axis] - size / zoom
        for index in range(math.ceil(first / step), math.floor((middle[axis] + size / zoom) / step) + 1):
            at = round(center[axis] + (index * step - middle[axis]) * zoom * (1 if axis == 0 else -1))
            ends = ((at, 0), (at, size)) if axis == 0 else ((0, at), (size, at))
            cv2.line(canvas, *ends, _GRID, 1)
    points = np.round(pixels * 16).astype(np.int32)
    cv2.polylines(canvas, [points[:, None]], False, _TRACK, 2, cv2.LINE_AA, 4)
    for index, color in ((0, _START), (-1, _END)):
        cv2.circle(canvas, (int(points[index, 0]), int(points[index, 1])), 6 * 16, color, -1, cv2.LINE_AA, 4)
    length = float(np.linalg.norm(np.diff(T_world_cam[:, :3, 3], axis=0), axis=1).sum())
    unit = "m" if metric else "relative units"
    canvas[: top - 8] = _PAPER
    for row, text in enumerate(
        (f"{len(x)} frames, {length:.4g} {unit} along the path; a square is {step:g} {unit}",
         "from above; green: start, looking up; red: end")
    ):  # fmt: skip
        cv2.putText(canvas, text, (14, 26 + 24 * row), cv2.FONT_HERSHEY_SIMPLEX, 0.55, _INK, 1, cv2.LINE_AA)
    return canvas


def _round_step(value: float) -> float:
    """Return 1, 2 or 5 times a power of ten, the largest that is not above ``value``."""
    power = 10.0 ** math.floor(math.log10(value))
    return max(factor * power for factor in (1, 2, 5) if factor * power <= value * (1 + 1e-9))
