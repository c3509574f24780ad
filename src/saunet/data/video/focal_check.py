"""Whether a given camera fits a drive: its focal length against the one estimated from turns.

Distortion is in units of focal lengths, so a wrong focal length straightens wrongly, and the bend that this leaves
makes another one look right. So points are followed in the pictures as recorded and straightened for one supposed focal
length after another, until the windows say the one that they were straightened with.
"""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from saunet.data.drive import LensModel
from saunet.data.video.focal import F64, FocalEstimate, Tracked, solve_points, solve_together, turning_most
from saunet.data.video.lens_models import seen_rays

_SETTLED = 0.03
"""Logarithm of the ratio of two focal lengths from which they straighten alike."""
_STARTS = (1.0, None, 1.25)
"""Focal lengths that are supposed first, as factors of the given one: itself; what the pictures as recorded say (None);
and a longer one, as many lenses fold back inside the picture when it is too short."""
_ROUGHLY = 0.2
"""Uncertainty up to which a focal length is worth supposing."""
_ROUNDS = 3
"""Focal lengths that are supposed after each of them."""


def check_focal(
    windows: Iterable[Sequence[NDArray[np.uint8]]], lens: LensModel, width: int, most: int, seconds: float = math.inf
) -> FocalEstimate | None:
    """Estimate the focal length from windows of gray frames as recorded, given what the lens is said to be.

    Args:
        windows: Frames (height, width) of one size, which may be smaller than that of K.
        lens: Its center and pixel aspect ratio are trusted.
        width: Width of the pictures of its K, pixels.
        most: Number of windows to solve: those with the strongest turns.
        seconds: Processor time to spend. Once it is used up, only the minimum of windows is solved, but a contradiction
            is still checked again.

    Returns:
        The estimate, to compare with ``lens.K[0, 0] / width``; None if no window has enough points to track.
    """
    until = time.process_time() + seconds
    return settled(turning_most(windows, most, until - seconds / 2), lens, width, until)


def settled(tracked: Sequence[Tracked], lens: LensModel, width: int, until: float = math.inf) -> FocalEstimate | None:
    """Return what tracked windows say through a lens, once they agree with the focal length it was scaled to.

    If they never do, what they say of the pictures as recorded counts, whose lens is searched for like an unknown one.
    """

    def through(factor: float | None, until: float = math.inf) -> FocalEstimate | None:
        """Look through the lens with a factor to the focal length that is given; through none if that is None."""
        solvers = []
        for pixels, known, (_, columns) in tracked:
            x, use = _straight((pixels + 0.5) * width / columns - 0.5, known, lens, factor)
            solvers.append(functools.partial(solve_points, x / width, use, columns))
        return solve_together(solvers, until, free_center=False)

    given, found, recorded = float(lens.K[0, 0]) / width, through(1.0, until), None
    late = found is not None and found.bend is None and time.process_time() > until
    if late or (lens.model == "pinhole" and not any(lens.coefficients)):
        return found
    for start in _STARTS:
        factor: float | None = start
        if start != 1.0:
            found = through(start)
        if start is None:
            recorded = found
        for _ in range(_ROUNDS):
            if found is None or found.bend is None or found.windows < 3 or not found.uncertainty < _ROUGHLY:
                break
            if factor is not None and found.tells and abs(math.log(found.focal / given / factor)) < _SETTLED:
                return found
            factor = found.focal / given
            found = through(factor)
    return recorded


def _straight(
    pixels: F64, known: NDArray[np.bool_], lens: LensModel, factor: float | None
) -> tuple[F64, NDArray[np.bool_]]:
    """Return points from the center with square pixels, straightened if a factor of the focal length is supposed."""
    K = lens.K.copy()
    if factor is None:
        rays = seen_rays("pinhole", (), K, pixels)
    else:
        K[:2, :2] *= factor
        rays = seen_rays(lens.model, lens.coefficients, K, pixels)
    use: NDArray[np.bool_] = np.logical_and.accumulate(known & np.isfinite(rays[..., 0]), axis=1)
    return np.where(use[..., None], rays[..., :2] * K[0, 0], 0.0), use
