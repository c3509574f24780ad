"""Predicting many image files: a folder in, a folder of pictures and depth maps out; resumable."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from saunet.errors import ConfigError, DataError, one_of, positive
from saunet.io.atomic import write_bytes, write_json
from saunet.io.colormaps import COLORMAPS, depth_to_png16
from saunet.io.images import image_size, read_image, write_image
from saunet.io.plain import read_json
from saunet.io.progress import bar
from saunet.prediction.pipeline import ImagePredictor
from saunet.prediction.pointcloud import Camera, point_cloud, write_ply
from saunet.prediction.prediction import Prediction
from saunet.prediction.sources import Source, find_sources

OUTPUTS: tuple[str, ...] = ("color", "png16", "npy", "ply")
"""What can be written for each image: disparity in colors, depth as 16-bit PNG (x 256) or float32 array, points."""
MANIFEST = "predictions.json"
"""Written into the output folder: which model and settings its files come from."""

ENDINGS = {"color": "_disparity.png", "png16": "_depth.png", "npy": "_depth.npy", "ply": "_points.ply"}


@dataclass(frozen=True, slots=True)
class Summary:
    """What `predict_files` did."""

    written: tuple[Path, ...]
    """Files written now."""
    skipped: int
    """Images that were finished before."""
    failures: tuple[str, ...] = field(default=())
    """One sentence for each image that could not be read."""


@dataclass(frozen=True, slots=True)
class Style:
    """How results are drawn and written.

    Raises:
        ConfigError: if ``max_depth`` is not a finite number above 0, or ``limits`` are not finite.
    """

    colormap: str = "magma"
    limits: tuple[float, float] | None = None
    camera: Camera | None = None
    max_depth: float | int | None = None

    def __post_init__(self) -> None:
        if self.max_depth is not None:
            positive("max_depth", self.max_depth)
        if self.limits is not None and not all(map(math.isfinite, self.limits)):
            raise ConfigError(f"color limits are {self.limits[0]} to {self.limits[1]}; they must be finite numbers")

    def plain(self) -> dict[str, object]:
        """Return the style as plain data."""
        K = self.camera.K.tolist() if self.camera else None
        return {"colormap": self.colormap, "limits": self.limits, "camera": K, "max_depth": self.max_depth}


def predict_files(
    predictor: ImagePredictor,
    inputs: str | Path | Sequence[str | Path],
    output_dir: str | Path,
    outputs: Sequence[str] = ("color", "png16"),
    *,
    colormap: str = "magma",
    limits: tuple[float, float] | None = None,
    camera: Camera | Sequence[float | int] | None = None,
    max_depth: float | int | None = None,
    batch_size: int = 1,
    max_frames: int | None = None,
    overwrite: bool = False,
    progress: bool = True,
    each: Callable[[Prediction], None] | None = None,
) -> Summary:
    """Predict images into a folder; finished files are skipped, so an interrupted run goes on where it stopped.

    Args:
        predictor: The model.
        inputs: Image files, folders (searched with everything below) and patterns such as ``frames/*.png``.
        output_dir: Where results go, keeping the folder structure of the inputs; made if missing.
        outputs: What to write: ``"color"`` (disparity, ``*_disparity.png``), ``"png16"`` (depth x 256,
            ``*_depth.png``), ``"npy"`` (depth in float32, ``*_depth.npy``) and ``"ply"`` (``*_points.ply``).
        colormap: Color map of ``"color"``.
        limits: Disparities of the darkest and brightest color; each image's own range by default.
        camera: True intrinsics of the camera that took the images, which ``"ply"`` needs: a `Camera`, or
            ``fx, fy, cx, cy`` in pixels of the first image (scaled for images of another size).
        max_depth: Leave points out of ``"ply"`` that are farther, in the unit of depth.
        batch_size: Images that go through the network together.
        max_frames: Take the first so many images; all by default.
        overwrite: Predict again what is already there, and allow a folder that another model wrote.
        progress: Show a progress bar on a terminal.
        each: Called with every image's prediction, in order, after its files; then all images are predicted, and
            ``outputs`` may be empty, with which an image that cannot be read ends the run.

    Returns:
        What was written and skipped, and which images could not be read.

    Raises:
        ConfigError: for an unknown output, numbers out of range, points without a camera, or an output folder that
            holds the originals or results of another model.
        DataError: if there is no image, none of them can be read, or the system refuses to write.
    """
    for output in outputs:
        one_of("outputs", output, OUTPUTS)
    one_of("colormap", colormap, COLORMAPS)
    positive("batch_size", batch_size)
    if max_frames is not None:
        positive("max_frames", max_frames)
    if not outputs and each is None:
        raise ConfigError(f"outputs is empty; allowed: {', '.join(OUTPUTS)}")
    if "ply" in outputs and camera is None:
        raise ConfigError("outputs has 'ply', which needs the camera's true intrinsics; give camera fx, fy, cx, cy")
    folder = Path(output_dir)
    sources = find_sources(inputs, folder)[:max_frames]
    _check_folder(folder, sources)
    if camera is not None and not isinstance(camera, Camera):
        camera = Camera.from_numbers(camera, *first_size(sources))
    style = Style(colormap, limits, camera, max_depth)
    settings = settings_of(predictor, style)
    claimed = check_claim(folder, settings, overwrite)
    unfinished = [source for source in sources if overwrite or _missing(source, folder, outputs)]
    todo = unfinished if each is None else sources
    written: list[Path] = []
    failures: list[str] = []
    with bar(progress) as shown:
        task = shown.add_task("predicting", total=len(todo))
        for start in range(0, len(todo), batch_size):
            images, readable = [], []
            for source in todo[start : start + batch_size]:
                try:
                    images.append(read_image(source.path))
                    readable.append(source)
                except DataError as error:
                    if not outputs:
                        raise
                    failures.append(str(error))
            for source, result in zip(readable, predictor.predict_batch(images), strict=True):
                for output in outputs if overwrite else _missing(source, folder, outputs):
                    written.append(write_output(output, folder / source.stem, result, style))
                    if not claimed:
                        write_json(folder / MANIFEST, settings)
                        claimed = True
                if each is not None:
                    each(result)
            shown.advance(task, len(readable))
    if failures and len(failures) == len(sources):
        more = f" (and {len(failures) - 1} more images cannot be read)" if len(failures) > 1 else ""
        raise DataError(failures[0] + more)
    return Summary(tuple(written), len(sources) - len(unfinished), tuple(failures))


def write_output(output: str, stem: Path, result: Prediction, style: Style) -> Path:
    """Write one of `OUTPUTS` of a prediction, whole or not at all, and return its path: ``stem`` and an ending.

    Raises:
        DataError: if the system refuses to write.
    """
    path = stem.with_name(f"{stem.name}{ENDINGS[output]}")
    _WRITERS[output](path, result, style)
    return path


def _check_folder(folder: Path, sources: Sequence[Source]) -> None:
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"the output folder {folder} is a file; choose another name")
    own = folder.resolve()
    targets = {own} | {(own / source.stem).resolve().parent for source in sources}
    for source in sources:  # results among the originals would be read as images by the next run
        if source.path.resolve().parent in targets:
            raise ConfigError(
                f"the output folder {folder} holds the originals ({source.path}); choose another, such as "
                f"{folder / 'depth'}"
            )


def settings_of(predictor: ImagePredictor, style: Style) -> dict[str, object]:
    """Return what `MANIFEST` holds: the model and the settings that a folder's files come from."""
    return {
        "model": predictor.fingerprint,
        "unit": predictor.unit,
        "straightened": predictor.straightened_by,
        **style.plain(),
    }


def first_size(sources: Sequence[Source]) -> tuple[int, int]:
    """Return (height, width) of the first image that can be read."""
    problem: DataError | None = None
    for source in sources:
        try:
            return image_size(source.path)
        except DataError as error:
            problem = problem or error
    assert problem is not None  # there is a source
    raise problem


def check_claim(folder: Path, settings: Mapping[str, object], overwrite: bool) -> bool:
    """Tell whether it is written down that these settings make the folder's files; refuse to mix others' results.

    Raises:
        ConfigError: if other settings made them.
        DataError: if what is written down cannot be read.
    """
    path = folder / MANIFEST
    if overwrite or not path.exists():
        return False
    try:
        previous = read_json(path)
    except (OSError, ValueError) as reason:
        raise DataError(f"{reason}; delete it, or choose another output folder") from reason
    current = json.loads(json.dumps(settings))
    changed = [key for key in current if not isinstance(previous, dict) or previous.get(key) != current[key]]
    if changed:
        raise ConfigError(
            f"{folder} holds predictions made with another {', '.join(changed)}; "
            "choose another output folder, or set overwrite=true"
        )
    return True


def _missing(source: Source, folder: Path, outputs: Sequence[str]) -> list[str]:
    """Return the outputs that are not there yet or older than their image; files appear only when they are complete."""
    changed = source.path.stat().st_mtime
    paths = {output: folder / f"{source.stem}{ENDINGS[output]}" for output in outputs}
    return [output for output, path in paths.items() if not path.is_file() or path.stat().st_mtime < changed]


def _write_color(path: Path, result: Prediction, style: Style) -> None:
    write_image(path, result.color(style.limits, style.colormap))


def _write_png16(path: Path, result: Prediction, style: Style) -> None:
    write_image(path, depth_to_png16(result.depth))


def _write_npy(path: Path, result: Prediction, style: Style) -> None:
    buffer = io.BytesIO()
    np.save(buffer, result.depth)
    write_bytes(path, buffer.getvalue())


def _write_ply(path: Path, result: Prediction, style: Style) -> None:
    assert style.camera is not None  # predict_files has asked for it
    write_ply(path, point_cloud(result, style.camera, max_depth=style.max_depth))


_WRITERS: dict[str, Callable[[Path, Prediction, Style], None]] = {
    "color": _write_color,
    "png16": _write_png16,
    "npy": _write_npy,
    "ply": _write_ply,
}
