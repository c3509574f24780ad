"""How far off a predicted path is: published snippets, the whole path aligned, KITTI's relative errors; its files."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from rich.markup import escape
from rich.table import Table

from saunet.evaluation.tables import plain_table
from saunet.evaluation.writers import without_nan
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
    times: Float64[ndarray, " n"]
    """Seconds of each frame."""
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
        centerd = self.predicted[:, :3, 3] - self.predicted[:, :3, 3].mean(0)
        driven = centerd @ (self.true[0, :3, :3] @ self.predicted[0, :3, :3].T).T
        aligned = centerd @ self.alignment.rotation.T
        energy = float((centerd**2).sum())
        return float(np.degrees(np.arccos(np.clip((driven * aligned).sum() / energy, -1, 1)))) if energy > 0 else 0.0

    @property
    def aligned(self) -> Float64[ndarray, "n 4 4"]:
        """The predicted poses, aligned."""
        return self.alignment.poses(self.predicted)


def path_of(drive: Any, predicted: Float64[ndarray, "n 4 4"]) -> Path3d:
    """Return a predicted path beside what its recording knows: true poses of all frames, and when they were taken.

    Where the recording does not say when, frames are taken to be a tenth of a second apart.
    """
    numbers = list(drive.indices)
    times = [drive.time(number) for number in numbers]
    poses = [drive.pose(number) for number in numbers]
    return Path3d(
        drive.name,
        predicted,
        np.array(numbers) * 0.1 if None in times else np.array(times, dtype=np.float64),
        None if any(pose is None for pose in poses) else np.stack(poses),
    )


def straight_ahead(path: Path3d) -> Path3d:
    """Return the path of a camera that moves by one unit along its axis from each frame to the next.

    It looks at no image: a network that does not beat it has learnt nothing about motion.
    """
    poses = np.tile(np.eye(4), (len(path.predicted), 1, 1))
    poses[:, 2, 3] = np.arange(len(poses))
    return replace(path, predicted=poses, predictor=STRAIGHT)


def path_errors(path: Path3d, snippet: int = 5, lengths: Sequence[float] | None = None) -> PathErrors:
    """Compute the errors of a path whose truth is known.

    Args:
        path: The path.
        snippet: Frames in a snippet; published numbers use 5.
        lengths: Segment lengths in meters for t_rel and r_rel; by default KITTI's 100 to 800 m, or 20 to 80 % of
            the path where it is shorter than 100 m (such numbers compare with no published ones).

    Raises:
        ConfigError: if a snippet has fewer than two frames, or a length is not above 0.
        DataError: if there are fewer than two poses.
    """
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
    """Return one line a sequence and predictor."""
    snippet = errors[0].snippet
    table = plain_table("[bold]odometry[/bold]: the path of the camera from the pose network")
    table.add_column("sequence", min_width=9)
    for heading in (
        "frames",
        "path m",
        f"{snippet}-frame\nATE m",
        "ATE m",
        "scale",
        "turned\n°",
        "t_rel\n%",
        "r_rel\n°/100m",
    ):
        table.add_column(heading, justify="right", no_wrap=True)
    for row in errors:
        trivial = row.predictor == STRAIGHT
        table.add_row(
            row.predictor if trivial else escape(row.sequence),
            *(("", "") if trivial else (str(row.frames), f"{row.meters:.1f}")),
            f"{row.snippet_ate:.4f} ± {row.snippet_std:.4f}",
            f"{row.ate:.3f}",
            f"{row.scale:.3g}",
            f"{row.turn:.0f}",
            _number(row.t_rel),
            _number(row.r_rel),
            style="dim" if trivial else None,
        )
    published = "as published" if snippet == PUBLISHED_SNIPPET else f"published numbers use {PUBLISHED_SNIPPET} frames"
    notes = [f"{snippet}-frame ATE: own scale a snippet, {published}; the rest after 7-DoF alignment"]
    lengths = [f"{row.lengths[0]:g} to {row.lengths[-1]:g} m" for row in errors if row.segments]
    if lengths:
        notes.append(f"t_rel and r_rel over segments of {', '.join(sorted(set(lengths)))}")
    bare = {row.sequence: row for row in errors if not row.segments}
    notes += [
        f"no segment of {min(row.lengths):g} m or more fits into the {row.meters:.1f} m of {escape(name)}"
        for name, row in bare.items()
    ]
    table.caption = "; ".join(notes)
    return table


def _number(value: float) -> str:
    return f"{value:.2f}" if math.isfinite(value) else "–"


def write_path(path: Path3d, folder: Path) -> None:
    """Write a path in KITTI's and TUM's format: as predicted and, with a truth, aligned to it and the truth itself.

    Raises:
        DataError: if a file cannot be written.
    """
    kinds = {"predicted": path.predicted}
    if path.true is not None:
        kinds |= {"aligned": path.aligned, "true": path.true}
    for kind, poses in kinds.items():
        write_kitti(folder / f"{kind}_kitti.txt", poses)
        write_tum(folder / f"{kind}_tum.txt", poses, path.times)


def write_errors(errors: Sequence[PathErrors], folder: Path, settings: dict[str, object]) -> None:
    """Write ``odometry.json`` and ``odometry.csv``, one entry a sequence and predictor.

    Raises:
        DataError: if a file cannot be written.
    """
    rows: list[dict[str, object]] = [without_nan(asdict(row)) for row in errors]
    write_json(folder / "odometry.json", {"settings": settings, "results": rows})
    if rows:
        table = io.StringIO(newline="")
        writer = csv.DictWriter(table, list(rows[0]))
        writer.writeheader()
        for row, plain in zip(errors, rows, strict=True):
            writer.writerow({**plain, "lengths": " ".join(map(str, row.lengths))})
        write_bytes(folder / "odometry.csv", table.getvalue().encode())
