"""Depth as colored points in space: from depth itself (never a picture of it) and the camera's true intrinsics."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from saunet.errors import ConfigError, in_range, positive
from saunet.io.atomic import write_bytes
from saunet.prediction.prediction import Prediction


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud:
    """Points in the camera's frame: x right, y down, z forward, in the unit of the depth they come from."""

    points: Float32[np.ndarray, "n 3"]
    colors: UInt8[np.ndarray, "n 3"]
    unit: str
    """What one unit of ``points`` is; written into the files."""


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """A pinhole camera's intrinsics and the image size that they belong to.

    Args:
        K: 3 x 3, in pixels (integer coordinates are pixel centers).
        height: Height of the images that K belongs to.
        width: Width of the images that K belongs to.

    Raises:
        ConfigError: if K cannot be a camera's.
    """

    K: Float[np.ndarray, "3 3"]
    height: int
    width: int

    def __post_init__(self) -> None:
        K = self.K
        plausible = np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0 and np.allclose(K[2], (0, 0, 1))
        if not plausible or not (-self.width < K[0, 2] < 2 * self.width and -self.height < K[1, 2] < 2 * self.height):
            raise ConfigError(
                f"intrinsics {np.array2string(K, precision=1, separator=',').replace(chr(10), '')} cannot belong to "
                f"{self.width}x{self.height} pixels; needed: [[fx,0,cx],[0,fy,cy],[0,0,1]] in pixels of that size"
            )

    @classmethod
    def from_numbers(cls, numbers: Sequence[float | int], height: int, width: int) -> Camera:
        """Read ``fx, fy, cx, cy``, the nine numbers of K by rows, or one: the horizontal field of view in degrees."""
        values = [float(number) for number in numbers]
        if len(values) == 1:
            return cls.from_field_of_view(values[0], height, width)
        if len(values) == 4:
            fx, fy, cx, cy = values
            values = [fx, 0, cx, 0, fy, cy, 0, 0, 1]
        if len(values) != 9:
            raise ConfigError(
                f"intrinsics have {len(values)} numbers; needed: fx, fy, cx, cy, "
                "or the nine of K, or one: a horizontal field of view in degrees"
            )
        return cls(np.array(values).reshape(3, 3), height, width)

    @classmethod
    def from_field_of_view(cls, degrees: float, height: int, width: int) -> Camera:
        """Assume square pixels, a centered axis and this horizontal field of view: a guess, for want of calibration."""
        in_range("field of view", degrees, 1.0, 179.0)
        focal = width / (2 * np.tan(np.radians(degrees) / 2))
        return cls.from_numbers((focal, focal, (width - 1) / 2, (height - 1) / 2), height, width)

    def resized(self, height: int, width: int) -> Camera:
        """Return the camera of the same picture at another size."""
        y, x = height / self.height, width / self.width
        K = self.K.astype(np.float64)
        K[0, :2] *= x
        K[1, :2] *= y
        K[0, 2] = (self.K[0, 2] + 0.5) * x - 0.5  # as geometry.camera.scale_intrinsics, which needs torch
        K[1, 2] = (self.K[1, 2] + 0.5) * y - 0.5
        return Camera(K, height, width)


def point_cloud(
    prediction: Prediction, camera: Camera, *, max_depth: float | int | None = None, stride: int = 1, edge: float = 0.1
) -> PointCloud:
    """Return a prediction's pixels as points in space, colored by the image.

    Left out are those farther than ``max_depth``, in the unit of depth, and those around which depth changes by more
    than the fraction ``edge``: they would float between near and far surfaces.
    """
    positive("stride", stride)
    positive("edge", edge, allow_zero=True)
    depth = prediction.depth
    camera = camera.resized(*depth.shape)
    keep = np.isfinite(depth) & (depth > 0)
    if max_depth is not None:
        keep &= depth <= positive("max_depth", max_depth)
    if edge:
        keep &= ~jumps(prediction.disparity, edge)
    rows, columns = np.nonzero(keep[::stride, ::stride])
    rows, columns = rows * stride, columns * stride
    z = depth[rows, columns].astype(np.float64)
    pixels = np.stack([columns, rows, np.ones_like(rows)]).astype(np.float64)
    points = (np.linalg.inv(camera.K) @ pixels * z).T.astype(np.float32)
    return PointCloud(np.ascontiguousarray(points), prediction.image[rows, columns], prediction.unit)


def write_ply(path: str | Path, cloud: PointCloud) -> None:
    """Write a binary PLY file, whole or not at all; MeshLab, CloudCompare and Open3D read it."""
    path = Path(path)
    if path.suffix.lower() != ".ply":
        raise ConfigError(f"the point cloud {path} must end in .ply")
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        "comment saunet: camera frame, x right, y down, z forward\n"
        f"comment unit: {cloud.unit}\n"
        f"element vertex {len(cloud.points)}\n"
        + "".join(f"property float {axis}\n" for axis in "xyz")
        + "".join(f"property uchar {color}\n" for color in ("red", "green", "blue"))
        + "end_header\n"
    )
    vertices = np.empty(len(cloud.points), dtype=[("xyz", "<f4", 3), ("rgb", "u1", 3)])
    vertices["xyz"], vertices["rgb"] = cloud.points, cloud.colors
    buffer = io.BytesIO()
    buffer.write(header.encode("ascii", "replace"))
    buffer.write(vertices.tobytes())
    write_bytes(path, buffer.getvalue())


def jumps(disparity: Float32[np.ndarray, "h w"], share: float) -> Bool[np.ndarray, "h w"]:
    """Return the pixels around which disparity, and so depth, changes by more than ``share``."""
    square = np.ones((3, 3), np.uint8)
    return np.asarray(cv2.dilate(disparity, square) > (1 + share) * cv2.erode(disparity, square))
