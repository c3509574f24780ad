"""`odometry`: the path of the camera through whole sequences, its errors, its files and its picture."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from saunet.errors import positive, usable_device
from saunet.evaluation.paths import (
    Path3d,
    PathErrors,
    draw_path,
    path_errors,
    path_of,
    path_table,
    straight_ahead,
    write_errors,
    write_path,
)
from saunet.evaluation.predictors import file_stem
from saunet.io.atomic import check_folder
from saunet.metrics.odometry import check_lengths, check_snippet
from saunet.prediction.odometer import Odometer, follow
from saunet.registry import Spec
from saunet.tables import Table, show
from saunet.weights.files import read_model
from saunet.weights.locate import locate


@dataclass(frozen=True, kw_only=True)
class OdometryOptions:
    """Which path `odometry` predicts, and how it is compared.

    Args:
        checkpoint: A trained model with a pose network.
        data: The data module, whose test split is followed; the size of its images follows the checkpoint.
        snippet: Frames in a snippet; published numbers use 5.
        lengths: Segment lengths in meters for t_rel and r_rel; by default KITTI's 100 to 800 m, or 20 to 80 % of a path
            that is shorter than 100 m.
        batch_size: Frames that the network sees at once.
        figure: Draw each path, if matplotlib is installed.
        device: Where to predict; ``auto`` takes a GPU if there is one.
        output_dir: Folder for the results; None writes none.

    Raises:
        ConfigError: if an option cannot work.

    Examples:
        >>> data = saunet.Spec.of("data", "kitti_odometry", root="/data/kitti/odometry")
        >>> saunet.OdometryOptions(checkpoint="best.ckpt", data=data).snippet
        5
    """

    checkpoint: str
    data: Spec
    snippet: int = 5
    lengths: tuple[float, ...] | None = None
    batch_size: int = 8
    figure: bool = True
    device: str = "auto"
    output_dir: str | None = None

    def __post_init__(self) -> None:
        check_snippet(self.snippet)
        check_lengths(self.lengths or ())
        positive("batch_size", self.batch_size)


@dataclass(frozen=True)
class OdometryResult:
    """The predicted paths and their errors."""

    paths: tuple[Path3d, ...]
    errors: tuple[PathErrors, ...]
    """Of each path with a true one, followed by those of constant motion straight ahead."""
    notes: tuple[str, ...] = ()
    """What could not be done, and why."""
    folder: Path | None = None
    """Where the files were written."""

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
    """Predict the path through each test sequence and compare it with the true one where that is known.

    Args:
        options: What and how.
        progress: Called with the name of each sequence.

    Returns:
        The paths and their errors; `OdometryResult.show` prints them.

    Raises:
        ConfigError: if the model has no pose network, or it was not trained on neighboring frames.
        CheckpointError: if the checkpoint cannot be read.
        DataError: if the data cannot be read, or a file cannot be written.

    Examples:
        >>> data = saunet.Spec.of("data", "synthetic_tiny")
        >>> odometry(OdometryOptions(checkpoint="best.ckpt", data=data)).show()  # doctest: +SKIP
    """
    folder = Path(options.output_dir) if options.output_dir is not None else None
    if folder is not None:
        check_folder(folder)
    device, source = usable_device(options.device), locate(options.checkpoint)
    record = read_model(source).record
    odometer = Odometer.from_model(source, device=str(device), batch_size=options.batch_size)
    data = options.data.build(height=record.height, width=record.width, offsets=list(record.offsets))
    data.setup("test")
    drawn = options.figure and find_spec("matplotlib") is not None
    paths, errors, notes = [], [], []
    for drive in data.datasets["test"].drives:
        progress(drive.name)
        path = path_of(drive, follow(odometer, drive))
        mine = []
        if path.true is not None:
            mine = [path_errors(each, options.snippet, options.lengths) for each in (path, straight_ahead(path))]
        if folder is not None:
            place = folder / file_stem(drive.name)
            write_path(path, place)
            if drawn:
                draw_path(path, place / "path.png", mine)
        if path.true is None:
            notes.append(f"{drive.name}: no true poses, so the path is written and not compared")
        if path.times is None:
            notes.append(f"{drive.name}: the times of its frames are unknown, so no TUM files are written")
        paths.append(path)
        errors += mine
    if options.figure and not drawn:
        notes.append("paths are not drawn, which needs matplotlib: run `pip install 'saunet[plot]'`")
    scale = None if record.scale is None else {"factor": record.scale.factor, "source": record.scale.source}
    if folder is not None:
        write_errors(errors, folder, {"checkpoint": options.checkpoint, "scale": scale})
    return OdometryResult(tuple(paths), tuple(errors), tuple(notes), folder)
