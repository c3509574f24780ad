"""Smaller copies of recordings, made once, so that training need not decode full images again and again.

At any time, the folder is a valid part of the finished cache: each copy appears only when complete, and a recording's
list of hashes when all its copies exist. When run again, it checks existing copies against the lists, makes the missing
ones, and replaces those whose originals have changed.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from saunet.data.checks import check_frame
from saunet.data.drive import Drive
from saunet.data.loading.stored import FRAMES, SETTINGS, CacheSettings, ImageCache
from saunet.errors import DataError
from saunet.io.atomic import remove_partial_files, write_bytes, write_json
from saunet.io.images import resize
from saunet.tools.prepare.pool import HERE, OnError, Work, Workers

Entry = tuple[int, str, tuple[int, int], list[int] | None]
"""Bytes and SHA-256 of a copy; (height, width) of its original, and the `_state` of the original's file."""


@dataclass(frozen=True, slots=True)
class CacheReport:
    """The result of `build_cache`."""

    made: int
    """Copies written now."""
    verified: int
    """Existing copies that are intact."""
    replaced: int
    """Copies written now to replace damaged ones, or ones whose original has changed."""
    failures: tuple[str, ...]
    """One sentence for each frame that was skipped because its original is broken."""
    folder: Path

    def __str__(self) -> str:
        again = f"{self.replaced} to replace damaged or outdated ones"
        return f"{self.made} copies made ({again}), {self.verified} verified: {self.folder}"


def encode(image: np.ndarray, settings: CacheSettings) -> bytes:
    """Return an RGB frame at the cache's size as the bytes of a file."""
    small = cv2.cvtColor(resize(image, settings.height, settings.width), cv2.COLOR_RGB2BGR)
    flag = cv2.IMWRITE_JPEG_QUALITY if settings.format == "jpg" else cv2.IMWRITE_WEBP_QUALITY
    done, data = cv2.imencode(f".{settings.format}", small, [flag, settings.quality])
    if not done:
        raise DataError(f"this OpenCV cannot write {settings.format}; use format=jpg")
    return bytes(data.tobytes())


@dataclass(frozen=True, slots=True)
class _Copy:
    """Makes the copy of one frame, or keeps the existing one if it is intact."""

    drives: tuple[Drive, ...]
    cache: ImageCache
    known: tuple[dict[str, Any], ...]

    def __call__(self, item: tuple[int, int]) -> tuple[str, Entry]:
        drive, frame = self.drives[item[0]], item[1]
        path, known, key = self.cache.path(drive, frame), self.known[item[0]], f"{frame:010d}"
        state, old = _state(drive, frame), path.read_bytes() if path.is_file() else None
        if old is not None and known.get("originals", {}).get(key) == state:
            mark = (len(old), hashlib.sha256(old).hexdigest())
            if known.get("frames", {}).get(key) == [*mark]:
                return "verified", (*mark, tuple(known["native"]), state)
        image = drive.image(frame)
        check_frame(drive, frame, image)
        fresh = encode(image, self.cache.settings)
        entry = (len(fresh), hashlib.sha256(fresh).hexdigest(), (image.shape[0], image.shape[1]), state)
        if old == fresh:
            return "verified", entry
        write_bytes(path, fresh)
        return "made" if old is None else "replaced", entry


def _state(drive: Drive, frame: int) -> list[int] | None:
    """Return the size in bytes and modification time (ns) of a frame's original file; None if it has none."""
    try:
        found = path.stat() if (path := drive.path(frame)) else None
    except OSError:  # reading it reports the error
        return None
    return [found.st_size, found.st_mtime_ns] if found else None


def build_cache(
    recordings: Sequence[tuple[Drive, Sequence[int]]],
    folder: str | Path,
    settings: CacheSettings,
    workers: Workers = HERE,
    on_error: OnError = "raise",
) -> CacheReport:
    """Make, complete or check a cache of some frames of each recording; the recordings are only read."""
    cache = _open(Path(folder).expanduser(), settings)
    drives = tuple(drive for drive, _ in recordings)
    for drive in drives:
        remove_partial_files(cache.home(drive), ".*.partial*")
    known = tuple(cache.frames(drive) for drive in drives)
    for drive, frames in zip(drives, known, strict=True):
        if frames:
            cache.check_origin(drive, frames)
    items = [(place, frame) for place, (_, frames) in enumerate(recordings) for frame in frames]
    work: Work[tuple[int, int], tuple[str, Entry]] = Work(_Copy(drives, cache, known), workers, on_error)
    counts: Counter[str] = Counter()
    lists: list[dict[int, Entry]] = [{} for _ in drives]
    waiting = [len(frames) for _, frames in recordings]
    for (place, frame), (what, entry) in work.run(items, "cache"):
        counts[what] += 1
        lists[place][frame] = entry
        waiting[place] -= 1
        if waiting[place] == 0:
            _finish(cache.home(drives[place]), drives[place], known[place], lists[place])
    for place, left in enumerate(waiting):
        if left and lists[place]:  # some of its frames are broken and skipped
            _finish(cache.home(drives[place]), drives[place], known[place], lists[place])
    made = counts["made"] + counts["replaced"]
    return CacheReport(made, counts["verified"], counts["replaced"], tuple(work.failures), Path(folder))


def _open(folder: Path, settings: CacheSettings) -> ImageCache:
    """Start a cache with these settings in a folder, or continue an existing one."""
    path = folder / SETTINGS
    remove_partial_files(folder, ".*.partial*")
    if not path.is_file():
        if folder.is_dir() and any(folder.iterdir()):
            raise DataError(f"{folder} is not empty and not a cache; set folder to a new one")
        write_json(path, settings.plain())
    cache = ImageCache(folder)
    there = cache.settings.plain()
    is_now = ", ".join(f"{key}={there[key]}" for key, value in settings.plain().items() if there[key] != value)
    if is_now:
        raise DataError(
            f"the cache at {folder} was made with {is_now}; use the same settings, or set folder to a new one"
        )
    return cache


def _finish(home: Path, drive: Drive, known: dict[str, Any], entries: dict[int, Entry]) -> None:
    """Write the list of a recording's copies, keeping those of other runs."""
    sizes = {size: f"frame {frame}" for frame, (_, _, size, _) in entries.items()}
    if known:
        sizes.setdefault((known["native"][0], known["native"][1]), "those before")
    if len(sizes) > 1:  # of a recording that does not know its size by itself
        examples = " and ".join(f"{h}x{w} ({sizes[h, w]})" for h, w in sorted(sizes))
        raise DataError(
            f"frames of '{drive.name}' have different sizes: {examples} (height x width); a cache needs one size per "
            "recording"
        )
    frames, originals = dict(known.get("frames", {})), dict(known.get("originals", {}))
    frames |= {f"{frame:010d}": [count, digest] for frame, (count, digest, _, _) in entries.items()}
    originals |= {f"{frame:010d}": state for frame, (_, _, _, state) in entries.items() if state}
    content: dict[str, Any] = {"native": list(*sizes), "frames": dict(sorted(frames.items()))}
    content |= {"originals": dict(sorted(originals.items()))} if originals else {}
    content |= {"origin": drive.origin} if drive.origin else {}
    if content != known:
        write_json(home / FRAMES, content, indent=0)
