"""Which images an input names (a file, a folder, a pattern), and what their results are to be called."""

from __future__ import annotations

import glob
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from saunet.errors import ConfigError, DataError
from saunet.io.images import IMAGE_SUFFIXES, natural_order


@dataclass(frozen=True, slots=True)
class Source:
    """One image to predict, and the name of its results relative to the output folder, without ending."""

    path: Path
    stem: str


def find_sources(inputs: str | Path | Sequence[str | Path], output_dir: str | Path) -> list[Source]:
    """Return the images that ``inputs`` name, each input's in natural order, without what lies in ``output_dir``.

    Raises:
        DataError: if an input does not exist or holds no image.
        ConfigError: if two images would get the same results, or an input is the output folder.
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
            raise _nothing(item)
        if base.resolve() == own:  # the next run would predict this one's results
            raise ConfigError(
                f"the output folder {output_dir} holds the originals ({kept[0]}); choose another, such as "
                f"{Path(output_dir) / 'depth'}"
            )
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


def image_paths(item: str | Path) -> list[Path]:
    """Return the images that a file, folder or pattern names, in natural order: ``frame_2`` before ``frame_10``.

    Raises:
        DataError: if it does not exist or holds no image.
    """
    paths = _expand(item)[1]
    if not paths:
        raise _nothing(item)
    return paths


def _nothing(item: str | Path) -> DataError:
    return DataError(f"no images in {item}; looked for files ending in {' '.join(sorted(IMAGE_SUFFIXES))}")


def _expand(item: str | Path) -> tuple[Path, list[Path]]:
    """Return the folder that results' names are relative to, and the images."""
    path = Path(item)
    if path.is_dir():
        return path, _images(path.rglob("*"))
    if path.is_file():
        return path.parent, [path]
    if glob.has_magic(str(item)):
        fixed = _before_magic(path.parts)
        return Path(*fixed), _images(Path(match) for match in glob.glob(str(item), recursive=True))
    raise DataError(f"no file or folder at {item}; check the path")


def _images(paths: Iterable[Path]) -> list[Path]:
    return sorted((p for p in paths if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file()), key=natural_order)


def _before_magic(parts: Sequence[str]) -> list[str]:
    fixed: list[str] = []
    for part in parts[:-1]:
        if glob.has_magic(part):
            break
        fixed.append(part)
    return fixed
