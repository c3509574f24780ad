"""One camera: its intrinsics, distortion, height and frame rate from a file, and undistorted images.

```yaml
image_size: [1920, 1080]               # width, height of the images that K belongs to
K: [1408.2, 1407.9, 958.7, 541.3]      # fx, fy, cx, cy in pixels; or three rows of three numbers
distortion: [-0.31, 0.12, 0, 0, -0.02] # OpenCV's k1 k2 p1 p2 k3 ...; leave it out for undistorted images
model: pinhole                         # or fisheye, omni ... (docs/cameras.md)
fov: 100                               # degrees: width of the undistorted picture; by default as wide as possible
fps: 30                                # of the frames; a video file's own rate takes precedence
camera_height: 1.42                    # meters above the road, for metric depth
condition: cloudy                      # a label to filter and compare clips by
crop: [0, 0.12, 0, 0]                  # fractions to cut off at the top, bottom, left, right: sky, hood
```

Write ``camera: unknown`` instead of K and image_size, and data=video estimates the focal length from turns in the
clips.

With ``normalized: true``, K is in fractions of the width and height, (0.5, 0.5) is the middle of the image, and no size
is needed.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import yaml
from jaxtyping import UInt8
from numpy.typing import NDArray

from saunet.data.checks import check_intrinsics
from saunet.data.drive import LensModel
from saunet.data.video.calibrations import find_camera, split_name
from saunet.data.video.lens_models import COEFFICIENTS, WIDEST, Maps, straight_intrinsics, straightening_maps
from saunet.errors import CameraError, DataError, SaunetError, suggest
from saunet.geometry.camera import GUESS, crop_intrinsics, scale_intrinsics
from saunet.io.atomic import write_bytes

FIX = "is K in pixels of images of this size, or normalized (then set normalized: true)?"
"""What to check if K does not fit the images."""
_SAME_SHAPE = 0.02
"""Largest relative difference of aspect ratios for a frame to count as the calibrated image at another size."""
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
_LARGEST = 1e300  # larger integers do not fit a float; NaN and infinity are outside too


@dataclass(frozen=True)
class CameraFile:
    """One camera as its ``camera.yaml`` describes it."""

    path: Path
    K: NDArray[np.float64]
    """3 x 3; in pixels of `image_size` (integer coordinates are pixel centers), or normalized if that is None."""
    image_size: tuple[int, int] | None  # (height, width); None if K is normalized
    distortion: tuple[float, ...] = ()
    model: str = "pinhole"
    fps: float | None = None
    camera_height: float | None = None  # meters above the road
    condition: str | None = None
    crop: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Fractions of the image to cut off at the top, bottom, left and right."""
    reprojection_error: float | None = None  # root mean square in pixels, if the file comes from a calibration
    fov: float | None = None  # horizontal degrees of the undistorted picture; None for the widest possible
    is_known: bool = True
    """False if the file says ``camera: unknown``; K is then a guess."""

    @property
    def is_straight(self) -> bool:
        """Whether the pictures are those of an ideal pinhole camera."""
        return self.model == "pinhole" and not any(self.distortion)

    def intrinsics(self, height: int, width: int, what: str = "the frames") -> NDArray[np.float64]:
        """Return K, 3 x 3, in pixels of frames of a size, which must have the calibrated aspect ratio."""
        if not self.is_known:
            focal = GUESS * width
            return np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
        given = torch.from_numpy(self.K)
        if self.image_size is None:  # one pixel, whose center is 0
            scaled = scale_intrinsics(crop_intrinsics(given, 0.5, 0.5), width, height)
        else:
            rows, columns = self.image_size
            if abs(height / rows * columns / width - 1) > _SAME_SHAPE:
                fix = "give frames of the calibrated shape (scaled, not cropped), or calibrate again"
                if abs(height / columns * rows / width - 1) < _SAME_SHAPE:
                    fix = (
                        "the sides are swapped: image_size is [width, height]; for a video with a rotation tag, it "
                        "and K are those of the picture that players show"
                    )
                raise CameraError(
                    f"{what} are {width}x{height} (width x height) but {self.path} is for {columns}x{rows}; {fix}"
                )
            scaled = scale_intrinsics(given, width / columns, height / rows)
        K: NDArray[np.float64] = scaled.numpy()
        check_intrinsics(K, height, width, f"{self.path}: K", FIX)
        return K


def unknown_camera(path: Path) -> CameraFile:
    """Return a camera about which nothing is known."""
    return CameraFile(path, np.array([[GUESS, 0, 0.5], [0, GUESS, 0.5], [0, 0, 1]]), None, is_known=False)


def forgotten(camera: CameraFile) -> CameraFile:
    """Return a camera without its K, distortion and model."""
    blank = unknown_camera(camera.path)
    kept = (camera.fps, camera.camera_height, camera.condition, camera.crop)
    return CameraFile(blank.path, blank.K, None, (), blank.model, *kept, is_known=False)


def read_camera(path: str | Path, *, may_be_unknown: bool = False) -> CameraFile:
    """Read a ``camera.yaml``, or ``FILE[:camera name]`` of another tool's calibration (docs/cameras.md)."""
    path, name = split_name(path)
    try:
        plain = find_camera(path, name)
    except FileNotFoundError as reason:
        fix = "make one with saunet calibrate, or write one (see docs/your_camera.md)"
        raise DataError(f"no camera file at {path}; {fix}") from reason
    except OSError as reason:
        raise DataError(f"cannot read {path}: {reason.strerror or reason}; check its permissions") from reason
    if not isinstance(plain, dict):
        raise DataError(f"{path} holds {type(plain).__name__}; expected keys such as 'K: [fx, fy, cx, cy]'")
    keys = [
        *(each.name for each in fields(CameraFile) if each.name not in ("path", "is_known")),
        "normalized",
        "camera",
    ]
    if plain and not set(plain) & set(keys):
        raise DataError(
            f"{path} is not a readable calibration: camera.yaml, ROS, OpenCV, Kalibr, COLMAP, Nerfstudio, KITTI, "
            "VINS, ORB-SLAM or MATLAB (see docs/cameras.md)"
        )
    for key in plain:
        if key not in keys:
            hint = suggest(str(key), keys)
            raise DataError(f"{path}: unknown key '{key}'{hint or ';'} allowed: {', '.join(keys)}")
    if "camera" in plain:
        if plain["camera"] != "unknown" or {"K", "image_size", "model", "distortion", "normalized"} & set(plain):
            raise DataError(
                f"{path}: camera is {plain['camera']!r}; only 'unknown' is allowed, instead of K and the lens"
            )
        if not may_be_unknown:
            raise DataError(
                f"{path} says camera: unknown, which only data=video can estimate; give K, the camera file kept by "
                "its training, or one made with saunet calibrate video=drive.mp4"
            )
    return _camera(path, plain)


def _camera(path: Path, plain: Mapping[str, Any]) -> CameraFile:
    def above_zero(key: str) -> float | None:
        value = plain.get(key)
        number = None if value is None else _numbers(path, key, [value], (1,))[0]
        if number is not None and number <= 0:
            raise DataError(f"{path}: {key} is {value}; it must be greater than 0")
        return number

    normalized = plain.get("normalized", False)
    if not isinstance(normalized, bool):
        raise DataError(f"{path}: normalized is {normalized!r}; it must be true or false")
    known = plain.get("camera") is None
    if known and "K" not in plain:
        raise DataError(f"{path} lacks K; expected 'K: [fx, fy, cx, cy]' or three rows of three numbers")
    size = None
    if known and not normalized:
        if "image_size" not in plain:
            raise DataError(f"{path} lacks image_size; expected 'image_size: [width, height]' of the images of K")
        width, height = _numbers(path, "image_size", plain["image_size"], (2,))
        if min(width, height) < 2 or width % 1 or height % 1:
            raise DataError(f"{path}: image_size is {plain['image_size']}; expected whole numbers [width, height]")
        size = (int(height), int(width))
    model = plain.get("model", "pinhole")
    if model not in COEFFICIENTS:
        raise DataError(
            f"{path}: model is '{model}'{suggest(str(model), COEFFICIENTS) or ','} allowed: {', '.join(COEFFICIENTS)}"
        )
    crop = tuple(_numbers(path, "crop", plain.get("crop", [0, 0, 0, 0]), (4,)))
    check_crop(crop, f"{path}: crop")
    camera = CameraFile(
        path=path,
        K=_matrix(path, plain["K"]) if known else unknown_camera(path).K,
        image_size=size,
        distortion=tuple(_numbers(path, "distortion", plain.get("distortion") or [], COEFFICIENTS[model])),
        model=model,
        fps=above_zero("fps"),
        camera_height=above_zero("camera_height"),
        condition=None if plain.get("condition") is None else str(plain["condition"]),
        crop=(crop[0], crop[1], crop[2], crop[3]),
        reprojection_error=above_zero("reprojection_error"),
        fov=above_zero("fov"),
        is_known=known,
    )
    if camera.fov is not None and camera.fov > WIDEST:
        raise DataError(f"{path}: fov is {camera.fov:g} degrees; an undistorted picture has at most {WIDEST:g}")
    if size is not None:
        check_intrinsics(camera.K, *size, f"{path}: K", FIX)
    elif known and not (0.1 < camera.K[0, 0] < 20 and 0 < camera.K[0, 2] < 1 and 0 < camera.K[1, 2] < 1):
        raise DataError(
            f"{path}: normalized K has fx {camera.K[0, 0]:g} and center {camera.K[0, 2]:g}, {camera.K[1, 2]:g}; "
            "expected fractions of the image, such as 0.58, 1.92, 0.5, 0.5"
        )
    return camera


def check_crop(crop: Sequence[float | int], what: str, error: type[SaunetError] = DataError) -> None:
    fits = len(crop) == 4 and all(0 <= share < 1 for share in crop)
    if not fits or crop[0] + crop[1] > 0.9 or crop[2] + crop[3] > 0.9:
        raise error(
            f"{what} is {list(crop)}; expected fractions to cut off at the [top, bottom, left, right], each at least "
            "0, that leave a tenth of the height and width"
        )


def _matrix(path: Path, value: Any) -> NDArray[np.float64]:
    nested = isinstance(value, list) and bool(value) and all(isinstance(row, list) for row in value)
    numbers = _numbers(path, "K", [number for row in value for number in row] if nested else value, (4, 9))
    if len(numbers) == 4:
        fx, fy, cx, cy = numbers
        numbers = [fx, 0, cx, 0, fy, cy, 0, 0, 1]
    K = np.array(numbers, dtype=np.float64).reshape(3, 3)
    if K[1, 0] or K[2, 0] or K[2, 1] or K[2, 2] != 1:
        raise DataError(f"{path}: K is {K.tolist()}; expected [[fx, skew, cx], [0, fy, cy], [0, 0, 1]]")
    return K


def _numbers(path: Path, key: str, value: Any, counts: Sequence[int]) -> list[float]:
    allowed = " or ".join(map(str, counts))
    if not isinstance(value, list) or len(value) not in counts:
        got = f"{len(value)}" if isinstance(value, list) else repr(value)[:40]
        raise DataError(f"{path}: {key} needs a list of {allowed} numbers, got {got}")
    numbers = []
    for number in value:
        if isinstance(number, str) and _NUMBER.fullmatch(number.strip()):
            number = float(number)  # YAML 1.1 reads ``1e-5`` and ``4.5e2`` as text
        if isinstance(number, bool) or not isinstance(number, int | float) or not abs(number) <= _LARGEST:
            raise DataError(f"{path}: {key} needs {allowed} finite numbers, got {str(number)[:40]!r} among them")
        numbers.append(float(number))
    return numbers


def write_camera(path: str | Path, camera: CameraFile, note: str = "") -> None:
    """Write ``camera.yaml``, with a note as its first comment."""
    K, size = camera.K, camera.image_size
    plain: dict[str, Any] = {"image_size": [size[1], size[0]]} if size else {"normalized": True}
    numbers = K.ravel() if K[0, 1] else K[[0, 1, 0, 1], [0, 1, 2, 2]]
    plain["K"] = [float(f"{number:.8g}") for number in numbers]
    if camera.distortion:
        plain["distortion"] = [float(f"{number:.8g}") for number in camera.distortion]
    if not camera.is_straight:
        plain["model"] = camera.model
    for key in ("fov", "fps", "camera_height", "condition"):
        if getattr(camera, key) is not None:
            plain[key] = getattr(camera, key)
    if any(camera.crop):
        plain["crop"] = list(camera.crop)
    if camera.reprojection_error is not None:
        plain["reprojection_error"] = round(camera.reprojection_error, 4)
    comment = "".join(f"# {line}\n" for line in note.splitlines())
    text = yaml.safe_dump(plain, sort_keys=False, default_flow_style=None, allow_unicode=True)
    write_bytes(path, (comment + text).encode())


class Lens:
    """Undistorts and crops the frames of one size of one camera."""

    def __init__(
        self,
        camera: CameraFile,
        height: int,
        width: int,
        crop: Sequence[float | int] | None = None,
        what: str = "the frames",
    ) -> None:
        self.recorded = (height, width)
        K = camera.intrinsics(height, width, what)
        recorded = K
        self._maps: Maps | None = None
        if not camera.is_straight:
            lens = camera.model, camera.distortion, recorded
            K = straight_intrinsics(*lens, height, width, camera.fov, str(camera.path))
            self._maps = straightening_maps(*lens, K, height, width)
            check_intrinsics(K, height, width, f"{camera.path}: K after undistortion", FIX)
        shares = camera.crop if crop is None else tuple(crop)
        check_crop(shares, "crop")
        self._rows = slice(round(shares[0] * height), height - round(shares[1] * height))
        self._columns = slice(round(shares[2] * width), width - round(shares[3] * width))
        self.height, self.width = self._rows.stop - self._rows.start, self._columns.stop - self._columns.start
        corner = self._columns.start, self._rows.start
        self.K = crop_intrinsics(torch.from_numpy(K), *corner).numpy()
        self.model: LensModel | None = None
        """The lens that is undistorted; None if there is none."""
        if self._maps is not None:
            recorded = crop_intrinsics(torch.from_numpy(recorded), *corner).numpy()
            self.model = LensModel(camera.model, camera.distortion, recorded)

    def __call__(
        self, image: UInt8[np.ndarray, "_ _ 3"], name: str = "a frame", *, undistort: bool = True
    ) -> UInt8[np.ndarray, "_ _ 3"]:
        if image.shape[:2] != self.recorded:
            height, width = self.recorded
            raise DataError(
                f"{name} is {image.shape[1]}x{image.shape[0]} (width x height) but other frames of its clip are "
                f"{width}x{height}; all frames of a clip must have one size"
            )
        if undistort and self._maps is not None:
            image = np.asarray(cv2.remap(image, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
        return np.ascontiguousarray(image[self._rows, self._columns])


class Undistorter:
    """Undistorts and crops the camera's images of any size, as training on its clips does."""

    def __init__(self, camera: CameraFile, crop: Sequence[float | int] | None = None) -> None:
        self.camera, self._crop = camera, crop
        self._lenses: dict[tuple[int, int], Lens] = {}

    def lens(self, height: int, width: int) -> Lens:
        if (height, width) not in self._lenses:
            self._lenses[height, width] = Lens(self.camera, height, width, self._crop, "the images")
        return self._lenses[height, width]

    def __call__(self, image: UInt8[np.ndarray, "_ _ 3"]) -> UInt8[np.ndarray, "_ _ 3"]:
        return self.lens(image.shape[0], image.shape[1])(image)
