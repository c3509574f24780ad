"""Clips of any camera on disk: which there are, their frames in order, and how much the picture moves between them.

Reading a video out of order is slow (every frame needs those before it), so its frames are kept as JPEGs in a cache
folder, as are measurements. The originals are only ever read.
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

import numpy as np
from numpy.typing import NDArray

from saunet.data.loading.selecting import FLOW_WIDTH, MIN_FLOW, median_flow
from saunet.data.video.camera import FILE_NAME, CameraFile, read_camera
from saunet.errors import DataError
from saunet.io.atomic import partial_name, remove_partial_files, write_json
from saunet.io.images import IMAGE_SUFFIXES, encode_jpeg, frame_order, name_times, natural_order, read_image, resize
from saunet.io.plain import read_json
from saunet.io.video import VIDEO_SUFFIXES, VideoReader, nearest_steps

_NO_CLIPS = frozenset({"@eaDir", "__MACOSX"})
"""Folders in which other systems keep thumbnails and attributes; names with a dot in front are skipped as well."""
QUALITY = 95  # JPEG quality of cached frames
SAME_PICTURE = 0.01
"""Mean difference over the picture's standard deviation under which two frames are the same picture twice."""
CUT = 0.75
"""The same measure from which two frames may be of different scenes (1.13 if nothing matches): KITTI's neighbors differ
by up to 0.5, frames of different recordings by 0.88 to 1.0."""
PEAK = 1.3  # times the changes around it that a cut exceeds: fast motion lasts, a cut does not


class FramesCacheError(DataError):
    """The folder for decoded frames and measurements cannot be written, which is no fault of a clip."""


@dataclass(frozen=True)
class Clip:
    """One recording on disk, before it was read."""

    name: str  # path below the root, unique
    path: Path  # a folder of images, or a video file
    camera: CameraFile


@dataclass(frozen=True)
class Recording:
    """The frames of a clip that are taken in the first place, in order of time."""

    paths: tuple[Path, ...]
    numbers: tuple[int, ...]  # number of each in the clip as recorded, from 0
    fps: float | None  # frames per second as recorded; None if unknown
    missing: int = 0  # frames at the end that a video claims to hold and that cannot be decoded
    passed_over: int = 0  # frames between those taken, which the frame rate asked for does not need
    plain: int = 0  # frames of a video that have one single color, as where nothing could be decoded
    times: tuple[float, ...] | None = None
    """Seconds of each from any fixed origin, by the video or by stamps in the names; None if unknown."""


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
            f"{len(depth)} folders below {root} contain 16-bit images of one channel, such as {depth[0]}; beside color "
            "images these are taken for depth, not for clips",
            stacklevel=2,
        )
    if not paths:
        raise DataError(f"{root} holds neither folders of images nor videos; put each clip below it")
    base = root.parent if root.is_file() else root
    given = read_camera(camera) if camera else None
    known: dict[Path, CameraFile] = {}
    names = [path.absolute().name if path == base else path.relative_to(base).as_posix() for path in paths]
    return [Clip(name, path, given or _camera_of(path, base, known)) for name, path in zip(names, paths, strict=True)]


def frame_paths(folder: Path) -> list[Path]:
    """Return the images directly in a folder in order of time: ``frame_2`` before ``frame_10``, stamps as numbers."""
    with os.scandir(folder) as entries:
        names = [entry.name for entry in entries if not entry.name.startswith(".") and entry.is_file()]
    names = [name for name in names if Path(name).suffix.lower() in IMAGE_SUFFIXES]
    return [folder / names[place] for place in frame_order(names)]


def every(recorded: float | None, wanted: float | None) -> Iterator[int]:
    """Return the numbers of the frames to take for a frame rate: those nearest to equal steps of time."""
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
    folder = cache / f"{clip.path.stem[:60]}-{_key(clip.path, fps, max_width)}"
    if not (folder / "clip.json").is_file():
        _decode(clip.path, clip.camera.fps, fps, folder, max_width, advance)
    try:
        facts = read_json(folder / "clip.json")
        numbers, rate, missing = tuple(facts["numbers"]), facts["fps"], int(facts["missing"])
        plain = int(facts.get("plain", 0))
        times = None if facts["times"] is None else tuple(map(float, facts["times"]))
        count = int(facts["count"])
        if not numbers or (times is not None and len(times) != len(numbers)):
            raise ValueError(f"it lists {len(numbers)} frames and {len(times or ())} times")
    except (OSError, ValueError, LookupError, TypeError) as reason:
        raise DataError(f"{folder / 'clip.json'} is damaged ({reason}); delete the folder {folder}") from reason
    paths = frame_paths(folder)
    if len(paths) != len(numbers):
        raise DataError(f"{folder} holds {len(paths)} of {len(numbers)} frames; delete it, so that it is made again")
    return Recording(tuple(paths), numbers, rate, missing, count - len(numbers), plain, times)


def _read_folder(clip: Clip, fps: float | None) -> Recording:
    paths = frame_paths(clip.path)
    stamps = name_times([path.stem for path in paths])
    rate = clip.camera.fps
    if rate is None and stamps is not None and len(stamps) > 1:
        rate = 1 / float(np.median(np.diff(stamps)))
    if stamps is None or fps is None:
        numbers = tuple(itertools.takewhile(lambda number: number < len(paths), every(rate, fps)))
    else:
        steps = nearest_steps(zip(range(len(paths)), stamps, paths, strict=False), fps)
        numbers = tuple(number for number, _, _ in steps)
    times = None if stamps is None else tuple(stamps[number] for number in numbers)
    taken = tuple(paths[number] for number in numbers)
    return Recording(taken, numbers, rate, passed_over=len(paths) - len(taken), times=times)


def default_cache() -> Path:
    """Return where decoded frames and measurements go unless told otherwise: the user's cache folder."""
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
    """Write the frames of a video that are wanted, into a folder that gets its name only when it is complete."""
    partial = folder.with_name(partial_name(folder.name))
    numbers: list[int] = []
    times: list[float | None] = []
    try:
        remove_partial_files(folder.parent, ".*.partial*")
        partial.mkdir(parents=True, exist_ok=True)
        reader = VideoReader(video, rate)
        for frame in reader.frames(fps):
            width = min(max_width, frame.image.shape[1])
            small = resize(frame.image, round(frame.image.shape[0] * width / frame.image.shape[1]), width)
            (partial / f"{frame.number:06d}.jpg").write_bytes(encode_jpeg(small, QUALITY))
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
            if not (folder / "clip.json").is_file():  # or else another process was faster
                raise
    except OSError as reason:
        raise FramesCacheError(
            f"cannot keep the frames of {video} in {folder.parent}: {reason.strerror or reason}; "
            "set data.frames_cache to a folder with room that can be written"
        ) from reason
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _key(path: Path, fps: float | None, max_width: int) -> str:
    state = path.stat()
    return short_hash(f"{path.resolve()}|{state.st_size}|{state.st_mtime_ns}|{fps}|{max_width}|{QUALITY}|times")


def short_hash(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()[:16]


def _is_depth(folder: Path) -> bool:
    """Return whether the first image of a folder is a 16-bit PNG of one channel."""
    for path in frame_paths(folder)[:1]:
        with contextlib.suppress(OSError), path.open("rb") as stream:
            head = stream.read(26)
            return head[:8] == b"\x89PNG\r\n\x1a\n" and tuple(head[24:26]) == (16, 0)
    return False


def _clip_paths(folder: Path, seen: set[str] | None = None) -> Iterator[Path]:
    """Yield the folders that hold images and the video files, at any depth; a folder once, however linked.

    Links are followed last, so that what lies below the folder itself keeps its own name.
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
        shown = [Path(place) / name for name in files if not name.startswith(".")]
        if any(path.suffix.lower() in IMAGE_SUFFIXES for path in shown):
            yield Path(place)
        yield from (path for path in shown if path.suffix.lower() in VIDEO_SUFFIXES)
    for link in sorted(links):
        yield from _clip_paths(link, seen)


def _camera_of(path: Path, base: Path, known: dict[Path, CameraFile]) -> CameraFile:
    folders = [path, *path.parents] if path.is_dir() else list(path.parents)
    for folder in folders[: folders.index(base) + 1]:
        file = folder / FILE_NAME
        if file not in known and file.is_file():
            known[file] = read_camera(file)
        if file in known:
            return known[file]
    raise DataError(
        f"no {FILE_NAME} for {path}: put one beside it or at {base / FILE_NAME}, or set data.camera; "
        "saunet calibrate makes one (see docs/your_camera.md)"
    )


@dataclass(frozen=True)
class Motion:
    """What was measured of a sequence of frames; entry i compares frame i with the readable one before it."""

    flow: NDArray[np.float64]
    """Median optical flow in pixels of an image 320 pixels wide; NaN for the first frame and for unreadable ones."""
    change: NDArray[np.float64]  # mean difference over the standard deviation of the picture; NaN likewise
    unreadable: tuple[int, ...] = ()  # frames that cannot be decoded

    def doubled(self) -> NDArray[np.bool_]:
        """Say which frames are the same picture as the one before, one value a frame: the frame rate was raised."""
        return np.nan_to_num(self.change, nan=1.0) < SAME_PICTURE

    def static(self, min_flow: float = MIN_FLOW) -> NDArray[np.bool_]:
        """Say which frames show no motion against the one before, one value a frame; the second judges the first."""
        flow = self.flow.copy()
        known = np.flatnonzero(np.isfinite(flow))
        if known.size and known[0] > 0:
            flow[: known[0]] = flow[known[0]]
        return np.nan_to_num(flow, nan=np.inf) < min_flow


def cuts(change: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Say which frames begin another scene (a cut, a loop, the next recording), given the change to the one before."""
    known = np.nan_to_num(change)
    around = np.lib.stride_tricks.sliding_window_view(np.pad(known, 2), 5)[:, [0, 1, 3, 4]]
    # The second largest: next to a cut there may be another one, as around a single black frame.
    return np.asarray((known >= CUT) & (known > PEAK * np.sort(around)[:, -2]))


def relative_change(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> float:
    """Return the mean difference of two images, h x w x 3, over the second's standard deviation."""
    return float(np.abs(before.astype(np.float32) - after).mean() / max(1.0, float(after.std())))


def shrink(image: NDArray[np.uint8], crop: Sequence[float | int] = (0, 0, 0, 0)) -> NDArray[np.uint8]:
    """Return an image, h x w x 3, cut by shares of its top, bottom, left and right, and made 320 pixels wide."""
    height, width = image.shape[:2]
    top, bottom, left, right = crop
    rows = slice(round(top * height), height - round(bottom * height))
    cut = image[rows, round(left * width) : width - round(right * width)]
    return np.asarray(resize(cut, max(32, round(cut.shape[0] * FLOW_WIDTH / cut.shape[1])), FLOW_WIDTH))


def measure(
    paths: Sequence[Path],
    crop: Sequence[float | int],
    *,
    skip_unreadable: bool = False,
    cache: Path | None = None,
    advance: Callable[[], None] = lambda: None,
) -> Motion:
    """Measure the motion between consecutive images, each decoded once."""
    file = cache / f"motion-{_motion_key(paths, crop)}.json" if cache else None
    known = _read_motion(file, len(paths)) if file else None
    if known is not None and (skip_unreadable or not known.unreadable):
        return known
    flow, change = np.full(len(paths), np.nan), np.full(len(paths), np.nan)
    unreadable, before = [], None
    for place, path in enumerate(paths):
        try:
            after = shrink(read_image(path), crop)
        except DataError:
            if not skip_unreadable:
                raise
            unreadable.append(place)
        else:
            if before is not None and before.shape == after.shape:
                flow[place], change[place] = median_flow(before, after), relative_change(before, after)
            before = after
        advance()
    if file:
        remove_partial_files(file.parent, ".*.partial*")
        rounded = {
            key: [None if np.isnan(value) else round(value, 4) for value in values.tolist()]
            for key, values in (("flow", flow), ("change", change))
        }
        write_json(file, {**rounded, "unreadable": unreadable}, FramesCacheError, indent=None)
    return Motion(flow, change, tuple(unreadable))


def even_steps(flow: NDArray[np.float64], parallax: float) -> NDArray[np.bool_]:
    """Choose frames so that the picture moves by about ``parallax`` from each to the next; the first is one."""
    chosen, gathered = np.zeros(len(flow), dtype=bool), 0.0
    for place, step in enumerate(np.nan_to_num(flow)):
        gathered += step
        if place == 0 or gathered >= parallax:
            chosen[place], gathered = True, 0.0
    return chosen


def _motion_key(paths: Sequence[Path], crop: Sequence[float | int]) -> str:
    text = [str([round(float(share), 6) for share in crop])]
    for path in paths:
        try:
            state = path.stat()
            text.append(f"{path.absolute()}|{state.st_size}|{state.st_mtime_ns}")
        except OSError:
            text.append(f"{path.absolute()}|gone")
    return short_hash("\n".join(text))


def _read_motion(file: Path, count: int) -> Motion | None:
    """Return a kept measurement; None where there is none that fits, and then it is made anew."""
    try:
        plain = read_json(file)
        flow, change = (np.array(plain[key], dtype=np.float64) for key in ("flow", "change"))
        unreadable = tuple(int(place) for place in plain["unreadable"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return Motion(flow, change, unreadable) if len(flow) == len(change) == count else None
