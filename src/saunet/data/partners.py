"""What a recording knows beside its own frames: the stereo partner of each, and the way traveled between them."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from saunet.data.drive import Drive, MeasuredDrive, StereoDrive
from saunet.errors import DataError

Odometer = Callable[[Drive, int, int], float]
"""Gives the meters traveled between two frames of a drive, NaN where unknown."""

_SAME_K = 0.5
"""Pixels by which the intrinsics of two cameras may differ and still be taken for one."""


def stereo_drive(drive: Drive) -> StereoDrive:
    """Return the drive as one that has a stereo partner.

    Raises:
        DataError: if it has none.
    """
    if not isinstance(drive, StereoDrive):
        raise DataError(
            f"'{drive.name}' is the recording of one camera, so it has no stereo partner; "
            "set data.stereo=false, or use data of two calibrated cameras"
        )
    return drive


def partner_frames(drive: Drive) -> frozenset[int]:
    """Return the numbers of the frames that the stereo partner has too.

    Raises:
        DataError: if the drive has no partner.
    """
    return frozenset(stereo_drive(drive).partner().indices)


def partner_image(drive: Drive, index: int) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Return the stereo partner's frame, h x w x 3, RGB, and T_partner_cam, 4 x 4, meters.

    Raises:
        DataError: if the drive has no partner, or the two cameras do not share their intrinsics.
    """
    pair = stereo_drive(drive)
    partner = pair.partner()
    K, other = drive.intrinsics(index), partner.intrinsics(index)
    if np.abs(K - other).max() > _SAME_K:
        raise DataError(
            f"'{drive.name}' and its partner '{partner.name}' have different intrinsics ({_short(K)} and "
            f"{_short(other)}); a stereo source needs rectified images of one K"
        )
    return partner.image(index), pair.T_partner_cam


def measured_distance(drive: Drive, first: int, second: int) -> float:
    """Return the meters traveled between two frames as the recording itself knows them; NaN where it does not."""
    known = drive.distance(first, second) if isinstance(drive, MeasuredDrive) else None
    return math.nan if known is None else known


def distance_between(T_world_first: NDArray[np.float64], T_world_second: NDArray[np.float64]) -> float:
    """Return the straight way between two poses, 4 x 4, meters."""
    return float(np.linalg.norm(T_world_second[:3, 3] - T_world_first[:3, 3]))


def _short(K: NDArray[np.float64]) -> str:
    return f"fx {K[0, 0]:.1f}, cx {K[0, 2]:.1f}, cy {K[1, 2]:.1f}"
