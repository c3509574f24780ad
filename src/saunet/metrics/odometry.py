"""Camera motion against true poses: the published 5-frame error, whole trajectories, KITTI's relative errors."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64
from numpy import ndarray

from saunet.errors import DataError

KITTI_LENGTHS: tuple[float, ...] = (100, 200, 300, 400, 500, 600, 700, 800)
"""Segment lengths in meters that KITTI averages over."""


@dataclass(frozen=True, slots=True)
class Similarity:
    """A transform of positions: ``scale * rotation @ x + translation``."""

    scale: float
    rotation: Float64[ndarray, "3 3"]
    translation: Float64[ndarray, "3"]

    def positions(self, xyz: Float64[ndarray, "n 3"]) -> Float64[ndarray, "n 3"]:
        moved: ndarray = self.scale * xyz @ self.rotation.T + self.translation
        return moved

    def poses(self, T_world_cam: Float64[ndarray, "n 4 4"]) -> Float64[ndarray, "n 4 4"]:
        """Return poses whose positions are transformed and whose orientations are rotated; they stay rigid."""
        moved = T_world_cam.copy()
        moved[:, :3, :3] = self.rotation @ T_world_cam[:, :3, :3]
        moved[:, :3, 3] = self.positions(T_world_cam[:, :3, 3])
        return moved


class SegmentErrors(NamedTuple):
    """KITTI's relative errors, means over all segments of all lengths; NaN if no segment fits."""

    t_rel: float
    """Translation error in percent of the distance driven."""
    r_rel: float
    """Rotation error in degrees per 100 meters."""
    segments: int


def relative_motions(T_world_cam: Float64[ndarray, "n 4 4"]) -> Float64[ndarray, "n-1 4 4"]:
    """Return the motions from each camera to the next: ``T_next_cam`` maps points of frame i to frame i + 1."""
    motions: ndarray = np.linalg.inv(T_world_cam[1:]) @ T_world_cam[:-1]
    return motions


def chain_motions(T_next_cam: Float[ndarray, "m 4 4"]) -> Float64[ndarray, "m+1 4 4"]:
    """Return the trajectory ``T_world_cam`` of motions from each camera to the next; the world is the first camera."""
    return _chained(np.linalg.inv(T_next_cam.astype(np.float64)))


def snippet_ate(
    predicted: Float[ndarray, "p 4 4"], true: Float[ndarray, "m 4 4"], length: int = 5
) -> Float64[ndarray, " m"]:
    """Compute the error in meters of each snippet; Zhou et al. and Monodepth2 publish their mean and deviation.

    A snippet starts at every frame but the last, so the last ones are shorter. Its matrices ``T_next_cam`` are chained
    directly from the identity (not their inverses), first positions coincide, each snippet's scale comes from least
    squares, and the error is the root of the SUM of squared distances divided by the number of positions. That is not
    the usual ATE, but published numbers are computed this way.
    """
    _same_length(predicted, true, "motions", at_least=1)
    errors = []
    for start in range(len(true)):
        pieces = (motions[start : start + length - 1] for motions in (predicted, true))
        ours, theirs = (_chained(piece.astype(np.float64))[:, :3, 3] for piece in pieces)
        energy = float((ours**2).sum())
        # A camera predicted to stand still has no scale; every scale leaves it at the origin.
        scale = float((theirs * ours).sum()) / energy if energy > 0 else 0.0
        errors.append(np.sqrt(((scale * ours - theirs) ** 2).sum()) / len(theirs))
    return np.array(errors, dtype=np.float64)


def umeyama(source: Float64[ndarray, "p 3"], target: Float64[ndarray, "n 3"]) -> Similarity:
    """Find the similarity that brings positions closest to others, in least squares (Umeyama, 1991)."""
    _same_length(source, target, "positions", at_least=2)
    source_mean, target_mean = source.mean(0), target.mean(0)
    centered, goal = source - source_mean, target - target_mean
    U, singular, Vt = np.linalg.svd(goal.T @ centered / len(source))
    sign = np.ones(3)
    if np.linalg.det(U) * np.linalg.det(Vt) < 0:
        sign[2] = -1  # a rotation, not a reflection
    rotation = (U * sign) @ Vt
    variance = float((centered**2).sum() / len(source))
    scale = float((singular * sign).sum()) / variance if variance > 0 else 1.0
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)


def trajectory_ate(predicted: Float64[ndarray, "p 4 4"], true: Float64[ndarray, "n 4 4"]) -> float:
    """Compute the root mean square distance of positions in meters after 7-DoF alignment."""
    ours, theirs = predicted[:, :3, 3], true[:, :3, 3]
    aligned = umeyama(ours, theirs).positions(ours)
    return float(np.sqrt(((aligned - theirs) ** 2).sum(1).mean()))


def segment_errors(
    predicted: Float64[ndarray, "p 4 4"],
    true: Float64[ndarray, "n 4 4"],
    lengths: Sequence[float] = KITTI_LENGTHS,
    step: int = 10,
) -> SegmentErrors:
    """Compute KITTI's t_rel and r_rel (Geiger et al., 2012) over segments of the true path.

    Both paths are ``T_world_cam`` in meters, so monocular predictions need their scale first. A segment of each length
    starts at every ``step``-th frame.
    """
    _same_length(predicted, true, "poses", at_least=2)
    driven = np.concatenate(([0.0], np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).cumsum()))
    translations, rotations = [], []
    for first in range(0, len(true), step):
        for length in lengths:
            last = int(np.searchsorted(driven, driven[first] + length, side="right"))
            if last == len(true):
                continue
            ours, theirs = (np.linalg.inv(poses[first]) @ poses[last] for poses in (predicted, true))
            error = np.linalg.inv(ours) @ theirs
            cosine = np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1)
            translations.append(np.linalg.norm(error[:3, 3]) / length)
            rotations.append(np.arccos(cosine) / length)
    if not translations:
        return SegmentErrors(float("nan"), float("nan"), 0)
    t_rel, r_rel = 100 * float(np.mean(translations)), 100 * float(np.degrees(np.mean(rotations)))
    return SegmentErrors(t_rel, r_rel, len(translations))


def _chained(steps: Float64[ndarray, "m 4 4"]) -> Float64[ndarray, "m+1 4 4"]:
    """Return the products of the first 0, 1, ... m matrices."""
    return np.stack(list(itertools.accumulate(steps, np.matmul, initial=np.eye(4))))


def _same_length(predicted: ndarray, true: ndarray, what: str, at_least: int) -> None:
    if len(predicted) != len(true) or len(true) < at_least:
        raise DataError(
            f"{len(predicted)} predicted and {len(true)} true {what}; give equally many, at least {at_least}"
        )
