"""The poses of a rig's cameras, from pictures in which two of them see the same board."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from saunet.errors import DataError
from saunet.tools.calibrate.solve import FEWEST_CORNERS, FEWEST_VIEWS, BoardView, Calibration


@dataclass(frozen=True)
class Placement:
    """Pose of a rig's camera relative to the previous camera."""

    T: NDArray[np.float64]
    """T_this_before, 4 x 4, meters: maps points of the previous camera to this one."""
    error: float
    """Root mean square reprojection error of both cameras, pixels."""
    deviation: float
    """Standard deviation of its position in meters, by leaving out pictures."""
    pairs: int
    """Number of pictures in which both saw the board."""

    def __str__(self) -> str:
        turn = float(np.degrees(np.linalg.norm(cv2.Rodrigues(self.T[:3, :3])[0])))
        distance = float(np.linalg.norm(self.T[:3, 3]))
        return (
            f"{distance:.4f} m away (known to within {1000 * self.deviation:.2g} mm), turned by {turn:.2f} degrees; "
            f"error {self.error:.3f} px in {self.pairs} pairs"
        )


def place(before: Calibration, after: Calibration) -> Placement:
    """Find the pose of a camera relative to another one, from pictures in which both see the board.

    Views are undistorted with the calibrated lenses first, so any two can be paired.
    """
    if before.looked_at != after.looked_at:
        raise DataError(
            f"{before.camera.path} has {before.looked_at} pictures but {after.camera.path} has {after.looked_at}; "
            "the cameras of a rig need equally many, taken at the same moments"
        )
    others, pairs = {view.number: view for view in after.found}, []
    for view in before.found:
        other = others.get(view.number)
        if other is None:
            continue
        known = {tuple(point): place for place, point in enumerate(np.round(other.points, 6).tolist())}
        both = [(n, known[p]) for n, p in enumerate(map(tuple, np.round(view.points, 6).tolist())) if p in known]
        if len(both) >= FEWEST_CORNERS:
            ours, theirs = (np.array(each) for each in zip(*both, strict=True))
            pairs.append((view.points[ours], _straight(before, view, ours), _straight(after, other, theirs)))
    if len(pairs) < FEWEST_VIEWS:
        raise DataError(
            f"{len(pairs)} pictures show the board to both {before.camera.path} and {after.camera.path}; at least "
            f"{FEWEST_VIEWS} are required: film it where their views overlap"
        )
    focals = [float(each.camera.K[0, 0]) for each in (before, after)]
    error, T = _stereo(pairs, focals)
    groups = min(8, len(pairs))
    shifts = np.array(
        [_stereo([p for n, p in enumerate(pairs) if n % groups != g], focals)[1][:3, 3] for g in range(groups)]
    )
    deviation = float(np.sqrt((groups - 1) / groups * ((shifts - shifts.mean(0)) ** 2).sum()))  # jackknife
    return Placement(T, error, deviation, len(pairs))


def _straight(result: Calibration, view: BoardView, chosen: NDArray[np.int64]) -> NDArray[np.float32]:
    """Return corners as an ideal camera with the focal length fx and its center at 0 shows them."""
    camera, pixels = result.camera, view.pixels[chosen].reshape(-1, 1, 2).astype(np.float64)
    undistort: Any = cv2.fisheye.undistortPoints if camera.model == "fisheye" else cv2.undistortPoints
    return np.asarray(undistort(pixels, camera.K, np.array(camera.distortion)) * camera.K[0, 0], np.float32)


def _stereo(pairs: Sequence[Any], focals: Sequence[float]) -> tuple[float, NDArray[np.float64]]:
    points, ours, theirs = zip(*pairs, strict=True)
    first, second = (np.diag([focal, focal, 1.0]) for focal in focals)
    lenses = first, np.zeros(5), second, np.zeros(5)
    found = cv2.stereoCalibrate(points, ours, theirs, *lenses, (1, 1), flags=cv2.CALIB_FIX_INTRINSIC)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = found[5], np.ravel(found[6])
    return float(found[0]), T
