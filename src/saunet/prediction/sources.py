"""What an input names (images, a video, a camera, arrays), one picture at a time, and what results are to be called."""

from __future__ import annotations

import glob
import itertools
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from saunet.errors import ConfigError, DataError
from saunet.io.images import IMAGE_SUFFIXES, image_size, natural_order, read_image
from saunet.io.video import VIDEO_SUFFIXES, CameraReader, VideoReader
from saunet.prediction.prediction import as_image

IMAGE_FPS = 10.0
"""Frames per second of images, KITTI's rate; files do not say."""
STREAM_FPS = 25.0
"""Frames per second of a bare video stream that does not contain its rate."""

Picture = UInt8[np.ndarray, "_ _ 3"]
Input = str | Path | int | Sequence[str | Path] | Iterable[Any]
"""A video file, images (files, folders, patterns), a camera's number, or RGB arrays."""


@dataclass(frozen=True, slots=True)
class Source:
    """One image file to predict, and the name of its results relative to the output folder, without ending."""

    path: Path
    stem: str


@dataclass(frozen=True, slots=True)
class Frame:
    """One picture to predict."""

    read: Callable[[], Picture]
    stem: str
    """What its results are called, relative to the output folder."""
    time: float | None = None
    """Seconds since the first; None if unknown."""
    path: Path | None = None
    """Its file, if it is one."""


class Recording:
    """Pictures in order, of whatever kind.

    Attributes:
        title: What to call results of the whole.
        images: The files, if it is images; else None.
        live: Whether it is a camera, which ends when somebody stops it.
        declared: How many pictures there are, as far as known.
        fps: Frames per second: as given, as recorded, or assumed.
        timed: Whether frames have times.

    """

    def __init__(self, source: Input, output_dir: str | Path | None = None, fps: float | int | None = None) -> None:
        self.images: list[Source] | None = None
        self._reader: VideoReader | CameraReader | None = None
        self._arrays: Iterable[Any] = ()
        self._size: tuple[int, int] | None = None
        self.title, self.live, self.declared = title_of(source), camera_number(source) is not None, None
        self.fps: float = float(fps or IMAGE_FPS)
        number = camera_number(source)
        if number is not None:
            self._reader = CameraReader(number)
        elif isinstance(source, str | Path) and is_video(source):
            self._reader = VideoReader(source, fps)
        elif isinstance(source, str | Path) or (
            isinstance(source, Sequence) and all(isinstance(item, str | Path) for item in source)
        ):
            self.images = find_sources(source, output_dir)
            self.declared = len(self.images)
        else:
            assert not isinstance(source, int)
            arrays = iter(source)
            first = list(itertools.islice(arrays, 1))
            self._size = as_image(first[0]).shape[:2] if first else None
            self._arrays = itertools.chain(first, arrays)
        if self._reader is not None:
            self.declared, self.fps = self._reader.declared, float(fps or self._reader.fps or STREAM_FPS)
        self.timed = self._reader is not None and self._reader.timed

    def __iter__(self) -> Iterator[Frame]:
        if self.images is not None:
            for source in self.images:
                yield Frame(partial(read_image, source.path), source.stem, None, source.path)
            return
        if self._reader is not None:
            for frame in self._reader.frames():
                yield Frame(partial(_same, frame.image), f"{self.title}/{frame.number:06d}", frame.time)
            return
        for number, image in enumerate(self._arrays):
            yield Frame(partial(_same, image), f"{self.title}/{number:06d}")

    @property
    def first_size(self) -> tuple[int, int] | None:
        """(height, width) of the first picture that can be read; None if there is none."""
        if self._reader is not None:
            return self._reader.height, self._reader.width
        problem: DataError | None = None
        for source in self.images or ():
            try:
                return image_size(source.path)
            except DataError as error:
                problem = problem or error
        if problem is not None:
            raise problem
        return self._size

    @property
    def problems(self) -> list[str]:
        """What was wrong with a video that has been read to its end, a sentence each."""
        reader, found = self._reader, []
        if isinstance(reader, VideoReader):
            if reader.missing:
                found.append(f"{reader.name} ends {reader.missing} frames earlier than it declares: it is truncated")
            if reader.damaged:
                found.append(f"{reader.damaged} frames of {reader.name} are damaged and could not be decoded in full")
            if reader.plain:
                found.append(
                    f"{reader.plain} of {reader.count} frames of {reader.name} have one single color; look at the video"
                )
        return found

    @property
    def missing(self) -> int:
        """Frames that a truncated video lacks."""
        return self._reader.missing if self._reader is not None else 0

    def close(self) -> None:
        """Release the camera."""
        if self._reader is not None:
            self._reader.close()


def camera_number(source: Input) -> int | None:
    """Return the number of the camera that an input names, None if it is no camera."""
    if isinstance(source, int):
        return source
    return int(source) if isinstance(source, str) and source.isdecimal() and not Path(source).exists() else None


def is_video(source: str | Path) -> bool:
    """Return whether a path is taken for a video: anything that is not a folder, a pattern or an image file."""
    path = Path(source)
    if path.suffix.lower() in VIDEO_SUFFIXES:
        return not path.is_dir()
    return False


def title_of(source: Input) -> str:
    """Return what to call a source's results."""
    number = camera_number(source)
    if number is not None:
        return f"camera{number}"
    if not isinstance(source, str | Path):
        return "frames"
    path = Path(source)
    if glob.has_magic(path.name) and not path.exists():
        path = path.parent
    return path.resolve().name if path.is_dir() else path.stem or "frames"


def find_sources(inputs: str | Path | Sequence[str | Path], output_dir: str | Path | None = None) -> list[Source]:
    """Return the images that ``inputs`` name, each input's in natural order, without what lies in ``output_dir``."""
    several = [inputs] if isinstance(inputs, str | Path) else list(inputs)
    if not several:
        raise DataError("no input given; give an image, a folder, or a pattern such as 'frames/*.png'")
    own = None if output_dir is None else Path(output_dir).resolve()
    found: dict[Path, Path] = {}  # image -> its path relative to the input that named it
    for item in several:
        base, paths = _expand(item)
        below = own is not None and base.resolve() in own.parents  # an earlier run's results are no inputs
        kept = [path for path in paths if not (below and own in path.resolve().parents)]
        if not kept:
            raise _nothing(item)
        if base.resolve() == own:  # the next run would predict this one's results
            raise holds_originals(Path(str(output_dir)), kept[0])
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


def holds_originals(folder: Path, original: Path) -> ConfigError:
    """Return the error for an output folder in which results would lie among the originals."""
    return ConfigError(
        f"the output folder {folder} holds the originals ({original}); choose another, such as {folder / 'depth'}"
    )


def image_paths(item: str | Path) -> list[Path]:
    """Return the images that a file, folder or pattern names, in natural order: ``frame_2`` before ``frame_10``."""
    paths = _expand(item)[1]
    if not paths:
        raise _nothing(item)
    return paths


def _same(image: Picture) -> Picture:
    return image


def _nothing(item: str | Path) -> DataError:
    return DataError(f"no images in {item}; looked for files ending in {' '.join(sorted(IMAGE_SUFFIXES))}")


def _expand(item: str | Path) -> tuple[Path, list[Path]]:
    """Return the folder that results' names are relative to, and the images."""
    path = Path(item)
    if path.is_dir():
        return path, _images(_below(path))
    if path.is_file():
        return path.parent, [path]
    if glob.has_magic(str(item)):
        fixed = _before_magic(path.parts)
        return Path(*fixed), _images(Path(match) for match in glob.glob(str(item), recursive=True))
    raise DataError(f"no file or folder at {item}; check the path")


def _below(folder: Path) -> Iterator[Path]:
    """Yield the files at any depth, also through links, a folder once; not the thumbnails and notes of other programs.

    Such are ``._a.png`` (macOS), ``@eaDir`` (Synology), ``.ipynb_checkpoints`` and ``__MACOSX``.
    """
    seen: set[str] = set()
    for place, folders, files in os.walk(folder, followlinks=True):
        real = os.path.realpath(place)
        folders[:] = [name for name in sorted(folders) if not name.startswith((".", "@")) and name != "__MACOSX"]
        if real in seen:
            folders.clear()
            continue
        seen.add(real)
        yield from (Path(place) / name for name in files if not name.startswith("."))


def _images(paths: Iterable[Path]) -> list[Path]:
    return sorted((p for p in paths if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file()), key=natural_order)


def _before_magic(parts: Sequence[str]) -> list[str]:
    fixed: list[str] = []
    for part in parts[:-1]:
        if glob.has_magic(part):
            break
        fixed.append(part)
    return fixed
