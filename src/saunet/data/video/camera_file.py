"""``camera.yaml``: one camera's intrinsics, distortion, height and frame rate, as a user writes them down.

```yaml
image_size: [1920, 1080]               # width, height of the images that K belongs to
K: [1408.2, 1407.9, 958.7, 541.3]      # fx, fy, cx, cy in pixels; or three rows of three numbers
distortion: [-0.31, 0.12, 0, 0, -0.02] # OpenCV's k1 k2 p1 p2 k3 ...; leave it out for undistorted images
model: pinhole                         # or fisheye (four numbers of distortion)
fps: 30                                # of the frames; a video file's own rate goes before it
camera_height: 1.42                    # meters above the road, for metric depth
condition: cloudy                      # free words, to choose and compare clips by
crop: [0, 0.12, 0, 0]                  # share to cut off at the top, bottom, left, right: sky, bonnet
```

With ``normalized: true`` K is in shares of the width and height, (0.5, 0.5) the middle of the image, and no size is
needed.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from numpy.typing import NDArray

from saunet.data.checks import check_intrinsics
from saunet.errors import DataError, SaunetError, suggest
from saunet.geometry.camera import crop_intrinsics, scale_intrinsics
from saunet.io.atomic import write_bytes
from saunet.io.plain import read_yaml

FILE_NAME = "camera.yaml"
MODELS = ("pinhole", "fisheye")
_COUNTS = {"pinhole": (0, 4, 5, 8, 12, 14), "fisheye": (0, 4)}
_KEYS = (
    "K",
    "image_size",
    "normalized",
    "distortion",
    "model",
    "fps",
    "camera_height",
    "condition",
    "crop",
    "reprojection_error",
)
FIX = "is K in pixels of images of this size, or normalized (then set normalized: true)?"
"""What to look at where K cannot belong to the images."""
_SAME_SHAPE = 0.02
"""Relative difference of the two aspect ratios up to which a frame is the calibrated image at another size."""


_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
_LARGEST = 1e300
"""Beyond it a whole number is no float; NaN and infinity are not within it either."""


@dataclass(frozen=True)
class CameraFile:
    """One camera as its ``camera.yaml`` describes it."""

    path: Path
    """The file, for messages."""
    K: NDArray[np.float64]
    """3 x 3; in pixels of `image_size` (integer coordinates are pixel centers), or normalized where that is None."""
    image_size: tuple[int, int] | None
    """(height, width); None where K is normalized."""
    distortion: tuple[float, ...] = ()
    model: str = "pinhole"
    fps: float | None = None
    camera_height: float | None = None
    """Meters above the road."""
    condition: str | None = None
    crop: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Shares of the image to cut off at the top, bottom, left and right."""
    reprojection_error: float | None = None
    """Root mean square in pixels, where the file comes from a calibration."""

    def intrinsics(self, height: int, width: int, what: str = "the frames") -> NDArray[np.float64]:
        """Return K, 3 x 3, in pixels of frames of a size, which must have the shape of the calibrated ones."""
        given = torch.from_numpy(self.K)
        if self.image_size is None:  # one pixel, whose center is 0
            scaled = scale_intrinsics(crop_intrinsics(given, 0.5, 0.5), width, height)
        else:
            rows, columns = self.image_size
            if abs(height / rows * columns / width - 1) > _SAME_SHAPE:
                raise DataError(
                    f"{what} are {width}x{height} (width x height) but {self.path} is for {columns}x{rows}; "
                    "give frames of the calibrated shape (scaled as a whole, not cropped), or calibrate anew"
                )
            scaled = scale_intrinsics(given, width / columns, height / rows)
        K: NDArray[np.float64] = scaled.numpy()
        check_intrinsics(K, height, width, f"{self.path}: K", FIX)
        return K


def read_camera(path: str | Path) -> CameraFile:
    """Read a ``camera.yaml``."""
    path = Path(path)
    try:
        plain = read_yaml(path)
    except FileNotFoundError as reason:
        raise DataError(
            f"no camera file at {path}; make one with saunet calibrate, or write one (see docs/your_camera.md)"
        ) from reason
    except OSError as reason:
        raise DataError(f"cannot read {path}: {reason.strerror or reason}; check its rights") from reason
    if not isinstance(plain, dict):
        raise DataError(f"{path} holds {type(plain).__name__}; expected keys such as 'K: [fx, fy, cx, cy]'")
    for key in plain:
        if key not in _KEYS:
            hint = suggest(str(key), _KEYS)
            raise DataError(f"{path}: unknown key '{key}'{hint or ';'} allowed: {', '.join(_KEYS)}")
    return _camera(path, plain)


def _camera(path: Path, plain: Mapping[str, Any]) -> CameraFile:
    normalized = plain.get("normalized", False)
    if not isinstance(normalized, bool):
        raise DataError(f"{path}: normalized is {normalized!r}; it must be true or false")
    if "K" not in plain:
        raise DataError(f"{path} lacks K; expected 'K: [fx, fy, cx, cy]' or three rows of three numbers")
    size = None
    if not normalized:
        if "image_size" not in plain:
            raise DataError(
                f"{path} lacks image_size; expected 'image_size: [width, height]' of the images that K belongs to"
            )
        width, height = _numbers(path, "image_size", plain["image_size"], (2,))
        if min(width, height) < 2 or width % 1 or height % 1:
            raise DataError(f"{path}: image_size is {plain['image_size']}; expected whole numbers [width, height]")
        size = (int(height), int(width))
    model = plain.get("model", "pinhole")
    if model not in MODELS:
        raise DataError(f"{path}: model is '{model}'{suggest(str(model), MODELS) or ','} allowed: {', '.join(MODELS)}")
    crop = tuple(_numbers(path, "crop", plain.get("crop", [0, 0, 0, 0]), (4,)))
    check_crop(crop, f"{path}: crop")
    camera = CameraFile(
        path=path,
        K=_matrix(path, plain["K"]),
        image_size=size,
        distortion=tuple(_numbers(path, "distortion", plain.get("distortion") or [], _COUNTS[model])),
        model=model,
        fps=_positive(path, "fps", plain.get("fps")),
        camera_height=_positive(path, "camera_height", plain.get("camera_height")),
        condition=None if plain.get("condition") is None else str(plain["condition"]),
        crop=(crop[0], crop[1], crop[2], crop[3]),
        reprojection_error=_positive(path, "reprojection_error", plain.get("reprojection_error")),
    )
    if size is not None:
        check_intrinsics(camera.K, *size, f"{path}: K", FIX)
    elif not (0.1 < camera.K[0, 0] < 20 and 0 < camera.K[0, 2] < 1 and 0 < camera.K[1, 2] < 1):
        raise DataError(
            f"{path}: normalized K has fx {camera.K[0, 0]:g} and center {camera.K[0, 2]:g}, {camera.K[1, 2]:g}; "
            "expected shares of the image, such as 0.58, 1.92, 0.5, 0.5"
        )
    return camera


def check_crop(crop: Sequence[float | int], what: str, error: type[SaunetError] = DataError) -> None:
    """Check the shares to cut off at the top, bottom, left and right."""
    fits = len(crop) == 4 and all(0 <= share < 1 for share in crop)
    if not fits or crop[0] + crop[1] > 0.9 or crop[2] + crop[3] > 0.9:
        raise error(
            f"{what} is {list(crop)}; expected shares to cut off at the [top, bottom, left, right], each at least 0, "
            "that leave a tenth of the height and width"
        )


def _matrix(path: Path, value: Any) -> NDArray[np.float64]:
    flat = [number for row in value for number in row] if _is_nested(value) else value
    numbers = _numbers(path, "K", flat, (4, 9))
    if len(numbers) == 4:
        fx, fy, cx, cy = numbers
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=np.float64)
    K = np.array(numbers, dtype=np.float64).reshape(3, 3)
    if K[1, 0] or K[2, 0] or K[2, 1] or K[2, 2] != 1:
        raise DataError(f"{path}: K is {K.tolist()}; expected [[fx, skew, cx], [0, fy, cy], [0, 0, 1]]")
    return K


def _is_nested(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(row, list) for row in value)


def _numbers(path: Path, key: str, value: Any, counts: Sequence[int]) -> list[float]:
    allowed = " or ".join(str(count) for count in counts)
    if not isinstance(value, list) or len(value) not in counts:
        got = f"{len(value)}" if isinstance(value, list) else repr(value)[:40]
        raise DataError(f"{path}: {key} needs a list of {allowed} numbers, got {got}")
    value = [_as_number(number) for number in value]
    for number in value:
        if isinstance(number, bool) or not isinstance(number, int | float) or not abs(number) <= _LARGEST:
            raise DataError(f"{path}: {key} needs {allowed} finite numbers, got {str(number)[:40]!r} among them")
    return [float(number) for number in value]


def _as_number(value: Any) -> Any:
    """Return text that is a number as one: YAML 1.1 reads ``1e-5`` and ``4.5e2`` as text."""
    if not isinstance(value, str) or not _NUMBER.fullmatch(value.strip()):
        return value
    return float(value)


def _positive(path: Path, key: str, value: Any) -> float | None:
    if value is None:
        return None
    number = _numbers(path, key, [value], (1,))[0]
    if number <= 0:
        raise DataError(f"{path}: {key} is {value}; it must be greater than 0")
    return number


def write_camera(path: str | Path, camera: CameraFile, note: str = "") -> None:
    """Write a ``camera.yaml`` that `read_camera` reads, whole or not at all."""
    plain: dict[str, Any] = {}
    if camera.image_size is None:
        plain["normalized"] = True
    else:
        plain["image_size"] = [camera.image_size[1], camera.image_size[0]]
    K = camera.K
    plain["K"] = [float(f"{number:.8g}") for number in (K[0, 0], K[1, 1], K[0, 2], K[1, 2])]
    if camera.distortion:
        plain["distortion"] = [float(f"{number:.8g}") for number in camera.distortion]
        plain["model"] = camera.model
    for key in ("fps", "camera_height", "condition"):
        if getattr(camera, key) is not None:
            plain[key] = getattr(camera, key)
    if any(camera.crop):
        plain["crop"] = list(camera.crop)
    if camera.reprojection_error is not None:
        plain["reprojection_error"] = round(camera.reprojection_error, 4)
    comment = "".join(f"# {line}\n" for line in note.splitlines())
    text = yaml.safe_dump(plain, sort_keys=False, default_flow_style=None, allow_unicode=True)
    write_bytes(path, (comment + text).encode())
