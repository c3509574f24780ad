"""Checks of a recording before anything is computed from it: does K fit its images, and do these share one size?"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from saunet.data.drive import Drive
from saunet.errors import CameraError, DataError
from saunet.geometry.camera import scale_intrinsics
from saunet.io.images import image_size

FOCAL = (0.15, 10.0)
"""Allowed focal lengths in image widths (or heights): from a fisheye lens to a long telephoto lens."""
CENTER = (0.15, 0.85)  # fractions of the width between which the center lies, also where a side was cut off
SHRUNK = 0.3
"""A center nearer than this to a corner in both directions belongs to another image size; crops move it in one."""
ROTATION_ERROR = 1e-3
"""Largest difference of R R^T from 1; matrices printed with seven digits, as KITTI's, are within 2e-7."""
LOOKED_AT = 5  # frames whose size is read, so that a single broken or odd one does not decide


def check_intrinsics(
    K: NDArray[np.float64],
    height: int | None,
    width: int | None,
    where: str,
    fix: str = "was the camera calibrated with images of this size?",
) -> None:
    """Check that K, 3 x 3, fits an image: upper triangular, with a possible field of view and center.

    Without a size, only what does not need it is checked. ``where`` (file and key) and ``fix`` are for the message.
    """
    if not np.isfinite(K).all() or not np.allclose(K[2], [0, 0, 1]) or K[1, 0] != 0:
        raise CameraError(f"{where} has K {K.tolist()}; expected [[fx, skew, cx], [0, fy, cy], [0, 0, 1]]")
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    size = f" for an image of {height}x{width} (height x width)" if height and width else ""
    told = f"{where} has focal lengths {fx:g}, {fy:g} and center {cx:g}, {cy:g}{size}"
    if not (fx > 0 and fy > 0):
        raise CameraError(f"{told}; the lengths must be positive: {fix}")
    if not height or not width:
        return
    low, high = FOCAL
    if not (low * width < fx < high * width and low * height < fy < high * max(height, width)):
        raise CameraError(f"{told}; a focal length is about 0.3 to 3 image widths: {fix}")
    right, down = (cx + 0.5) / width, (cy + 0.5) / height
    if not (0 < down < 1 and CENTER[0] < right < CENTER[1]):
        raise CameraError(f"{told}; the center must lie inside, not near the left or right edge: {fix}")
    if max(right, down) < SHRUNK or min(right, down) > 1 - SHRUNK:
        why = "a center near a corner belongs to images of another size"
        raise CameraError(f"{told}; the center must lie inside, and {why}: {fix}")


def common_size(paths: Sequence[Path]) -> tuple[Path, tuple[int, int]]:
    """Return the (height, width) of most readable frames of a recording, and a frame of that size."""
    sizes: dict[Path, tuple[int, int]] = {}
    problem: DataError | None = None
    for place in np.linspace(0, len(paths) - 1, min(LOOKED_AT, len(paths))).round().astype(int):
        try:
            sizes[paths[place]] = image_size(paths[place])
        except DataError as error:
            problem = problem or error
    if not sizes:
        raise problem or DataError("a recording without frames has no size")
    (size, _), *_ = Counter(sizes.values()).most_common()
    return next(path for path, each in sizes.items() if each == size), size


def check_frame(drive: Drive, frame: int, image: NDArray[np.uint8]) -> None:
    """Check that a frame has the size that its recording's K belongs to."""
    size = drive.frame_size
    if size is not None and image.shape[:2] != size:
        what = drive.path(frame) or f"frame {frame}"
        raise DataError(
            f"{what} is {image.shape[1]}x{image.shape[0]} (width x height) but the frames of '{drive.name}' are "
            f"{size[1]}x{size[0]}; all frames of a recording must have one size"
        )


def check_rotation(R: NDArray[np.float64], where: str) -> None:
    """Check that a 3 x 3 matrix is a rotation: orthonormal within `ROTATION_ERROR`, and not a mirror image."""
    error = float(np.abs(R @ R.T - np.eye(3)).max())
    if error > ROTATION_ERROR:
        raise DataError(
            f"{where} has a matrix that is not a rotation (R R^T differs from 1 by {error:.2g}, determinant "
            f"{np.linalg.det(R):.3g}); its rows must be orthogonal unit vectors: copy the file again"
        )
    if np.linalg.det(R) < 0:
        raise DataError(f"{where} has a reflection (determinant -1) instead of a rotation: swap its axes back")


def scaled(
    K: NDArray[np.float64], native: tuple[int, int], size: tuple[int, int], images: Path, calibration: Path
) -> NDArray[np.float64]:
    """Return K of images that may have been scaled (not cropped) from a calibration's (height, width)."""
    (height, width), (rows, columns) = size, native
    if abs(height / rows * columns / width - 1) > 0.02:
        raise DataError(
            f"{images} has {height}x{width} (height x width) but {calibration} is for {rows}x{columns}; use the "
            "original images, or scale without cropping"
        )
    return scale_intrinsics(torch.from_numpy(K), width / columns, height / rows).numpy()
