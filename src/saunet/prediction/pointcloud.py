"""Depth as colored points in space, from the camera's true intrinsics: as PLY, and as an interactive page."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from saunet.errors import ConfigError, DataError, in_range, positive
from saunet.io.atomic import Session, replacing, write_bytes
from saunet.io.images import encode_jpeg, resize
from saunet.prediction.prediction import Prediction

_PAGE = Path(__file__).with_name("viewer.html")
_RAMP = 1 / 160
"""Half the width of the ramp that a depth edge becomes, in widths of the picture."""
_ENDS = 0.7
"""Change of disparity within it over that within twice as much, above which it is a ramp: a plane has 0.5, a step 1."""


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud:
    """Points in the camera's frame: x right, y down, z forward, in the unit of the depth they come from."""

    points: Float32[np.ndarray, "n 3"]
    colors: UInt8[np.ndarray, "n 3"]
    unit: str

    def __repr__(self) -> str:
        return f"PointCloud({len(self.points)} points, {self.unit.partition(' (')[0]})"

    def save(self, path: str | Path) -> None:
        """Write a binary PLY file, whole or not at all; MeshLab, CloudCompare and Open3D read it."""
        if Path(path).suffix.lower() != ".ply":
            raise ConfigError(f"the point cloud {path} must end in .ply")
        header = (
            "ply\nformat binary_little_endian 1.0\n"
            "comment saunet: camera frame, x right, y down, z forward\n"
            f"comment unit: {self.unit}\n"
            f"element vertex {len(self.points)}\n"
            + "".join(f"property float {axis}\n" for axis in "xyz")
            + "".join(f"property uchar {color}\n" for color in ("red", "green", "blue"))
            + "end_header\n"
        )
        vertices = np.empty(len(self.points), dtype=[("xyz", "<f4", 3), ("rgb", "u1", 3)])
        vertices["xyz"], vertices["rgb"] = self.points, self.colors
        write_bytes(path, header.encode("ascii", "replace") + vertices.tobytes())


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """A pinhole camera's intrinsics, in pixels whose centers have integer coordinates, and the image size for them."""

    K: Float[np.ndarray, "3 3"]
    height: int
    width: int

    def __post_init__(self) -> None:
        K = self.K
        plausible = np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0 and np.allclose(K[2], (0, 0, 1))
        if not plausible or not (-self.width < K[0, 2] < 2 * self.width and -self.height < K[1, 2] < 2 * self.height):
            raise ConfigError(
                f"intrinsics {np.array2string(K, precision=1, separator=',').replace(chr(10), '')} cannot belong to "
                f"{self.width}x{self.height} pixels; they must be [[fx,0,cx],[0,fy,cy],[0,0,1]] in pixels of that "
                "size"
            )

    @classmethod
    def from_numbers(cls, numbers: Sequence[float | int], height: int, width: int) -> Camera:
        """Read ``fx, fy, cx, cy``, the nine numbers of K by rows, or one: the horizontal field of view in degrees."""
        values = [float(number) for number in numbers]
        if len(values) == 1:  # square pixels and a centered axis: a guess without calibration
            focal = width / (2 * np.tan(np.radians(in_range("field of view", values[0], 1.0, 179.0)) / 2))
            values = [focal, focal, (width - 1) / 2, (height - 1) / 2]
        if len(values) == 4:
            fx, fy, cx, cy = values
            values = [fx, 0, cx, 0, fy, cy, 0, 0, 1]
        if len(values) != 9:
            raise ConfigError(
                f"intrinsics have {len(values)} numbers; give fx, fy, cx, cy, or the nine of K, or one, the "
                "horizontal field of view in degrees"
            )
        return cls(np.array(values).reshape(3, 3), height, width)

    def resized(self, height: int, width: int) -> Camera:
        """Return the camera of the same picture at another size, as `saunet.scale_intrinsics` does with torch."""
        K = self.K.astype(np.float64)
        for row, zoom in ((0, width / self.width), (1, height / self.height)):
            K[row, :2] *= zoom
            K[row, 2] = (self.K[row, 2] + 0.5) * zoom - 0.5
        return Camera(K, height, width)


def point_cloud(
    prediction: Prediction,
    camera: Camera,
    *,
    max_depth: float | int | None = None,
    stride: int = 1,
    edge: float | int = 0.1,
) -> PointCloud:
    """Return a prediction's pixels as points in space, colored by the image.

    Points farther than ``max_depth``, in the unit of depth, are left out. So are points at depth edges that would float
    between a near and a far surface: their depth differs from both by more than the fraction ``edge``. On street scenes
    that is a twentieth of the pixels; 0 keeps all.
    """
    positive("stride", stride)
    positive("edge", edge, allow_zero=True)
    depth = prediction.depth
    camera = camera.resized(*depth.shape)
    keep = np.isfinite(depth) & (depth > 0)
    if max_depth is not None:
        keep &= depth <= positive("max_depth", max_depth)
    if edge:
        keep &= ~between_surfaces(prediction.disparity, edge)
    rows, columns = np.nonzero(keep[::stride, ::stride])
    rows, columns = rows * stride, columns * stride
    z = depth[rows, columns].astype(np.float64)
    pixels = np.stack([columns, rows, np.ones_like(rows)]).astype(np.float64)
    points = (np.linalg.inv(camera.K) @ pixels * z).T.astype(np.float32)
    return PointCloud(np.ascontiguousarray(points), prediction.image[rows, columns], prediction.unit)


def camera_of(camera: Camera | Sequence[float | int] | float | int | str | Path, height: int, width: int) -> Camera:
    """Return the camera of a picture of this size from a user's numbers (see `Camera.from_numbers`) or file."""
    if isinstance(camera, Camera):
        return camera
    if isinstance(camera, str | Path):
        from saunet.data.video.camera import read_camera

        file = read_camera(str(camera))
        if not file.is_straight:
            raise ConfigError(
                f"camera={camera} describes a lens with distortion, but points need undistorted images; undistort "
                "them first, as `saunet predict undistort=FILE` does"
            )
        return Camera(file.intrinsics(height, width, "the images"), height, width)
    return Camera.from_numbers([camera] if isinstance(camera, float | int) else camera, height, width)


def between_surfaces(disparity: Float32[np.ndarray, "h w"], fraction: float) -> Bool[np.ndarray, "h w"]:
    """Return the pixels at depth edges that lie on neither surface: their depth differs by ``fraction`` from both.

    Networks and interpolation make ramps of edges, a few pixels wide. The surfaces are the nearest and the farthest
    depth around a pixel. Slanted ones, such as a road far away, change as steeply but do not end: around twice as large
    they change twice as much.
    """
    radius = max(1, round(_RAMP * disparity.shape[1]))
    near, far = _extremes(disparity, radius)
    nearer, farther = _extremes(disparity, 2 * radius)
    ends = near - far > _ENDS * (nearer - farther)
    return np.asarray(ends & (disparity > (1 + fraction) * far) & (near > (1 + fraction) * disparity))


def _extremes(
    values: Float32[np.ndarray, "h w"], radius: int
) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    square = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    return np.asarray(cv2.dilate(values, square)), np.asarray(cv2.erode(values, square))


class ViewerWriter(Session):
    """Writes predictions as one self-contained HTML page, for orbiting the points and scrubbing through the clip.

    Use it as a context manager: frames are written as they come, and each adds about 0.1 MB at the default width. The
    page gets its name only when it is complete; an error discards it.
    """

    def __init__(
        self,
        path: str | Path,
        camera: Camera | Sequence[float | int],
        *,
        width: int = 320,
        fps: float | int = 10.0,
        max_depth: float | int | None = None,
        edge: float = 0.15,
        title: str = "saunet depth",
    ) -> None:
        self.path, self.count = Path(path), 0
        if self.path.suffix.lower() not in (".html", ".htm"):
            raise ConfigError(f"the page {path} must end in .html")
        positive("width", width)
        self._camera, self._width, self._rows = camera, width, 0
        self._fps, self._title, self._edge = float(positive("fps", fps)), title, edge
        self._max_depth = None if max_depth is None else positive("max_depth", max_depth)

    def session(self) -> Iterator[None]:
        self._before, rest = _PAGE.read_text(encoding="utf-8").split("@CLIP@")
        self._between, after = rest.split("@FRAMES@")
        with replacing(self.path) as temporary, temporary.open("w", encoding="utf-8") as self._page:
            yield
            if self.count == 0:
                raise DataError(f"no frame was given, so {self.path} was not written")
            self._page.write(after)

    def add(self, prediction: Prediction) -> None:
        if self.count == 0:
            self._rows = max(1, round(self._width * prediction.depth.shape[0] / prediction.depth.shape[1]))
            self._page.write(self._before + script_json(self._head(prediction)) + self._between)
        frame = script_json(self._frame(prediction))
        self._page.write(f'<script class="frame" type="application/json">{frame}</script>\n')
        self.count += 1

    def _head(self, prediction: Prediction) -> dict[str, Any]:
        camera = self._camera
        if not isinstance(camera, Camera):
            camera = Camera.from_numbers(camera, *prediction.depth.shape)
        K = camera.resized(self._rows, self._width).K
        return {
            "title": self._title,
            "unit": prediction.unit,
            "fps": self._fps,
            "width": self._width,
            "height": self._rows,
            "intrinsics": [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])],
            "pivot": float(np.percentile(prediction.depth, 30)),
        }

    def _frame(self, prediction: Prediction) -> dict[str, Any]:
        disparity = np.asarray(resize(prediction.disparity, self._rows, self._width), dtype=np.float32)
        keep = disparity > 0
        if self._max_depth is not None:
            keep &= disparity >= 1 / self._max_depth
        if self._edge:
            keep &= ~between_surfaces(disparity, self._edge)
        jpeg = encode_jpeg(resize(prediction.image, self._rows, self._width), quality=85)
        return {"image": base64.b64encode(jpeg).decode(), **encoded(disparity, keep)}


def encoded(disparity: Float32[np.ndarray, "h w"], keep: Bool[np.ndarray, "h w"]) -> dict[str, Any]:
    """Return disparity as a page takes it: 16-bit levels 1 (``low``) to 65535 (``high``); 0 is not shown."""
    low, high = float(disparity.min()), float(disparity.max())
    levels = 1 + np.round(np.clip((disparity - low) / (high - low if high > low else 1.0), 0, 1) * 65534)
    data = np.where(keep, levels, 0).astype("<u2").tobytes()
    return {"disparity": base64.b64encode(data).decode(), "low": low, "high": high}


def script_json(value: dict[str, Any]) -> str:
    """Return JSON that is safe inside a script element."""
    return json.dumps(value, separators=(",", ":")).replace("<", "\\u003c")
