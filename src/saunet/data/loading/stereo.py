"""The other view of a stereo pair, as samples need it, and the meters traveled between two frames."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from saunet.data.drive import Drive
from saunet.errors import DataError

Odometer = Callable[[Drive, int, int], float]
"""Gives the meters traveled between two frames of a drive, NaN where unknown."""

_SAME_K = 0.5
"""Pixels by which the intrinsics of two cameras may differ and still be taken for one."""


def other_view(drive: Drive) -> tuple[Drive, NDArray[np.float64]]:
    """Return the recording of the other camera, and T_stereo_cam, 4 x 4, meters."""
    other = drive.stereo()
    T_stereo_cam = None if other is None else drive.T_stereo_cam
    if other is None or T_stereo_cam is None:
        raise DataError(
            f"'{drive.name}' is a recording of one camera, so it has no stereo view; set data.stereo=false, or use "
            "data of two calibrated cameras"
        )
    return other, T_stereo_cam


def stereo_image(drive: Drive, index: int) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Return the other camera's frame, h x w x 3, RGB, and T_stereo_cam, 4 x 4, meters."""
    other, T_stereo_cam = other_view(drive)
    K, K_other = drive.intrinsics(index), other.intrinsics(index)
    if np.abs(K - K_other).max() > _SAME_K:
        raise DataError(
            f"'{drive.name}' and its stereo view '{other.name}' have different intrinsics ({_short(K)} and "
            f"{_short(K_other)}); a stereo source needs rectified images with one K"
        )
    return other.image(index), T_stereo_cam


def measured_distance(drive: Drive, first: int, second: int) -> float:
    """Return the meters traveled between two frames as the recording itself knows them; NaN where it does not."""
    known = drive.distance(first, second)
    return math.nan if known is None else known


def _short(K: NDArray[np.float64]) -> str:
    return f"fx {K[0, 0]:.1f}, cx {K[0, 2]:.1f}, cy {K[1, 2]:.1f}"
