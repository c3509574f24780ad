"""Where the camera went: a pose network's motions chained over a clip, as KITTI poses and drawn from above."""

from __future__ import annotations

import math
from collections import deque
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float64, UInt8
from torch import Tensor, nn

from saunet.checks import CheckpointError, ConfigError, DataError
from saunet.images import network_input, write_image
from saunet.infer.folder import read_model
from saunet.metrics.odometry import chain_motions
from saunet.record import Scale
from saunet.trajectories import write_kitti

_PAPER, _GRID, _INK, _TRACK, _START, _END = (
    (250, 250, 250), (222, 222, 222), (60, 60, 60), (31, 90, 180), (40, 140, 60), (200, 60, 40),
)  # fmt: skip


class Odometer:
    """Follows the camera through a clip, frame by frame; memory does not grow but by one pose a frame.

    Args:
        pose: A pose network.
        height: Height of its input in pixels.
        width: Width of its input in pixels.
        scale: Factor to metres; None leaves the trajectory in the unknown unit of the depth.
        device: Where to run.

    Raises:
        ConfigError: if the network was not trained on neighbouring frames.
    """

    def __init__(
        self, pose: nn.Module, height: int, width: int, scale: Scale | None = None, device: str | torch.device = "cpu"
    ) -> None:
        self._offsets: tuple[int, ...] = tuple(pose.offsets)  # type: ignore[arg-type]
        if not {-1, 1} & set(self._offsets):
            raise ConfigError(
                f"the pose network was trained on frames at offsets {list(self._offsets)}; a trajectory needs 1 or -1"
            )
        self._pose, self._size, self.scale = pose.to(device).eval(), (height, width), scale
        self._device = torch.device(device)
        self._motions: dict[int, Float64[np.ndarray, "4 4"]] = {}  # frame i -> T_next_cam
        reach = max(abs(offset) for offset in self._offsets)
        self._recent: deque[Tensor] = deque(maxlen=2 * reach + 1)
        self._reach, self._count, self._done = reach, 0, 0

    @classmethod
    def from_model(cls, path: str | Path, scale: Scale | None = None, device: str = "cpu") -> Odometer:
        """Load the pose network of a checkpoint or exported folder; nothing in it is run.

        Raises:
            ConfigError: if it has none, or the network was not trained on neighbouring frames.
            CheckpointError: if it cannot be read.
        """
        if Path(path).suffix.lower() == ".onnx":
            raise ConfigError(f"{path} has no pose network, which a trajectory needs; give the checkpoint")
        model = read_model(path)
        pose = model.networks()[1]
        if pose is None:
            raise ConfigError(f"{path} has no pose network, which a trajectory needs; leave 'trajectory' out")
        return cls(pose, model.record.height, model.record.width, scale or model.record.scale, device)

    def add(self, image: UInt8[np.ndarray, "h w 3"]) -> None:
        """Take the next frame."""
        self._recent.append(torch.from_numpy(network_input(image, *self._size)).to(self._device))
        self._count += 1
        if self._count - 1 - self._reach >= self._done:
            self._estimate(self._done)
            self._done += 1

    def trajectory(self) -> Float64[np.ndarray, "n 4 4"]:
        """Return the camera-to-world pose of every frame so far; the world is the first camera.

        Raises:
            DataError: if there are too few frames.
            CheckpointError: if the network's output is not finite.
        """
        for centre in range(self._done, self._count):
            self._estimate(centre)
        self._done = max(self._done, self._count)
        missing = [index for index in range(self._count - 1) if index not in self._motions]
        if missing or self._count < 2:
            needed = 3 if {-1, 1} <= set(self._offsets) else 2
            raise DataError(f"a trajectory needs at least {needed} frames, got {self._count}")
        motions = np.stack([self._motions[index] for index in range(self._count - 1)])
        if not np.isfinite(motions).all():
            raise CheckpointError("the pose network's output is not finite; the weights are damaged")
        motions[:, :3, 3] *= self.scale.factor if self.scale else 1.0
        return chain_motions(motions)

    def _estimate(self, centre: int) -> None:
        """Ask for the motions around a frame, where both its neighbours exist; farther sources stop at the borders."""
        last = self._count - 1
        near = [centre + offset for offset in self._offsets if abs(offset) == 1]
        if not all(0 <= index <= last for index in near):
            return
        first = self._count - len(self._recent)
        frames = [min(max(centre + offset, 0), last) - first for offset in self._offsets]
        with torch.inference_mode():
            sources = torch.stack([self._recent[index] for index in frames])
            T_src_tgt = self._pose(self._recent[centre - first][None], sources[None])[0].tolist()
        # as Python numbers: an array of torch's would hold on to its memory for the whole clip
        for offset, T in zip(self._offsets, np.array(T_src_tgt, dtype=np.float64), strict=True):
            if offset == 1:
                self._motions[centre] = T
            elif offset == -1:
                self._motions.setdefault(centre - 1, np.linalg.inv(T))


def write_trajectory(picture: Path, T_world_cam: Float64[np.ndarray, "n 4 4"], metric: bool) -> None:
    """Write a trajectory twice: drawn from above, and beside it as KITTI poses, whose name ends in ``.txt``.

    Raises:
        DataError: if the system refuses to write.
    """
    write_kitti(picture.with_suffix(".txt"), T_world_cam)
    write_image(picture, draw_from_above(T_world_cam, metric))


def draw_from_above(
    T_world_cam: Float64[np.ndarray, "n 4 4"], metric: bool, size: int = 800
) -> UInt8[np.ndarray, "{size} {size} 3"]:
    """Draw where the camera went, seen from above: x to the right, z (ahead at the start) up, both at one scale.

    Args:
        T_world_cam: Camera-to-world poses.
        metric: Whether positions are metres.
        size: Side of the picture in pixels.
    """
    x, z = T_world_cam[:, 0, 3], T_world_cam[:, 2, 3]
    extent = max(float(np.ptp(x)), float(np.ptp(z)), 1e-9) * 1.15
    margin, top = size // 16, size // 10
    zoom = (size - margin - top) / extent
    middle = (float(x.max() + x.min()) / 2, float(z.max() + z.min()) / 2)
    centre = (size / 2, top + (size - margin - top) / 2)
    pixels = np.stack([centre[0] + (x - middle[0]) * zoom, centre[1] - (z - middle[1]) * zoom], axis=-1)
    canvas = np.full((size, size, 3), _PAPER, np.uint8)
    step = _round_step(extent / 5)
    for axis in (0, 1):
        first = middle[axis] - size / zoom
        for index in range(math.ceil(first / step), math.floor((middle[axis] + size / zoom) / step) + 1):
            at = round(centre[axis] + (index * step - middle[axis]) * zoom * (1 if axis == 0 else -1))
            ends = ((at, 0), (at, size)) if axis == 0 else ((0, at), (size, at))
            cv2.line(canvas, *ends, _GRID, 1)
    points = np.round(pixels * 16).astype(np.int32)
    cv2.polylines(canvas, [points[:, None]], False, _TRACK, 2, cv2.LINE_AA, 4)
    for index, colour in ((0, _START), (-1, _END)):
        cv2.circle(canvas, (int(points[index, 0]), int(points[index, 1])), 6 * 16, colour, -1, cv2.LINE_AA, 4)
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
