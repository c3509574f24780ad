"""A predicted path: how far off it is (snippets, aligned, KITTI's relative errors), its files, its picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from saunet.data.drive import Drive
from saunet.evaluation.files import without_nan
from saunet.io.atomic import write_bytes, write_json
from saunet.io.trajectories import write_kitti, write_tum
from saunet.metrics.odometry import (
    KITTI_LENGTHS,
    Similarity,
    align_trajectory,
    relative_motions,
    segment_errors,
    snippet_ate,
    trajectory_ate,
)
from saunet.tables import Column, Row, Table, csv_text
from saunet.tables.drawing import new_figure, save

_RED = "tab:red"
PUBLISHED_SNIPPET = 5
"""Frames in a snippet of the published numbers."""
MODEL = "pose network"
STRAIGHT = "constant motion straight ahead"


@dataclass(frozen=True, slots=True)
class PathErrors:
    """One predicted path against the true one."""

    sequence: str
    predictor: str
    """`MODEL`, or `STRAIGHT`, which looks at no image."""
    frames: int
    meters: float
    """Length of the true path."""
    snippet: int
    """Frames in a snippet."""
    snippet_ate: float
    """Mean error of snippets in meters, each with its own scale; of five frames as published (Zhou et al.)."""
    snippet_std: float
    """Its standard deviation over snippets."""
    ate: float
    """Root mean square distance of positions in meters after 7-DoF alignment of the whole path."""
    scale: float
    """Meters a unit of the prediction: the scale of that alignment."""
    turn: float
    """Degrees by which that alignment turned the path; see `Path3d.turn`."""
    t_rel: float
    """KITTI's translation error after that alignment, percent; NaN if no segment fits into the path."""
    r_rel: float
    """KITTI's rotation error, degrees per 100 m; NaN if no segment fits."""
    segments: int
    """How many segments these are the mean of."""
    lengths: tuple[float, ...]
    """Their lengths in meters; other than KITTI's where its shortest, 100 m, does not fit."""


@dataclass(frozen=True)
class Path3d:
    """A predicted path, with the true one where it is known."""

    sequence: str
    predicted: Float64[ndarray, "n 4 4"]
    """``T_world_cam``; the world is the first camera, the scale the network's own."""
    times: Float64[ndarray, " n"] | None = None
    """Seconds of each frame; None if the recording does not know them."""
    true: Float64[ndarray, "n 4 4"] | None = None
    """``T_world_cam`` in meters."""
    predictor: str = MODEL

    @property
    def alignment(self) -> Similarity:
        """The similarity that brings the prediction onto the truth; nothing moves where there is no truth."""
        if self.true is None:
            return Similarity(1.0, np.eye(3), np.zeros(3))
        return align_trajectory(self.predicted, self.true)

    @property
    def turn(self) -> float:
        """Degrees by which the alignment turns the path, against one on which the first cameras coincide.

        A network that takes sideways for ahead on a straight road has a small error after alignment, and this says
        why. Positions weigh by their squared distance from the middle, so that a roll about a straight road, which
        the alignment may choose freely, does not count. 0 without a truth.
        """
        if self.true is None:
            return 0.0
        centered = self.predicted[:, :3, 3] - self.predicted[:, :3, 3].mean(0)
        driven = centered @ (self.true[0, :3, :3] @ self.predicted[0, :3, :3].T).T
        aligned = centered @ self.alignment.rotation.T
        energy = float((centered**2).sum())
        return float(np.degrees(np.arccos(np.clip((driven * aligned).sum() / energy, -1, 1)))) if energy > 0 else 0.0

    @property
    def aligned(self) -> Float64[ndarray, "n 4 4"]:
        """The predicted poses, aligned."""
        return self.alignment.poses(self.predicted)


def path_of(drive: Drive, predicted: Float64[ndarray, "n 4 4"]) -> Path3d:
    """Return a predicted path beside what its recording knows of all frames: when they were taken, and true poses."""
    times = drive.timestamps
    poses = [pose for number in drive.indices if (pose := drive.pose(number)) is not None]
    return Path3d(
        drive.name,
        predicted,
        None if times is None or np.isnan(times).any() else times,
        np.stack(poses) if len(poses) == len(predicted) else None,
    )


def straight_ahead(path: Path3d) -> Path3d:
    """Return the path of a camera that moves by one unit along its axis from each frame to the next.

    It looks at no image: a network that does not beat it has learned nothing about motion.
    """
    poses = np.tile(np.eye(4), (len(path.predicted), 1, 1))
    poses[:, 2, 3] = np.arange(len(poses))
    return replace(path, predicted=poses, predictor=STRAIGHT)


def path_errors(path: Path3d, snippet: int = 5, lengths: Sequence[float] | None = None) -> PathErrors:
    """Compute the errors of a path whose truth is known."""
    true = path.true
    assert true is not None, "errors need the true path"
    meters = float(np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).sum())
    chosen = tuple(float(length) for length in lengths or KITTI_LENGTHS)
    if lengths is None and 0 < meters <= min(KITTI_LENGTHS):
        chosen = tuple(round(share * meters, 1) for share in (0.2, 0.4, 0.6, 0.8))
    snippets = snippet_ate(relative_motions(path.predicted), relative_motions(true), snippet)
    relative = segment_errors(path.aligned, true, chosen, step=10 if len(true) > 100 else 1)
    return PathErrors(
        path.sequence,
        path.predictor,
        len(true),
        meters,
        snippet,
        snippets.mean,
        snippets.std,
        trajectory_ate(path.predicted, true),
        path.alignment.scale,
        path.turn,
        relative.t_rel,
        relative.r_rel,
        relative.segments,
        chosen,
    )


def path_table(errors: Sequence[PathErrors]) -> Table:
    """Return one line per sequence and predictor."""
    snippet = errors[0].snippet
    columns = (
        Column("sequence"),
        Column("frames"),
        Column("path m", ".1f"),
        Column(f"{snippet}-frame ATE m"),
        Column("ATE m", ".3f"),
        Column("scale", ".3g"),
        Column("turned °", ".0f"),
        Column("t_rel %", ".2f"),
        Column("r_rel °/100m", ".2f"),
    )
    rows = []
    for one in errors:
        trivial = one.predictor == STRAIGHT
        about = (one.predictor, "", "") if trivial else (one.sequence, one.frames, one.meters)
        numbers = (one.ate, one.scale, one.turn, one.t_rel, one.r_rel)
        told = f"{one.snippet_ate:.4f} ± {one.snippet_std:.4f}"
        rows.append(Row((*about, told, *numbers), "dim" if trivial else "plain"))
    published = "as published" if snippet == PUBLISHED_SNIPPET else f"published numbers use {PUBLISHED_SNIPPET} frames"
    notes = [f"{snippet}-frame ATE: own scale per snippet, {published}; the rest after 7-DoF alignment"]
    lengths = [f"{row.lengths[0]:g} to {row.lengths[-1]:g} m" for row in errors if row.segments]
    if lengths:
        notes.append(f"t_rel and r_rel over segments of {', '.join(sorted(set(lengths)))}")
    bare = {row.sequence: row for row in errors if not row.segments}
    notes += [
        f"no segment of {min(row.lengths):g} m or more fits into the {row.meters:.1f} m of {name}"
        for name, row in bare.items()
    ]
    title = "odometry: the path of the camera from the pose network"
    return Table("odometry", title, columns, tuple(rows), tuple(notes))


def write_path(path: Path3d, folder: Path) -> None:
    """Write a path as predicted and, with a truth, aligned to it and the truth itself.

    In KITTI's format, and in TUM's if the recording knows its times.
    """
    kinds = {"predicted": path.predicted}
    if path.true is not None:
        kinds |= {"aligned": path.aligned, "true": path.true}
    for kind, poses in kinds.items():
        write_kitti(folder / f"{kind}_kitti.txt", poses)
        if path.times is not None:
            write_tum(folder / f"{kind}_tum.txt", poses, path.times)


def write_errors(errors: Sequence[PathErrors], folder: Path, settings: dict[str, object]) -> None:
    """Write ``odometry.json`` and ``odometry.csv``, one entry per sequence and predictor."""
    rows: list[dict[str, object]] = [without_nan(asdict(row)) for row in errors]
    write_json(folder / "odometry.json", {"settings": settings, "results": rows})
    if rows:
        lines = ({**asdict(row), "lengths": " ".join(map(str, row.lengths))}.values() for row in errors)
        write_bytes(folder / "odometry.csv", csv_text(list(rows[0]), map(tuple, lines)).encode())


def draw_path(path: Path3d, file: Path, errors: Sequence[PathErrors] = ()) -> None:
    """Draw a path from above and, where the true one is known, both and the distance between them."""
    known = path.true is not None
    figure, (above, *more) = new_figure(1 + known, 9.0 if known else 5.0, 4.5)
    ours = spots = path.aligned[:, :3, 3]
    unit = "m" if known else "network's own unit"
    if path.true is not None:
        theirs = path.true[:, :3, 3]
        spots = np.concatenate([ours, theirs])
        above.plot(theirs[:, 0], theirs[:, 2], color="0.45", linewidth=4, alpha=0.6, label="true")
        driven = np.concatenate(([0.0], np.linalg.norm(np.diff(theirs, axis=0), axis=1).cumsum()))
        off = np.linalg.norm(ours - theirs, axis=1)
        more[0].plot(driven, off, color=_RED)
        more[0].set(xlabel="distance driven (m)", ylabel="distance from the true position (m)", ylim=(0, None))
        more[0].set_title(f"off by {np.sqrt((off**2).mean()):.2f} m (root mean square)", fontsize=10)
    label = "predicted,\n7-DoF aligned" if known else "predicted"
    above.plot(ours[:, 0], ours[:, 2], color=_RED, linewidth=1.5, label=label)
    above.plot(ours[0, 0], ours[0, 2], "o", color=_RED, markersize=6, label="start")
    # Equal scales, and room to the sides of a straight road, which would otherwise be a line in a sliver.
    center, reach = (spots.max(0) + spots.min(0)) / 2, max(np.ptp(spots[:, 0]), np.ptp(spots[:, 2]), 1e-6) * 0.55
    above.set(xlim=(center[0] - reach, center[0] + reach), ylim=(center[2] - reach, center[2] + reach))
    above.set(xlabel=f"x to the right ({unit})", ylabel=f"z forward ({unit})", aspect="equal")
    above.set_title(path.sequence, fontsize=10)
    if errors:
        figure.suptitle("\n".join(map(_told, errors)), fontsize=9)
    above.legend(fontsize=8)
    save(figure, file)


def _told(errors: PathErrors) -> str:
    """Say how good a path is before any alignment could flatter it, and how far that had to turn it."""
    relative = f", t_rel {errors.t_rel:.1f} %" if errors.segments else ""
    snippets = f"{errors.snippet}-frame ATE {errors.snippet_ate:.4f} m"
    return f"{errors.predictor}: {snippets}{relative}, turned by {errors.turn:.0f}° to align"
