"""Clips of any camera on disk: finding them, and their frames in order.

Reading a video out of order is slow (every frame needs the ones before it), so its frames are kept as JPEGs in a cache
folder. The originals are never written to.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import os
import shutil
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import overload

import numpy as np

from saunet.data.video.calibrations import FILE_NAME, highest_folder, nearest_camera
from saunet.data.video.camera import CameraFile, forgotten, read_camera, unknown_camera
from saunet.errors import DataError
from saunet.io.atomic import partial_name, remove_partial_files, write_json
from saunet.io.images import IMAGE_SUFFIXES, encode_jpeg, frame_order, natural_order
from saunet.io.plain import read_json
from saunet.io.times import frame_times, times_file
from saunet.io.video import BARE_SUFFIXES, VIDEO_SUFFIXES, VideoReader, nearest_steps

_NO_CLIPS = frozenset({"@eaDir", "__MACOSX"})
"""Folders of thumbnails and attributes from other systems; names that start with a dot are skipped as well."""
UNKNOWN = "unknown"
"""What a user writes instead of a file for a camera about which nothing is known."""
QUALITY = 95  # JPEG quality of cached frames


class FramesCacheError(DataError):
    """The folder for decoded frames and measurements cannot be written; no clip is to blame."""


@dataclass(frozen=True)
class Clip:
    """One recording on disk, before it was read."""

    name: str  # path below the root, unique
    path: Path  # a folder of images, or a video file
    camera: CameraFile


@dataclass(frozen=True)
class Recording:
    """The chosen frames of a clip, in order of time."""

    paths: FramePaths
    numbers: tuple[int, ...]  # number of each in the clip as recorded, from 0
    fps: float | None  # frames per second as recorded; None if unknown
    missing: int = 0  # frames at the end that a video claims to have but that cannot be decoded
    passed_over: int = 0  # frames skipped to reach the requested frame rate
    plain: int = 0  # frames of a video in one single color, as when nothing could be decoded
    times: tuple[float, ...] | None = None
    """Seconds of each from any fixed origin, from the video, a table, stamps in the names or EXIF; None if unknown."""

    def time(self, place: int) -> float | None:
        """Return the time of one frame, from the rate if there is no other; None if unknown."""
        if self.times is not None:
            return self.times[place]
        return self.numbers[place] / self.fps if self.fps else None


def find_clips(root: str | Path, camera: str | Path | None = None) -> list[Clip]:
    """Find all clips below a folder; a folder of images or a video file is itself one."""
    root = Path(root).expanduser()
    if not root.exists():
        raise DataError(f"no data root at {root.absolute()}; set data.root to a folder of clips, or to a video")
    paths = [root] if root.is_file() else sorted(_clip_paths(root), key=natural_order)
    if root.is_file() and root.suffix.lower() not in VIDEO_SUFFIXES:
        raise DataError(f"{root} is neither a folder nor a video; videos end in {' '.join(sorted(VIDEO_SUFFIXES))}")
    depth = [path for path in paths if path.is_dir() and _is_depth(path)]
    if 0 < len(depth) < len(paths):
        paths = [path for path in paths if path not in depth]
        warnings.warn(
            f"{len(depth)} folders below {root} contain 16-bit images of one channel, such as {depth[0]}; beside "
            "color images these count as depth maps, not as clips",
            stacklevel=2,
        )
    if not paths:
        raise DataError(f"{root} holds neither folders of images nor videos; put each clip below it")
    base = root.parent if root.is_file() else root
    unknown = str(camera) == UNKNOWN and not Path(UNKNOWN).exists()
    given = read_camera(camera, may_be_unknown=True) if camera and not unknown else None
    known: dict[Path, CameraFile] = {}

    def camera_of(path: Path) -> CameraFile:
        found = given or _camera_of(path, base, known)
        if unknown:  # the rest of the file still applies
            return forgotten(found) if found else unknown_camera(Path(UNKNOWN))
        if found is None:
            place = highest_folder(path, base) / FILE_NAME
            raise DataError(
                f"no {FILE_NAME} for {path}: put one beside it or at {place}, or set data.camera; saunet "
                "calibrate makes one, and data.camera=unknown estimates the focal length from turns (see "
                "docs/your_camera.md)"
            )
        return found

    names = [path.absolute().name if path == base else path.relative_to(base).as_posix() for path in paths]
    return [Clip(name, path, camera_of(path)) for name, path in zip(names, paths, strict=True)]


class FramePaths(Sequence[Path]):
    """Paths of files in one folder, each created on demand: a million paths take a second and 300 MB."""

    def __init__(self, folder: Path, names: Sequence[str]) -> None:
        self.folder, self.names = folder, tuple(names)

    def __len__(self) -> int:
        return len(self.names)

    @overload
    def __getitem__(self, place: int) -> Path: ...
    @overload
    def __getitem__(self, place: slice) -> FramePaths: ...
    def __getitem__(self, place: int | slice) -> Path | FramePaths:
        found = self.names[place]
        return self.folder / found if isinstance(found, str) else FramePaths(self.folder, found)

    def texts(self) -> list[str]:
        """Return the absolute paths as text."""
        base = os.path.join(os.path.abspath(self.folder), "")
        return [base + name for name in self.names]


def frame_paths(folder: Path) -> FramePaths:
    """Return the images directly in a folder in order of time: by their times, else ``frame_2`` before ``frame_10``."""
    return timed_paths(folder)[0]


def timed_paths(folder: Path) -> tuple[FramePaths, list[float] | None]:
    """Return the result of `frame_paths`, and each image's seconds from any fixed origin; None if unknown."""
    with os.scandir(folder) as entries:
        names = [entry.name for entry in entries if _is_image(entry.name) and entry.is_file()]
    names = [names[place] for place in frame_order(names)]
    times = frame_times(folder, names)
    if times is not None:
        order = sorted(range(len(names)), key=times.__getitem__)
        names, times = [names[place] for place in order], [times[place] for place in order]
    return FramePaths(folder, names), times


def _is_image(name: str) -> bool:
    return _suffix(name) in IMAGE_SUFFIXES and not name.startswith(".")


def _suffix(name: str) -> str:
    return name[dot:].lower() if (dot := name.rfind(".")) > 0 else ""


def every(recorded: float | None, wanted: float | None) -> Iterator[int]:
    """Return the numbers of the frames to use for a frame rate: those nearest to equal time steps."""
    ratio = max(1.0, recorded / wanted) if recorded and wanted else 1.0
    return (int(step * ratio + 0.5) for step in itertools.count())


def read_clip(
    clip: Clip,
    fps: float | None,
    cache: Path,
    max_width: int,
    advance: Callable[[int, int | None], None] = lambda done, total: None,
) -> Recording:
    """Return a clip's frames; those of a video are decoded into the cache the first time."""
    if clip.path.is_dir():
        return _read_folder(clip, fps)
    rate = clip.camera.fps if _suffix(clip.path.name) in BARE_SUFFIXES else None  # others state their own
    folder = cache / f"{clip.path.stem[:60]}-{_key(clip.path, fps, max_width)}{f'-{rate:g}' if rate else ''}"
    if not (folder / "clip.json").is_file():
        _decode(clip.path, clip.camera.fps, fps, folder, max_width, advance)
    try:
        facts = read_json(folder / "clip.json")
        numbers, rate, missing = tuple(facts["numbers"]), facts["fps"], int(facts["missing"])
        plain = int(facts.get("plain", 0))
        times = None if facts["times"] is None else tuple(map(float, facts["times"]))
        count = int(facts["count"])
        if not numbers or (times is not None and len(times) != len(numbers)):
            raise ValueError(f"it lists {len(numbers)} frames but {len(times or ())} times")
    except (OSError, ValueError, LookupError, TypeError) as reason:
        raise DataError(f"{folder / 'clip.json'} is damaged ({reason}); delete the folder {folder}") from reason
    paths = frame_paths(folder)
    if len(paths) != len(numbers):
        raise DataError(f"{folder} holds {len(paths)} of {len(numbers)} frames; delete it to make it again")
    return Recording(paths, numbers, rate, missing, count - len(numbers), plain, times)


def _read_folder(clip: Clip, fps: float | None) -> Recording:
    paths, stamps = timed_paths(clip.path)
    rate = clip.camera.fps
    if rate is None and stamps is not None and len(stamps) > 1:
        rate = 1 / float(np.median(np.diff(stamps)))
    if stamps is None or fps is None:
        numbers = tuple(itertools.takewhile(lambda number: number < len(paths), every(rate, fps)))
    else:
        steps = nearest_steps(zip(range(len(paths)), stamps, paths.names, strict=False), fps)
        numbers = tuple(number for number, _, _ in steps)
    times = None if stamps is None else tuple(stamps[number] for number in numbers)
    taken = FramePaths(paths.folder, [paths.names[number] for number in numbers])
    return Recording(taken, numbers, rate, passed_over=len(paths) - len(taken), times=times)


def default_cache() -> Path:
    """Return the default folder of decoded frames and measurements: the user's cache folder."""
    base = os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()
    return Path(base) / "saunet" / "clips"


def _decode(
    video: Path,
    rate: float | None,
    fps: float | None,
    folder: Path,
    max_width: int,
    advance: Callable[[int, int | None], None],
) -> None:
    """Write the requested frames of a video to a folder that gets its name only when complete."""
    partial = folder.with_name(partial_name(folder.name))
    numbers: list[int] = []
    times: list[float | None] = []
    try:
        remove_partial_files(folder.parent, ".*.partial*")
        partial.mkdir(parents=True, exist_ok=True)
        reader = VideoReader(video, rate, max_width)
        for frame in reader.frames(fps):
            (partial / f"{frame.number:06d}.jpg").write_bytes(encode_jpeg(frame.image, QUALITY))
            numbers.append(frame.number)
            times.append(frame.time)
            advance(reader.count, reader.declared)
        facts = {
            "video": str(video.absolute()),
            "fps": reader.fps,
            "numbers": numbers,
            "times": None if None in times else times,
            "count": reader.count,
            "missing": reader.missing,
            "plain": reader.plain,
        }
        write_json(partial / "clip.json", facts, indent=None)
        try:
            os.replace(partial, folder)
        except OSError:
            if not (folder / "clip.json").is_file():  # otherwise another process was faster
                raise
    except OSError as reason:
        raise FramesCacheError(
            f"cannot keep the frames of {video} in {folder.parent}: {reason.strerror or reason}; set "
            "data.frames_cache to a writable folder with enough space"
        ) from reason
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _key(path: Path, fps: float | None, max_width: int) -> str:
    state, table = path.stat(), times_file(path)
    clock = (table.stat().st_size, table.stat().st_mtime_ns) if table.is_file() else "times"
    return short_hash(f"{path.resolve()}|{state.st_size}|{state.st_mtime_ns}|{fps}|{max_width}|{QUALITY}|{clock}")


def short_hash(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()[:16]


def _is_depth(folder: Path) -> bool:
    """Return whether the first image of a folder is a 16-bit PNG of one channel."""
    if not any(_suffix(name) == ".png" for name in os.listdir(folder)):
        return False
    for path in frame_paths(folder)[:1]:
        with contextlib.suppress(OSError), path.open("rb") as stream:
            head = stream.read(26)
            return head[:8] == b"\x89PNG\r\n\x1a\n" and tuple(head[24:26]) == (16, 0)
    return False


def _clip_paths(folder: Path, seen: set[str] | None = None) -> Iterator[Path]:
    """Yield the folders that hold images and the video files, at any depth; a folder once, however linked.

    Links are followed last, so that everything below the folder itself keeps its own name.
    """
    seen = set() if seen is None else seen
    links: list[Path] = []
    for place, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".") and name not in _NO_CLIPS]
        if os.path.realpath(place) in seen:
            folders.clear()
            continue
        seen.add(os.path.realpath(place))
        links += [Path(place) / name for name in folders if os.path.islink(os.path.join(place, name))]
        if any(map(_is_image, files)):
            yield Path(place)
        for name in files:
            if _suffix(name) in VIDEO_SUFFIXES and not name.startswith("."):
                yield Path(place) / name
    for link in sorted(links):
        yield from _clip_paths(link, seen)


def _camera_of(path: Path, base: Path, known: dict[Path, CameraFile]) -> CameraFile | None:
    file = nearest_camera(path, base)
    if file is not None and file not in known:
        known[file] = read_camera(file, may_be_unknown=True)
    return None if file is None else known[file]
