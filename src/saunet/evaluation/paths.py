"""`odometry`: the path of the camera through whole sequences, its errors, files and picture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from saunet.data.drive import Drive
from saunet.errors import ConfigError, checked, one_of, positive, usable_device
from saunet.evaluation.files import without_nan
from saunet.evaluation.predictors import file_stem
from saunet.io.atomic import check_folder, write_bytes, write_json
from saunet.io.trajectories import write_kitti, write_tum
from saunet.metrics.odometry import (
    KITTI_LENGTHS,
    Similarity,
    relative_motions,
    segment_errors,
    snippet_ate,
    trajectory_ate,
    umeyama,
)
from saunet.prediction.odometer import Odometer, follow
from saunet.registry import Spec
from saunet.scale.options import MOTIONS
from saunet.tables import Row, Table, columns, csv_text, show
from saunet.tables.drawing import new_figure, save
from saunet.weights.files import read_model
from saunet.weights.locate import locate

PUBLISHED_SNIPPET = 5
"""Frames per snippet in published numbers."""
MODEL, TRACKED = "pose network", "tracked points"
STRAIGHT = "constant motion straight ahead"


@dataclass(frozen=True, slots=True)
class PathErrors:
    """One predicted path against the true one."""

    sequence: str
    predictor: str
    """`MODEL`, `TRACKED`, or `STRAIGHT`, which looks at no image."""
    frames: int
    meters: float
    """Length of the true path."""
    snippet: int
    """Frames per snippet."""
    snippet_ate: float
    """Mean error of snippets in meters, each with its own scale; published numbers use five frames (Zhou et al.)."""
    snippet_std: float
    ate: float
    """Root mean square distance of positions in meters after 7-DoF alignment of the whole path."""
    scale: float
    """Meters per unit of the prediction: the scale of that alignment."""
    turn: float
    """Degrees by which that alignment turned the path; see `Path3d.turn`."""
    t_rel: float
    """KITTI's translation error after that alignment, percent; NaN if no segment fits into the path."""
    r_rel: float
    """KITTI's rotation error, degrees per 100 m; NaN if no segment fits."""
    segments: int
    """Number of segments in these means."""
    lengths: tuple[float, ...]
    """Their lengths in meters; shorter than KITTI's if the path is shorter than 100 m."""


@dataclass(frozen=True)
class Path3d:
    """A predicted path, with the true one if known."""

    sequence: str
    predicted: Float64[ndarray, "n 4 4"]
    """``T_world_cam``; the world is the first camera, the scale the network's own."""
    times: Float64[ndarray, " n"] | None = None
    """Seconds of each frame; None if unknown."""
    true: Float64[ndarray, "n 4 4"] | None = None
    """``T_world_cam`` in meters."""
    predictor: str = MODEL

    @cached_property
    def alignment(self) -> Similarity:
        """The similarity transform from the prediction to the truth; the identity if there is no truth."""
        if self.true is None:
            return Similarity(1.0, np.eye(3), np.zeros(3))
        return umeyama(self.predicted[:, :3, 3], self.true[:, :3, 3])

    @property
    def turn(self) -> float:
        """Degrees by which the alignment turns the path, compared with aligning the first cameras.

        A network that confuses sideways with ahead on a straight road has a small error after alignment, and a large
        turn here. Positions are weighted by their squared distance from the middle, so a roll about a straight road,
        which the alignment may choose freely, does not count. 0 without a truth.
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


def path_of(drive: Drive, predicted: Float64[ndarray, "n 4 4"], predictor: str = MODEL) -> Path3d:
    """Return a predicted path with the times and true poses that its recording has."""
    times = drive.timestamps
    poses = [pose for number in drive.indices if (pose := drive.pose(number)) is not None]
    times = None if times is None or np.isnan(times).any() else times
    true = np.stack(poses) if len(poses) == len(predicted) else None
    return Path3d(drive.name, predicted, times, true, predictor)


def straight_ahead(path: Path3d) -> Path3d:
    """Return the path of a camera that moves by one unit along its axis from each frame to the next.

    It uses no image: a network that does not beat it has learned nothing about motion.
    """
    poses = np.tile(np.eye(4), (len(path.predicted), 1, 1))
    poses[:, 2, 3] = np.arange(len(poses))
    return replace(path, predicted=poses, predictor=STRAIGHT)


def path_errors(path: Path3d, snippet: int = 5, lengths: Sequence[float] | None = None) -> PathErrors:
    """Compute the errors of a path with a known truth."""
    true = path.true
    assert true is not None, "errors need the true path"
    meters = float(np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).sum())
    chosen = tuple(float(length) for length in lengths or KITTI_LENGTHS)
    if lengths is None and 0 < meters <= min(KITTI_LENGTHS):
        chosen = tuple(round(share * meters, 1) for share in (0.2, 0.4, 0.6, 0.8))
    snippets = snippet_ate(relative_motions(path.predicted), relative_motions(true), snippet)
    mean, std, ate = float(snippets.mean()), float(snippets.std()), trajectory_ate(path.predicted, true)
    relative = segment_errors(path.aligned, true, chosen, step=10 if len(true) > 100 else 1)
    about = (path.sequence, path.predictor, len(true), meters, snippet)
    return PathErrors(*about, mean, std, ate, path.alignment.scale, path.turn, *relative, chosen)


def path_table(errors: Sequence[PathErrors]) -> Table:
    """Return one line per sequence and predictor."""
    snippet = errors[0].snippet
    headings = columns(
        *("sequence", "frames", "path m|.1f", f"{snippet}-frame ATE m", "ATE m|.3f", "scale|.3g", "turned °|.0f"),
        *("t_rel %|.2f", "r_rel °/100m|.2f"),
    )
    rows = []
    for one in errors:
        trivial = one.predictor == STRAIGHT
        about = (one.predictor, "", "") if trivial else (one.sequence, one.frames, one.meters)
        numbers = (one.ate, one.scale, one.turn, one.t_rel, one.r_rel)
        told = f"{one.snippet_ate:.4f} ± {one.snippet_std:.4f}"
        rows.append(Row((*about, told, *numbers), "dim" if trivial else "plain"))
    tracked = any(one.predictor == TRACKED for one in errors)
    published = "as published" if snippet == PUBLISHED_SNIPPET else f"published numbers use {PUBLISHED_SNIPPET} frames"
    notes = [f"{snippet}-frame ATE: own scale per snippet, {published}; the rest after 7-DoF alignment"]
    lengths = {f"{row.lengths[0]:g} to {row.lengths[-1]:g} m" for row in errors if row.segments}
    if lengths:
        notes.append(f"t_rel and r_rel over segments of {', '.join(sorted(lengths))}")
    bare = {row.sequence: row for row in errors if not row.segments}
    notes += [
        f"{name} is only {row.meters:.1f} m long, too short for a segment of {min(row.lengths):g} m"
        for name, row in bare.items()
    ]
    title = f"odometry: the path of the camera from {'tracked points' if tracked else 'the pose network'}"
    return Table("odometry", title, headings, tuple(rows), tuple(notes))


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
    rows = [asdict(row) for row in errors]
    write_json(folder / "odometry.json", {"settings": settings, "results": without_nan(rows)})
    if rows:
        lines = ({**row, "lengths": " ".join(map(str, row["lengths"]))}.values() for row in rows)
        write_bytes(folder / "odometry.csv", csv_text(list(rows[0]), map(tuple, lines)).encode())


def draw_path(path: Path3d, file: Path, errors: Sequence[PathErrors] = ()) -> None:
    """Draw a path from above; if the true one is known, draw both and the distance between them."""
    known, red = path.true is not None, "tab:red"
    figure, (above, *more) = new_figure(1 + known, 9.0 if known else 5.0, 4.5)
    ours = spots = path.aligned[:, :3, 3]
    unit = "m" if known else "network's own unit"
    if path.true is not None:
        theirs = path.true[:, :3, 3]
        spots = np.concatenate([ours, theirs])
        above.plot(theirs[:, 0], theirs[:, 2], color="0.45", linewidth=4, alpha=0.6, label="true")
        driven = np.concatenate(([0.0], np.linalg.norm(np.diff(theirs, axis=0), axis=1).cumsum()))
        off = np.linalg.norm(ours - theirs, axis=1)
        more[0].plot(driven, off, color=red)
        more[0].set(xlabel="distance driven (m)", ylabel="distance from the true position (m)", ylim=(0, None))
        more[0].set_title(f"off by {np.sqrt((off**2).mean()):.2f} m (root mean square)", fontsize=10)
    label = "predicted,\n7-DoF aligned" if known else "predicted"
    above.plot(ours[:, 0], ours[:, 2], color=red, linewidth=1.5, label=label)
    above.plot(ours[0, 0], ours[0, 2], "o", color=red, markersize=6, label="start")
    # Equal scales, and room on both sides of a straight road, which would otherwise be a narrow sliver.
    center, reach = (spots.max(0) + spots.min(0)) / 2, max(np.ptp(spots[:, 0]), np.ptp(spots[:, 2]), 1e-6) * 0.55
    above.set(xlim=(center[0] - reach, center[0] + reach), ylim=(center[2] - reach, center[2] + reach))
    above.set(xlabel=f"x to the right ({unit})", ylabel=f"z forward ({unit})", aspect="equal")
    above.set_title(path.sequence, fontsize=10)
    if errors:
        figure.suptitle("\n".join(map(_told, errors)), fontsize=9)
    above.legend(fontsize=8)
    save(figure, file)


def _told(errors: PathErrors) -> str:
    """Describe how good a path is before alignment improves it, and how far the alignment turned it."""
    relative = f", t_rel {errors.t_rel:.1f} %" if errors.segments else ""
    snippets = f"{errors.snippet}-frame ATE {errors.snippet_ate:.4f} m"
    return f"{errors.predictor}: {snippets}{relative}, turned by {errors.turn:.0f}° to align"


@checked
@dataclass(frozen=True, kw_only=True)
class OdometryOptions:
    """Options of `odometry`: which paths to predict, and how to compare them.

    Args:
        checkpoint: A trained model.
        data: The data module; its test split is used, at the checkpoint's image size.
        motion: Source of the camera's motion: points ``tracked`` between frames, with the length from the predicted
            depth; ``auto`` uses the pose network if the model has one.
        snippet: Frames per snippet; published numbers use 5.
        lengths: Segment lengths in meters for t_rel and r_rel; by default KITTI's 100 to 800 m, or 20 to 80 % of a path
            shorter than 100 m.
        batch_size: Frames per run of the network.
        figure: Draw each path, if matplotlib is installed.
        device: Where to predict; ``auto`` uses a GPU if there is one.
        output_dir: Folder for the results; None writes none.

    Raises:
        ConfigError: if an option is invalid.

    Examples:
        >>> data = saunet.Spec.of("data", "kitti_odometry", root="/data/kitti_odometry")
        >>> saunet.OdometryOptions(checkpoint="best.ckpt", data=data).snippet
        5
    """

    checkpoint: str | Path
    data: Spec
    motion: str = "auto"
    snippet: int = 5
    lengths: tuple[float, ...] | None = None
    batch_size: int = 8
    figure: bool = True
    device: str = "auto"
    output_dir: str | Path | None = None

    def __post_init__(self) -> None:
        one_of("motion", self.motion, MOTIONS)
        if self.snippet < 2:
            raise ConfigError(
                f"snippet is {self.snippet}; it counts frames and must be at least 2 (published numbers use 5)"
            )
        for length in self.lengths or ():
            positive("lengths", length)
        positive("batch_size", self.batch_size)


@dataclass(frozen=True)
class OdometryResult:
    """The predicted paths and their errors."""

    paths: tuple[Path3d, ...]
    errors: tuple[PathErrors, ...]
    """Errors of each path with a known truth, followed by those of constant motion straight ahead."""
    notes: tuple[str, ...] = ()
    """Sentences about what could not be done, and why."""
    folder: Path | None = None
    """Folder of the files."""

    @property
    def table(self) -> Table | None:
        """One line per sequence and predictor; None if no sequence has a true path."""
        return path_table(self.errors) if self.errors else None

    def show(self) -> None:
        """Print the notes, the table, and where the files are."""
        print("".join(f"{note}\n" for note in self.notes), end="")
        show([self.table] if self.table else [])
        if self.folder is not None:
            print(f"results: {self.folder}")


def odometry(options: OdometryOptions, progress: Callable[[str], None] = lambda text: None) -> OdometryResult:
    """Predict the path through each test sequence, and compare it with the true one if known.

    Args:
        options: What to predict, and how.
        progress: Called with the name of each sequence.

    Returns:
        The paths and their errors; `OdometryResult.show` prints them.

    Raises:
        ConfigError: if the pose network was not trained on neighboring frames.
        CheckpointError: if the checkpoint cannot be read.
        DataError: if the data cannot be read, or a file cannot be written.

    Examples:
        >>> data = saunet.Spec.of("data", "synthetic_tiny")
        >>> odometry(OdometryOptions(checkpoint="best.ckpt", data=data)).show()  # doctest: +SKIP
    """
    folder = None if options.output_dir is None else check_folder(options.output_dir)
    device, source = usable_device(options.device), locate(options.checkpoint)
    record = read_model(source).record
    odometer = Odometer.from_model(source, options.motion, device=str(device), batch_size=options.batch_size)
    about = {} if odometer.tracks else {"guess_camera": True}  # pose networks need no intrinsics
    data = options.data.fitted(**about).build(height=record.height, width=record.width, offsets=list(record.offsets))
    data.setup("test")
    drawn = options.figure and find_spec("matplotlib") is not None
    paths, errors, notes = [], [], list[str]()
    predictor = TRACKED if odometer.tracks else MODEL
    if odometer.tracks:
        notes.append(f"motion: {odometer.told}")
    for drive in data.datasets["test"].drives:
        progress(drive.name)
        path = path_of(drive, follow(odometer, drive), predictor)
        mine = []
        if path.true is not None:
            mine = [path_errors(each, options.snippet, options.lengths) for each in (path, straight_ahead(path))]
        else:
            notes.append(f"{drive.name}: no true poses, so the path is written but not compared")
        if path.times is None:
            notes.append(f"{drive.name}: the times of its frames are unknown, so no TUM files are written")
        if folder is not None:
            place = check_folder(folder / file_stem(drive.name))
            write_path(path, place)
            if drawn:
                draw_path(path, place / "path.png", mine)
        paths.append(path)
        errors += mine
    if options.figure and not drawn:
        notes.append("paths are not drawn, because that needs matplotlib: run `pip install 'saunet[plot]'`")
    scale = None if record.scale is None else {"factor": record.scale.factor, "source": record.scale.source}
    if folder is not None:
        motion = {"motion": "tracked"} if odometer.tracks else {}
        write_errors(errors, folder, {"checkpoint": str(options.checkpoint), "scale": scale, **motion})
    return OdometryResult(tuple(paths), tuple(errors), tuple(notes), folder)
