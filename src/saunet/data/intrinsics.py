"""Whether a K can belong to images of a size, before anything is computed from it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from saunet.errors import DataError

FOCAL = (0.15, 10.0)
"""Focal lengths in image widths (or heights) that a camera may have: a fisheye lens, a long telephoto lens."""
CENTRE = (0.15, 0.85)
"""Shares of the width between which the center lies, also where a side was cut off."""
SHRUNK = 0.3
"""A center nearer than this share to a corner, both ways, is that of K of another image size; crops move it one way."""


def check_intrinsics(
    K: NDArray[np.float64],
    height: int | None,
    width: int | None,
    where: str,
    fix: str = "is the calibration that of images of this size?",
) -> None:
    """Check that K can belong to an image: upper triangular, a possible field of view, the center where one can be.

    Args:
        K: 3 x 3, pixels.
        height: Of the image in pixels; None where nobody says, and then only what needs no size is checked.
        width: Of the image in pixels; None likewise.
        where: File and key that K comes from, for the message.
        fix: What to look at, for the message.

    Raises:
        DataError: naming what cannot be.
    """
    if not np.isfinite(K).all() or not np.allclose(K[2], [0, 0, 1]) or K[1, 0] != 0:
        raise DataError(f"{where} has K {K.tolist()}; expected [[fx, skew, cx], [0, fy, cy], [0, 0, 1]]")
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    size = f" for an image of {height}x{width} (height x width)" if height and width else ""
    told = f"{where} has focal lengths {fx:g}, {fy:g} and center {cx:g}, {cy:g}{size}"
    if not (fx > 0 and fy > 0):
        raise DataError(f"{told}; the lengths must be positive: {fix}")
    if not height or not width:
        return
    low, high = FOCAL
    if not (low * width < fx < high * width and low * height < fy < high * max(height, width)):
        raise DataError(f"{told}; a focal length is some 0.3 to 3 image widths: {fix}")
    right, down = (cx + 0.5) / width, (cy + 0.5) / height
    if not (0 < down < 1 and CENTRE[0] < right < CENTRE[1]):
        raise DataError(f"{told}; the center must lie inside, not near the left or right edge: {fix}")
    if max(right, down) < SHRUNK or min(right, down) > 1 - SHRUNK:
        raise DataError(
            f"{told}; the center must lie inside, and near a corner it is that of images of another size: {fix}"
        )
