"""Camera motion between two frames from points tracked from one to the other: no network, and no training."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy.typing import NDArray

F64 = NDArray[np.float64]

_FEWEST = 30
"""Fewest points for a motion."""
_STILL, _PARALLAX = 0.0006, 0.0015
"""Shifts in picture widths: the camera stands still below this median; the smallest shift that gives a distance."""
_NOTHING = (np.zeros((0, 2)), np.zeros(0))
_OFF = 0.0008
"""Points off by more than this, in picture widths, do not belong to the motion."""


class TrackedMotion(NamedTuple):
    """A motion up to its length, and the points that determine the length."""

    T_src_tgt: Float[F64, "4 4"]
    """The translation is a direction of length 1, or 0 if the camera only turned or stood still."""
    points: Float[F64, "n 2"]
    """Pixels in the target of the points with a known distance."""
    depth: Float[F64, " n"]
    """Their depth, camera z, in lengths of the translation."""


def tracked_motion(
    target: UInt8[NDArray[np.uint8], "h w 3"],
    source: UInt8[NDArray[np.uint8], "h w 3"],
    K: Float[F64, "3 3"],
) -> TrackedMotion | None:
    """Return the camera's motion from the target to the source, up to its length.

    Corners are tracked back and forth with Lucas and Kanade's method. The five-point method (Nister 2004) with MAGSAC
    (Barath et al. 2019), both from OpenCV, gives rotation and direction without any depth. So they are right from the
    first training step on, and a turn is never mistaken for a sideways motion.

    Args:
        target: RGB.
        source: RGB.
        K: Intrinsics of both, pixels.

    Returns:
        None if too few points can be tracked.
    """
    width = target.shape[1]
    points = _follow(_gray(target), _gray(source))
    if points is None:
        return None
    start, end = points
    if np.median(np.linalg.norm(end - start, axis=1)) < _STILL * width:
        return TrackedMotion(np.eye(4), *_NOTHING)
    rays = np.linalg.solve(K, np.c_[start, np.ones(len(start))].T).T
    seen = np.linalg.solve(K, np.c_[end, np.ones(len(end))].T).T
    T = np.eye(4)
    T[:3, :3] = _turn(rays, seen)
    off = _shift(rays, seen, T[:3, :3]) * K[0, 0]
    if np.median(off) < _OFF * width:
        # Every direction then gives an epipolar geometry, and the result would be random.
        return TrackedMotion(T, *_NOTHING)
    essential, mask = cv2.findEssentialMat(start, end, K, method=cv2.USAC_MAGSAC, prob=0.999, threshold=_OFF * width)
    if essential is None or essential.shape[0] < 3:
        return None
    agree = mask[:, 0] > 0
    if agree.sum() < _FEWEST:
        return None
    _, turn, direction, _ = cv2.recoverPose(essential[:3], start, end, K, mask=mask.copy())
    R = np.asarray(turn, np.float64)
    T[:3, :3], T[:3, 3] = R, direction[:, 0]
    # seen ~ z turned + direction, so that z (seen x turned) = -(seen x direction)
    across, along = np.cross(seen, rays @ R.T), np.cross(seen, T[:3, 3])
    z = -(across * along).sum(1) / (across * across).sum(1).clip(1e-18)
    use = agree & (z > 0) & (_shift(rays, seen, R) * K[0, 0] >= _PARALLAX * width)
    return TrackedMotion(T, start[use], z[use]) if use.sum() >= _FEWEST // 2 else None


def _shift(rays: F64, seen: F64, R: F64) -> F64:
    """Return the distance of points from their positions without a translation, on the plane z = 1."""
    turned = rays @ R.T
    off: F64 = np.linalg.norm(seen[:, :2] / seen[:, 2:] - turned[:, :2] / turned[:, 2:], axis=1)
    return off


def _turn(rays: F64, seen: F64) -> F64:
    """Return the rotation that takes most rays to those seen (Kabsch 1976, with Cauchy's weights)."""
    first, second = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in (rays, seen))
    R, weight = np.eye(3), np.ones(len(rays))
    for _ in range(10):
        u, _, v = np.linalg.svd((second * weight[:, None]).T @ first)
        R = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
        off = np.linalg.norm(second - first @ R.T, axis=1)
        weight = 1 / (1 + (off / max(float(np.median(off)), 1e-9)) ** 2)
    return R


def _gray(image: UInt8[NDArray[np.uint8], "h w 3"]) -> UInt8[NDArray[np.uint8], "h w"]:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)


def _follow(
    first: UInt8[NDArray[np.uint8], "h w"], second: UInt8[NDArray[np.uint8], "h w"]
) -> tuple[Float[F64, "n 2"], Float[F64, "n 2"]] | None:
    corners: Any = cv2.goodFeaturesToTrack(first, 1000, 0.003, 4)
    if corners is None:
        return None
    start = np.asarray(corners, np.float32).reshape(-1, 1, 2)
    end, good = follow(first, second, start, tolerance=0.5)
    if good.sum() < _FEWEST:
        return None
    return start[good, 0].astype(np.float64), end[good, 0].astype(np.float64)


def follow(
    first: UInt8[NDArray[np.uint8], "h w"],
    second: UInt8[NDArray[np.uint8], "h w"],
    points: NDArray[np.float32],
    *,
    tolerance: float,
    margin: int = 0,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Track points (n 1 2) with Lucas and Kanade's method from one gray picture to another, and back.

    Returns:
        Their positions, and which are reliable: those that return to within ``tolerance`` pixels and are inside the
        picture by more than ``margin``.
    """
    flow: Any = functools.partial(cv2.calcOpticalFlowPyrLK, nextPts=None, winSize=(15, 15), maxLevel=4)
    moved = flow(first, second, points)[0]
    back = flow(second, first, moved)[0]
    last = np.array(second.shape[::-1]) - 1 - margin
    inside = (moved[:, 0] > margin).all(1) & (moved[:, 0] < last).all(1)
    return moved, inside & (np.linalg.norm((back - points)[:, 0], axis=1) < tolerance)
