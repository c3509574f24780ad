"""Predicting many image files: a folder in, a folder of pictures and depth maps out; resumable."""

from __future__ import annotations

import glob
import io
import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from saunet.atomic import write_bytes
from saunet.checks import ConfigError, DataError, one_of, positive
from saunet.infer.colour import PALETTES, depth_to_png16
from saunet.infer.images import IMAGE_SUFFIXES, read_image, write_image
from saunet.infer.pipeline import ImagePredictor
from saunet.infer.prediction import Prediction
from saunet.infer.progress import bar

OUTPUTS: tuple[str, ...] = ("colour", "png16", "npy")
"""What can be written for each image: disparity in colours, depth as 16-bit PNG (x 256), depth as float32 array."""
MANIFEST = "predictions.json"
"""Written into the output folder: which model and settings its files come from."""

_ENDINGS = {"colour": "_disparity.png", "png16": "_depth.png", "npy": "_depth.npy"}


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
class Source:
    """One image to predict, and the name of its results relative to the output folder, without ending."""

    path: Path
    stem: str


def predict_files(
    predictor: ImagePredictor,
    inputs: str | Path | Sequence[str | Path],
    output_dir: str | Path,
    outputs: Sequence[str] = ("colour", "png16"),
    *,
    palette: str = "magma",
    limits: tuple[float, float] | None = None,
    batch_size: int = 1,
    overwrite: bool = False,
    progress: bool = True,
) -> Summary:
    """Predict images into a folder; finished files are skipped, so an interrupted run goes on where it stopped.

    Args:
        predictor: The model.
        inputs: Image files, folders (searched with everything below) and patterns such as ``frames/*.png``.
        output_dir: Where results go, keeping the folder structure of the inputs; made if missing.
        outputs: What to write: ``"colour"`` (disparity, ``*_disparity.png``), ``"png16"`` (depth x 256,
            ``*_depth.png``) and ``"npy"`` (depth in float32, ``*_depth.npy``).
        palette: Colour map of ``"colour"``.
        limits: Disparities of the darkest and brightest colour; each image's own range by default.
        batch_size: Images that go through the network together.
        overwrite: Predict again what is already there, and allow a folder that another model wrote.
        progress: Show a progress bar on a terminal.

    Returns:
        What was written and skipped, and which images could not be read.

    Raises:
        ConfigError: for an unknown output, an output folder that is also an input, or one that another model wrote.
        DataError: if there is no image, none of them can be read, or the system refuses to write.
    """
    for output in outputs:
        one_of("outputs", output, OUTPUTS)
    one_of("palette", palette, PALETTES)
    positive("batch_size", batch_size)
    if not outputs:
        raise ConfigError(f"outputs is empty; allowed: {', '.join(OUTPUTS)}")
    folder = Path(output_dir)
    sources = find_sources(inputs, folder)
    _check_folder(folder, sources)
    settings = {"model": predictor.fingerprint, "unit": predictor.unit, "palette": palette, "limits": limits}
    _claim(folder, settings, overwrite)
    todo = [source for source in sources if overwrite or _missing(source, folder, outputs)]
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
                    failures.append(str(error))
            for source, result in zip(readable, predictor.predict_batch(images), strict=True):
                for output in outputs if overwrite else _missing(source, folder, outputs):
                    path = folder / f"{source.stem}{_ENDINGS[output]}"
                    _WRITERS[output](path, result, palette, limits)
                    written.append(path)
            shown.advance(task, len(readable))
    if failures and len(failures) == len(sources):
        more = f" (and {len(failures) - 1} more images cannot be read)" if len(failures) > 1 else ""
        raise DataError(failures[0] + more)
    return Summary(tuple(written), len(sources) - len(todo), tuple(failures))


def find_sources(inputs: str | Path | Sequence[str | Path], output_dir: str | Path) -> list[Source]:
    """Return the images that ``inputs`` name, each input's sorted by name; what lies in ``output_dir`` does not count.

    Raises:
        DataError: if an input does not exist or holds no image.
        ConfigError: if two images would get the same results.
    """
    several = [inputs] if isinstance(inputs, str | Path) else list(inputs)
    if not several:
        raise DataError("no input given; give an image, a folder, or a pattern such as 'frames/*.png'")
    own = Path(output_dir).resolve()
    found: dict[Path, Path] = {}  # image -> its path relative to the input that named it
    for item in several:
        base, paths = _expand(item)
        below = base.resolve() in own.parents  # an earlier run's results are no inputs
        kept = [path for path in paths if not (below and own in path.resolve().parents)]
        if not kept:
            endings = " ".join(sorted(IMAGE_SUFFIXES))
            raise DataError(f"no images in {item}; looked for files ending in {endings}")
        for path in kept:
            found.setdefault(path, path.relative_to(base))
    stems = Counter(str(relative.with_suffix("")) for relative in found.values())
    sources = []
    taken: dict[str, Path] = {}
    for path, relative in found.items():
        stem = str(relative.with_suffix(""))
        if stems[stem] > 1:  # a.png beside a.jpg
            stem += f"_{path.suffix[1:].lower()}"
        if stem in taken:
            raise ConfigError(
                f"{taken[stem]} and {path} would both be written as '{stem}'; predict them into different folders"
            )
        taken[stem] = path
        sources.append(Source(path, stem))
    return sources


def _expand(item: str | Path) -> tuple[Path, list[Path]]:
    """Return the folder that results' names are relative to, and the images."""
    path = Path(item)
    if path.is_dir():
        return path, sorted(p for p in path.rglob("*") if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file())
    if path.is_file():
        return path.parent, [path]
    if glob.has_magic(str(item)):
        fixed = _before_magic(path.parts)
        matches = sorted(Path(match) for match in glob.glob(str(item), recursive=True))
        return Path(*fixed), [p for p in matches if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file()]
    raise DataError(f"no file or folder at {item}; check the path")


def _before_magic(parts: Sequence[str]) -> list[str]:
    fixed: list[str] = []
    for part in parts[:-1]:
        if glob.has_magic(part):
            break
        fixed.append(part)
    return fixed


def _check_folder(folder: Path, sources: Sequence[Source]) -> None:
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"the output folder {folder} is a file; choose another name")
    own = folder.resolve()
    for source in sources:
        if source.path.resolve().parent == own:
            raise ConfigError(
                f"the output folder {folder} holds the originals ({source.path.name}); choose another, such as "
                f"{folder / 'depth'}"
            )


def _claim(folder: Path, settings: Mapping[str, object], overwrite: bool) -> None:
    """Write down what makes the files of this folder, and refuse to mix two models' results in it."""
    path = folder / MANIFEST
    current = json.loads(json.dumps(settings))
    if path.exists() and not overwrite:
        try:
            previous = json.loads(path.read_text())
        except (OSError, ValueError) as reason:
            raise DataError(f"{path} cannot be read ({reason}); delete it, or choose another output folder") from reason
        changed = [key for key in current if not isinstance(previous, dict) or previous.get(key) != current[key]]
        if changed:
            raise ConfigError(
                f"{folder} holds predictions made with another {', '.join(changed)}; "
                "choose another output folder, or set overwrite=true"
            )
        return
    write_bytes(path, (json.dumps(current, indent=2) + "\n").encode())


def _missing(source: Source, folder: Path, outputs: Sequence[str]) -> list[str]:
    """Return the outputs that are not there yet or older than their image; files appear only when they are complete."""
    changed = source.path.stat().st_mtime
    paths = {output: folder / f"{source.stem}{_ENDINGS[output]}" for output in outputs}
    return [output for output, path in paths.items() if not path.is_file() or path.stat().st_mtime < changed]


def _write_colour(path: Path, result: Prediction, palette: str, limits: tuple[float, float] | None) -> None:
    write_image(path, result.colour(limits, palette))


def _write_png16(path: Path, result: Prediction, palette: str, limits: tuple[float, float] | None) -> None:
    write_image(path, depth_to_png16(result.depth))


def _write_npy(path: Path, result: Prediction, palette: str, limits: tuple[float, float] | None) -> None:
    buffer = io.BytesIO()
    np.save(buffer, result.depth)
    write_bytes(path, buffer.getvalue())


_WRITERS: dict[str, Callable[[Path, Prediction, str, tuple[float, float] | None], None]] = {
    "colour": _write_colour,
    "png16": _write_png16,
    "npy": _write_npy,
}
