"""Times of frames, from a table beside them; for images also from stamps in their names, or EXIF."""

from __future__ import annotations

import csv
import itertools
import math
import os
import re
import struct
from collections.abc import Sequence
from contextlib import suppress
from datetime import datetime, timezone
from pathlib import Path

from saunet.errors import DataError
from saunet.io.images import name_times

TIMES = "times.csv"
"""A folder's table of times; that of a video is ``NAME.times.csv`` beside it."""
_VIDEO_FORMAT = "expected the columns 'frame' (its number, from 0) and 'time' (seconds)"
_FORMAT = "expected the columns 'file' (name of the image) and 'time' (seconds)"
_HEAD = 1 << 16
"""Bytes of a JPEG that hold its EXIF block: a segment is no longer."""
_EXIF, _ORIGINAL, _OFFSET, _FRACTION = 0x8769, 0x9003, 0x9011, 0x9291
"""Tags: the EXIF directory, DateTimeOriginal, OffsetTimeOriginal and SubSecTimeOriginal."""


def frame_times(folder: Path, names: Sequence[str]) -> list[float] | None:
    """Return the seconds, from any fixed origin, at which the images of a folder were taken; None if unknown.

    The first of these counts that is there: ``times.csv``, stamps in the names (`name_times`), and EXIF's
    DateTimeOriginal, if all images have it with a fraction of a second and no two are equal.
    """
    if (folder / TIMES).is_file():
        return _table_times(folder / TIMES, names)
    return name_times([name.rpartition(".")[0] for name in names]) or _exif_times(folder, names)


def times_file(video: Path) -> Path:
    """Return where the table of a video's times is, if there is one."""
    return video.with_suffix(f".{TIMES}")


def video_times(video: Path) -> list[float] | None:
    """Return the seconds of all frames of a video since its first one, by the table beside it; None without one.

    Raises:
        DataError: if it leaves a frame out, or its times do not ascend.
    """
    path = times_file(video)
    if not path.is_file():
        return None
    found = _table(path, "frame", _VIDEO_FORMAT)
    times = [found.get(str(number), math.nan) for number in range(len(found))]
    for number, (before, after) in enumerate(itertools.pairwise([-math.inf, *times])):
        if math.isnan(after):
            raise DataError(f"{path} has {len(times)} frames, but none of them is {number}; number them all from 0")
        if after <= before:
            raise DataError(f"{path} has frame {number} at {after:g} s, not after {before:g} s; times must ascend")
    if not times:
        raise DataError(f"{path} contains no time; {_VIDEO_FORMAT}")
    return [seconds - times[0] for seconds in times]


def _table(path: Path, key: str, expected: str) -> dict[str, float]:
    """Return the seconds in a table by what stands in another column."""
    found: dict[str, float] = {}
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            table = csv.DictReader(file, skipinitialspace=True)
            table.fieldnames = columns = [name.strip() for name in table.fieldnames or ()]
            if not {key, "time"} <= set(columns):
                raise DataError(f"{path} has the columns {', '.join(columns)[:100] or 'none'}; {expected}")
            for number, row in enumerate(table, 2):
                seconds = math.nan
                with suppress(ValueError):
                    seconds = float(row["time"] or "")
                if not math.isfinite(seconds):
                    raise DataError(f"{path}, line {number}: '{(row['time'] or '')[:40]}' is not a time; {expected}")
                found[(row[key] or "").strip()] = seconds
    except OSError as reason:
        raise DataError(f"cannot read {path}: {reason.strerror or reason}") from reason
    except (UnicodeDecodeError, csv.Error) as reason:
        raise DataError(f"{path} is not a CSV file of text ({reason}); {expected}") from reason
    return found


def _table_times(path: Path, names: Sequence[str]) -> list[float]:
    found = {os.path.basename(name): seconds for name, seconds in _table(path, "file", _FORMAT).items()}
    times = [found.get(name, found.get(os.path.splitext(name)[0])) for name in names]
    without = [name for name, seconds in zip(names, times, strict=True) if seconds is None]
    if without:
        raise DataError(f"{path} has no time for {len(without)} of {len(names)} images, such as {without[0]}; add them")
    if len(set(times)) < len(times):
        raise DataError(f"{path} has only {len(set(times))} different times for {len(times)} images; give each its own")
    return [seconds for seconds in times if seconds is not None]


def _exif_times(folder: Path, names: Sequence[str]) -> list[float] | None:
    times = list[float]()
    for name in names:
        seconds = exif_time(folder / name)
        if seconds is None:  # usually the first image, so the others are not read
            return None
        times.append(seconds)
    return times if len(set(times)) == len(times) else None


def exif_time(path: Path) -> float | None:
    """Return when a JPEG was taken by its EXIF block, in Unix time; None without a fraction of a second in it.

    Local time counts as UTC where the block does not say how far it is ahead. Whole seconds are too coarse for motion.
    """
    if path.suffix.lower() not in (".jpg", ".jpeg"):
        return None
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD)
    except OSError:
        return None  # reported when the picture itself is read
    start = head.find(b"Exif\0\0", 0, 4096)
    if not head.startswith(b"\xff\xd8") or start < 0:
        return None
    block = head[start + 6 :]
    with suppress(struct.error, KeyError, ValueError):
        order = {b"II": "<", b"MM": ">"}[block[:2]]
        tags = _texts(block, order, struct.unpack_from(f"{order}I", block, 4)[0])
        tags = _texts(block, order, int(tags[_EXIF]))
        moment = datetime.strptime(tags[_ORIGINAL], "%Y:%m:%d %H:%M:%S").replace(tzinfo=timezone.utc)
        fraction = float(f"0.{int(tags[_FRACTION]):0{len(tags[_FRACTION])}d}")
        ahead = re.fullmatch(r"([+-])(\d\d):(\d\d)", tags.get(_OFFSET, ""))
        seconds = int(f"{ahead[1]}1") * (3600 * int(ahead[2]) + 60 * int(ahead[3])) if ahead else 0
        return moment.timestamp() - seconds + fraction
    return None


def _texts(block: bytes, order: str, at: int) -> dict[int, str]:
    """Return tag -> text, or the text of a number, of one directory of a TIFF block."""
    (count,) = struct.unpack_from(f"{order}H", block, at)
    found = {}
    for place in range(at + 2, at + 2 + 12 * count, 12):
        tag, kind, length, value = struct.unpack_from(f"{order}HHII", block, place)
        if kind == 4:
            found[tag] = str(value)
        elif kind == 2:
            begin = place + 8 if length <= 4 else value
            found[tag] = block[begin : begin + length].split(b"\0")[0].decode("ascii", "replace").strip()
    return found
