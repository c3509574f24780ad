"""Camera motion against true poses: the published 5-frame error, whole trajectories, KITTI's relative errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Float64, Int
from numpy import ndarray

from saunet.errors import ConfigError, DataError, one_of, positive

KITTI_LENGTHS: tuple[float, ...] = (100, 200, 300, 400, 500, 600, 700, 800)
"""Segment lengths in meters that KITTI averages over."""


@dataclass(frozen=True, slots=True)
class SnippetErrors:
    """Errors of short pieces of a trajectory, each with its own scale."""

    errors: Float64[ndarray, " n"]
    """Meters, one a snippet."""
    points: Int[ndarray, " n"]
    """Positions in each; the last snippets of a sequence are shorter."""

    @property
    def mean(self) -> float:
        """Mean over snippets, as published."""
        return float(self.errors.mean())

    @property
    def std(self) -> float:
        """Standard deviation over snippets, as published."""
        return float(self.errors.std())


@dataclass(frozen=True, slots=True)
class Similarity:
    """A transform of positions: ``scale * rotation @ x + translation``."""

    scale: float
    rotation: Float64[ndarray, "3 3"]
    translation: Float64[ndarray, "3"]

    def positions(self, xyz: Float64[ndarray, "n 3"]) -> Float64[ndarray, "n 3"]:
        """Return transformed positions."""
        moved: ndarray = self.scale * xyz @ self.rotation.T + self.translation
        return moved

    def poses(self, T_world_cam: Float64[ndarray, "n 4 4"]) -> Float64[ndarray, "n 4 4"]:
        """Return poses whose positions are transformed and whose orientations are rotated; they stay rigid."""
        moved = T_world_cam.copy()
        moved[:, :3, :3] = self.rotation @ T_world_cam[:, :3, :3]
        moved[:, :3, 3] = self.positions(T_world_cam[:, :3, 3])
        return moved


@dataclass(frozen=True, slots=True)
class SegmentErrors:
    """KITTI's relative errors, averaged over all segments of all lengths."""

    t_rel: float
    """Translation error in percent of the distance driven; NaN if no segment fits."""
    r_rel: float
    """Rotation error in degrees per 100 meters; NaN if no segment fits."""
    segments: int
    """How many segments were averaged."""


def check_snippet(length: int) -> None:
    """Check the number of frames in a snippet."""
    if length < 2:
        raise ConfigError(f"snippet is {length}; it counts frames and must be at least 2 (published numbers use 5)")


def check_lengths(lengths: Sequence[float | int]) -> None:
    """Check the lengths of segments."""
    for length in lengths:
        positive("lengths", length)


def relative_motions(T_world_cam: Float64[ndarray, "n 4 4"]) -> Float64[ndarray, "n-1 4 4"]:
    """Return the motions from each camera to the next: ``T_next_cam`` maps points of frame i to frame i + 1."""
    motions: ndarray = np.linalg.inv(T_world_cam[1:]) @ T_world_cam[:-1]
    return motions


def chain_motions(T_next_cam: Float[ndarray, "m 4 4"]) -> Float64[ndarray, "m+1 4 4"]:
    """Return the trajectory ``T_world_cam`` of motions from each camera to the next; the world is the first camera."""
    poses = [np.eye(4)]
    for back in np.linalg.inv(T_next_cam.astype(np.float64)):
        poses.append(poses[-1] @ back)
    return np.stack(poses)


def snippet_ate(predicted: Float[ndarray, "p 4 4"], true: Float[ndarray, "m 4 4"], length: int = 5) -> SnippetErrors:
    """Compute the 5-frame trajectory error as Zhou et al. and Monodepth2 publish it.

    A snippet starts at every frame but the last. Its matrices are chained directly from the identity (not their
    inverses), first positions coincide, one scale a snippet comes from least squares, and the error is the root of the
    SUM of squared distances divided by the number of positions: not a usual ATE, but what published numbers are.

    Args:
        predicted: ``T_next_cam``, each mapping points of frame i to frame i + 1, translation up to scale.
        true: The same from true poses (`relative_motions`).
        length: Positions in a snippet.

    Raises:
        ConfigError: if a snippet has fewer than two positions.
        DataError: if there is no motion, or their numbers differ.
    """
    check_snippet(length)
    _same_length(predicted, true, "motions", at_least=1)
    errors, points = [], []
    for start in range(len(true)):
        pieces = (motions[start : start + length - 1] for motions in (predicted, true))
        ours, theirs = (_direct_positions(piece.astype(np.float64)) for piece in pieces)
        energy = float((ours**2).sum())
        # A camera predicted not to move has no scale; every scale leaves it at the origin.
        scale = float((theirs * ours).sum()) / energy if energy > 0 else 0.0
        errors.append(np.sqrt(((scale * ours - theirs) ** 2).sum()) / len(theirs))
        points.append(len(theirs))
    return SnippetErrors(np.array(errors, dtype=np.float64), np.array(points))


def umeyama(source: Float64[ndarray, "p 3"], target: Float64[ndarray, "n 3"], *, with_scale: bool = True) -> Similarity:
    """Find the similarity that brings positions closest to others, in least squares (Umeyama, 1991).

    Args:
        source: Positions to move.
        target: Where they should be, in the same order.
        with_scale: Seven degrees of freedom instead of six.

    Raises:
        DataError: if there are fewer than two positions, or their numbers differ.
    """
    _same_length(source, target, "positions", at_least=2)
    source_mean, target_mean = source.mean(0), target.mean(0)
    centerd, goal = source - source_mean, target - target_mean
    U, singular, Vt = np.linalg.svd(goal.T @ centerd / len(source))
    sign = np.ones(3)
    if np.linalg.det(U) * np.linalg.det(Vt) < 0:
        sign[2] = -1  # a rotation, not a reflection
    rotation = (U * sign) @ Vt
    variance = float((centerd**2).sum() / len(source))
    scale = float((singular * sign).sum()) / variance if with_scale and variance > 0 else 1.0
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)


def align_trajectory(
    predicted: Float64[ndarray, "p 4 4"],
    true: Float64[ndarray, "n 4 4"],
    mode: Literal["sim3", "se3", "scale", "none"] = "sim3",
) -> Similarity:
    """Find the transform that brings a predicted trajectory onto the true one.

    Args:
        predicted: ``T_world_cam`` in any world, up to scale.
        true: ``T_world_cam`` in meters.
        mode: ``sim3`` rotation, translation and scale; ``se3`` without scale; ``scale`` first poses coincide and one
            scale is fitted; ``none`` first poses coincide.

    Raises:
        ConfigError: for another mode.
        DataError: if there are fewer than two poses, or their numbers differ.
    """
    one_of("mode", mode, ("sim3", "se3", "scale", "none"))
    _same_length(predicted, true, "poses", at_least=2)
    ours, theirs = predicted[:, :3, 3], true[:, :3, 3]
    if mode in ("sim3", "se3"):
        return umeyama(ours, theirs, with_scale=mode == "sim3")
    rotation = true[0, :3, :3] @ predicted[0, :3, :3].T
    ahead, goal = (ours - ours[0]) @ rotation.T, theirs - theirs[0]
    energy = float((ahead**2).sum())
    scale = float((ahead * goal).sum()) / energy if mode == "scale" and energy > 0 else 1.0
    return Similarity(scale, rotation, theirs[0] - scale * rotation @ ours[0])


def trajectory_ate(
    predicted: Float64[ndarray, "p 4 4"],
    true: Float64[ndarray, "n 4 4"],
    mode: Literal["sim3", "se3", "scale", "none"] = "sim3",
) -> float:
    """Compute the root mean square distance of positions in meters after alignment; arguments as `align_trajectory`."""
    aligned = align_trajectory(predicted, true, mode).positions(predicted[:, :3, 3])
    return float(np.sqrt(((aligned - true[:, :3, 3]) ** 2).sum(1).mean()))


def segment_errors(
    predicted: Float64[ndarray, "p 4 4"],
    true: Float64[ndarray, "n 4 4"],
    lengths: Sequence[float] = KITTI_LENGTHS,
    step: int = 10,
) -> SegmentErrors:
    """Compute KITTI's t_rel and r_rel (Geiger et al., 2012) over segments of the true path.

    Monocular predictions need their scale first: pass ``align_trajectory(predicted, true).poses(predicted)``.

    Args:
        predicted: ``T_world_cam`` in meters, in any world.
        true: ``T_world_cam`` in meters.
        lengths: Segment lengths in meters along the true path; a short sequence wants shorter ones than KITTI's.
        step: A segment of each length starts at every ``step``-th frame.

    Raises:
        ConfigError: if a length is not above 0.
        DataError: if there are fewer than two poses, or their numbers differ.
    """
    check_lengths(lengths)
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


def _direct_positions(motions: Float64[ndarray, "m 4 4"]) -> Float64[ndarray, "m+1 3"]:
    pose, xyz = np.eye(4), [np.zeros(3)]
    for motion in motions:
        pose = pose @ motion
        xyz.append(pose[:3, 3])
    return np.stack(xyz)


def _same_length(predicted: ndarray, true: ndarray, what: str, at_least: int) -> None:
    if len(predicted) != len(true) or len(true) < at_least:
        raise DataError(
            f"{len(predicted)} predicted and {len(true)} true {what}; give equally many, at least {at_least}"
        )
