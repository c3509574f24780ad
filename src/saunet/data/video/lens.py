"""From what a camera's sensor saw to a straight pinhole image: undistortion and crop, with intrinsics that follow."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import UInt8
from numpy.typing import NDArray

from saunet.data.checks import check_intrinsics
from saunet.data.video.camera_file import FIX, CameraFile, check_crop
from saunet.errors import DataError
from saunet.geometry.camera import crop_intrinsics


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
        recorded = camera.intrinsics(height, width, what)
        K = recorded
        self._maps: tuple[NDArray[np.int16], NDArray[np.uint16]] | None = None
        if any(camera.distortion):
            K, self._maps = _undistortion(camera, recorded, height, width)
            check_intrinsics(K, height, width, f"{camera.path}: K after undistortion", FIX)
        shares = camera.crop if crop is None else tuple(crop)
        check_crop(shares, "crop")
        self._rows = slice(round(shares[0] * height), height - round(shares[1] * height))
        self._columns = slice(round(shares[2] * width), width - round(shares[3] * width))
        self.height, self.width = self._rows.stop - self._rows.start, self._columns.stop - self._columns.start
        self.K = crop_intrinsics(torch.from_numpy(K), self._columns.start, self._rows.start).numpy()

    def __call__(self, image: UInt8[np.ndarray, "_ _ 3"], name: str = "a frame") -> UInt8[np.ndarray, "_ _ 3"]:
        """Return a recorded frame, straightened and cut."""
        if image.shape[:2] != self.recorded:
            height, width = self.recorded
            raise DataError(
                f"{name} is {image.shape[1]}x{image.shape[0]} (width x height) where other frames of its clip are "
                f"{width}x{height}; frames of a clip share one size"
            )
        if self._maps is not None:
            image = np.asarray(cv2.remap(image, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
        return np.ascontiguousarray(image[self._rows, self._columns])


class Undistorter:
    """Undistorts and crops images of any size that the camera takes, as training on its clips does."""

    def __init__(self, camera: CameraFile, crop: Sequence[float | int] | None = None) -> None:
        self.camera, self._crop = camera, crop
        self._lenses: dict[tuple[int, int], Lens] = {}

    def lens(self, height: int, width: int) -> Lens:
        """Return the lens for images of a size."""
        if (height, width) not in self._lenses:
            self._lenses[height, width] = Lens(self.camera, height, width, self._crop, "the images")
        return self._lenses[height, width]

    def __call__(self, image: UInt8[np.ndarray, "_ _ 3"]) -> UInt8[np.ndarray, "_ _ 3"]:
        """Return an image, straightened and cut."""
        return self.lens(image.shape[0], image.shape[1])(image)


def _undistortion(
    camera: CameraFile, K: NDArray[np.float64], height: int, width: int
) -> tuple[NDArray[np.float64], tuple[NDArray[np.int16], NDArray[np.uint16]]]:
    """Return K of the largest undistorted image without blank pixels, and where each of its pixels comes from."""
    numbers, size = np.array(camera.distortion), (width, height)
    if camera.model == "fisheye":
        straight = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(K, numbers, size, np.eye(3), balance=0.0)
        maps = cv2.fisheye.initUndistortRectifyMap(K, numbers, np.eye(3), straight, size, cv2.CV_16SC2)
    else:
        straight, _ = cv2.getOptimalNewCameraMatrix(K, numbers, size, 0.0, size)
        maps = cv2.initUndistortRectifyMap(K, numbers, None, straight, size, cv2.CV_16SC2)
    return np.asarray(straight, dtype=np.float64), (np.asarray(maps[0]), np.asarray(maps[1]))
