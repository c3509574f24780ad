"""Inputs (images, a video, a camera, arrays), read one picture at a time, and the names of their results."""

from __future__ import annotations

import glob
import itertools
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from saunet.errors import ConfigError, DataError
from saunet.io.images import IMAGE_SUFFIXES, image_size, natural_order
from saunet.io.live import CameraReader, live_source, live_title
from saunet.io.times import frame_times
from saunet.io.video import VIDEO_SUFFIXES, VideoReader
from saunet.prediction.prediction import ImageLike, as_image

IMAGE_FPS = 10.0
"""Frames per second assumed for images: KITTI's rate."""
STREAM_FPS = 25.0
"""Frames per second assumed for a bare video stream without its rate."""

Input = str | Path | int | Sequence[str | Path] | Iterable[Any]
"""A video file, images (files, folders, patterns), a live camera (its number, device or address), or RGB arrays."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One picture to predict."""

    image: ImageLike
    """Its file, if it has one; it is read when needed."""
    stem: str
    """Name of its results, relative to the output folder."""
    time: float | None = None
    """Seconds since the first frame of a video, or the time stamp in an image's name; None if unknown."""
    arrived: float | None = None
    """Arrival from a live camera, on the monotonic clock."""

    def read(self) -> UInt8[np.ndarray, "_ _ 3"]:
        return as_image(self.image)


class Recording:
    """Pictures of any kind, in order.

    Attributes:
        title: Name of results of the whole recording.
        images: The files if the input is images, else None.
        live: The live camera, if it is one; it runs until stopped.
        declared: Number of pictures, as far as known.
        fps: Frames per second: given, recorded or assumed.
        timed: Whether frames have times.
    """

    def __init__(self, source: Input, output_dir: str | Path | None = None, fps: float | int | None = None) -> None:
        self.images: list[Frame] | None = None
        self._reader: VideoReader | CameraReader | None = None
        self._size: tuple[int, int] | None = None
        self._frames: Iterable[Frame]
        camera = live_source(source)
        self.title, self.declared, self.timed = title_of(source), None, False
        self.live = None if camera is None else CameraReader(camera)
        self.fps: float = float(fps or IMAGE_FPS)
        if self.live or (isinstance(source, str | Path) and _is_video(Path(source))):
            self._reader = reader = self.live or VideoReader(str(source), fps)
            self._size, self.timed = (reader.height, reader.width), reader.timed
            self.declared, self.fps = reader.declared, float(fps or reader.fps or STREAM_FPS)
            self._frames = (
                Frame(each.image, f"{self.title}/{each.number:06d}", each.time, each.arrived)
                for each in reader.frames()
            )
        elif isinstance(source, str | Path) or (
            isinstance(source, Sequence) and all(isinstance(item, str | Path) for item in source)
        ):
            self._frames = self.images = found = find_sources(source, output_dir)
            self.declared = len(found)
            files = [Path(str(frame.image)) for frame in found]
            together = len({file.parent for file in files}) == 1
            stamps = frame_times(files[0].parent, [file.name for file in files]) if together else None
            if stamps and (np.diff(stamps) > 0).all():
                self.timed, times = True, zip(found, stamps, strict=True)
                self._frames = self.images = [replace(frame, time=stamp) for frame, stamp in times]
                self.fps = float(fps or 1 / np.median(np.diff(stamps))) if len(stamps) > 1 else self.fps
        else:
            assert not isinstance(source, int)
            self.declared = len(source) if isinstance(source, Sequence) else None
            arrays = iter(source)
            first = list(itertools.islice(arrays, 1))
            self._size = as_image(first[0]).shape[:2] if first else None
            numbered = enumerate(itertools.chain(first, arrays))
            self._frames = (Frame(image, f"{self.title}/{number:06d}") for number, image in numbered)

    def __iter__(self) -> Iterator[Frame]:
        return iter(self._frames)

    @property
    def first_size(self) -> tuple[int, int] | None:
        """(height, width) of the first picture that can be read; None if there is none."""
        problems = list[DataError]()
        for frame in self.images or ():
            try:
                return image_size(frame.image)
            except DataError as error:
                problems.append(error)
        if problems:
            raise problems[0]
        return self._size

    @property
    def problems(self) -> list[str]:
        """Problems of a video that has been read to its end, or of a camera, one sentence each."""
        reader = self._reader
        if reader is None or isinstance(reader, CameraReader):
            return reader.problems if reader else []
        name = reader.name
        found = {
            f"{name} is truncated: it ends {reader.missing} frames earlier than it declares": reader.missing,
            f"{reader.damaged} frames of {name} are damaged and could not be decoded in full": reader.damaged,
            f"{reader.plain} of {reader.count} frames of {name} have one single color; check the video": reader.plain,
        }
        return [problem for problem, count in found.items() if count]

    @property
    def missing(self) -> int:
        """Number of frames missing from a truncated video."""
        return self._reader.missing if self._reader is not None else 0

    def close(self) -> None:
        """Release the camera."""
        if self._reader is not None:
            self._reader.close()


def _is_video(path: Path) -> bool:
    return path.suffix.lower() in VIDEO_SUFFIXES and not path.is_dir()


def title_of(source: Input) -> str:
    """Return the name of a source's results."""
    camera = live_source(source)
    if camera is not None:
        return live_title(camera)
    if not isinstance(source, str | Path):
        return "frames"
    path = Path(source)
    if glob.has_magic(path.name) and not path.exists():
        path = path.parent
    return path.resolve().name if path.is_dir() else path.stem or "frames"


def find_sources(inputs: str | Path | Sequence[str | Path], output_dir: str | Path | None = None) -> list[Frame]:
    """Return the images that ``inputs`` name, ``frame_2`` before ``frame_10``, except those in ``output_dir``.

    Results must not lie among the originals: the next run would read them as images.
    """
    several = [inputs] if isinstance(inputs, str | Path) else list(inputs)
    if not several:
        raise DataError("no input given; give an image, a folder, or a pattern such as 'frames/*.png'")
    own = None if output_dir is None else Path(output_dir).resolve()
    if own is not None and own.exists() and not own.is_dir():
        raise ConfigError(f"the output folder {output_dir} is a file; choose another name")
    found: dict[Path, Path] = {}  # image -> its path relative to the input that named it
    for item in several:
        base, paths = _expand(item)
        if own is not None and base.resolve() in own.parents:  # an earlier run's results are not inputs
            paths = [path for path in paths if own not in path.resolve().parents]
        if not paths:
            raise DataError(f"no images in {item}; looked for files ending in {' '.join(sorted(IMAGE_SUFFIXES))}")
        if base.resolve() == own:
            raise _holds_originals(output_dir, paths[0])
        for path in paths:
            found.setdefault(path, path.relative_to(base))
    stems = Counter(str(relative.with_suffix("")) for relative in found.values())
    frames: dict[str, Frame] = {}
    for path, relative in found.items():
        stem = str(relative.with_suffix(""))
        if stems[stem] > 1:  # a.png beside a.jpg
            stem += f"_{path.suffix[1:].lower()}"
        if stem in frames:
            raise ConfigError(
                f"{frames[stem].image} and {path} would both be written as '{stem}'; "
                "predict them into different folders"
            )
        frames[stem] = Frame(path, stem)
    if own is not None:
        targets = {own, *((own / stem).resolve().parent for stem in frames)}
        for path in found:
            if path.resolve().parent in targets:
                raise _holds_originals(output_dir, path)
    return list(frames.values())


def _holds_originals(folder: str | Path | None, original: Path) -> ConfigError:
    other = Path(str(folder), "depth")
    return ConfigError(
        f"the output folder {folder} contains the input images ({original}); choose another, such as {other}"
    )


def clips_of(source: Input, images: Sequence[Frame] | None) -> dict[Path, Path]:
    """Return the folders of an input's images, or its video, each with the folder that the input names."""
    if isinstance(source, str | Path) and _is_video(Path(source)):
        return {Path(source): Path(source).parent}
    items = [source] if isinstance(source, str | Path) else source
    if images is None or not isinstance(items, Sequence):
        return {}
    bases, folders = [_base(item) for item in items], dict.fromkeys(Path(str(frame.image)).parent for frame in images)
    return {folder: next(base for base in bases if base in (folder, *folder.parents)) for folder in folders}


def _base(item: str | Path) -> Path:
    """Return the folder that an input names or is in; of a pattern, the part without wildcards."""
    path = Path(item)
    if path.is_dir() or path.is_file():
        return path if path.is_dir() else path.parent
    return Path(*itertools.takewhile(lambda part: not glob.has_magic(part), path.parts[:-1]))


def _expand(item: str | Path) -> tuple[Path, list[Path]]:
    """Return the folder that results' names are relative to, and the images."""
    path = Path(item)
    if path.is_dir():
        return _base(item), _images(_below(path))
    if path.is_file():
        return _base(item), [path]
    if glob.has_magic(str(item)):
        return _base(item), _images(map(Path, glob.glob(str(item), recursive=True)))
    raise DataError(f"no file or folder at {item}; check the path")


def _below(folder: Path) -> Iterator[Path]:
    """Yield files at any depth, following links but each folder once, without thumbnails and notes of other programs.

    Examples: ``._a.png`` (macOS), ``@eaDir`` (Synology), ``.ipynb_checkpoints`` and ``__MACOSX``.
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
