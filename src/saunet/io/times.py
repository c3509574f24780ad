"""When the images of a folder were taken: by a table beside them, by stamps in their names, or by EXIF."""

from __future__ import annotations

import csv
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
"""A folder's table of times."""
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


def _table_times(path: Path, names: Sequence[str]) -> list[float]:
    found: dict[str, float] = {}
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            table = csv.DictReader(file, skipinitialspace=True)
            table.fieldnames = columns = [name.strip() for name in table.fieldnames or ()]
            if not {"file", "time"} <= set(columns):
                raise DataError(f"{path} has the columns {', '.join(columns)[:100] or 'none'}; {_FORMAT}")
            for number, row in enumerate(table, 2):
                seconds = math.nan
                with suppress(ValueError):
                    seconds = float(row["time"] or "")
                if not math.isfinite(seconds):
                    raise DataError(f"{path}, line {number}: '{(row['time'] or '')[:40]}' is no time; {_FORMAT}")
                found[os.path.basename((row["file"] or "").strip())] = seconds
    except OSError as reason:
        raise DataError(f"cannot read {path}: {reason.strerror or reason}") from reason
    except (UnicodeDecodeError, csv.Error) as reason:
        raise DataError(f"{path} is not a CSV file of text ({reason}); {_FORMAT}") from reason
    times = [found.get(name, found.get(os.path.splitext(name)[0])) for name in names]
    without = [name for name, seconds in zip(names, times, strict=True) if seconds is None]
    if without:
        raise DataError(f"{path} has no time of {len(without)} of {len(names)} images, such as {without[0]}; add them")
    if len(set(times)) < len(times):
        raise DataError(f"{path} has {len(times)} images at {len(set(times))} different times; give each its own")
    return [seconds for seconds in times if seconds is not None]


def _exif_times(folder: Path, names: Sequence[str]) -> list[float] | None:
    times = list[float]()
    for name in names:
        seconds = exif_time(folder / name)
        if seconds is None:  # mostly the first image already
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
        return None  # whoever reads the picture says so
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
