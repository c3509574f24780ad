"""GoPro videos as clips: speed and position from the camera's GPS receiver, stored in the video's data track.

The track's format is GPMF (github.com/gopro/gpmf-parser): elements of key, type, size, count and data, nested. A packet
holds about a second; its samples are evenly spread over it. Packets are read one at a time.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
from av.error import FFmpegError

from saunet.data.video.drive import SPEEDS
from saunet.errors import DataError
from saunet.io.atomic import remove_partial_files, write_json
from saunet.io.plain import read_json
from saunet.io.speeds import write_speeds
from saunet.io.video import VideoReader

RECORD = "import.json"
"""File in each clip that records what it was imported from."""
_TRACK = "GoPro MET"
_MOST_DOP = 5.0
"""Positions with a larger dilution of precision are not used; GoPro calls smaller ones good."""
_COLUMNS = ("time", "speed", "latitude", "longitude", "altitude")
_TYPES = {"b": "b", "B": "B", "s": "h", "S": "H", "l": "i", "L": "I", "f": "f", "d": "d", "j": "q", "J": "Q"}
"""GPMF's types -> those of `struct`."""

Row = tuple[float, ...]


def has_telemetry(video: Path) -> bool:
    """Return whether a video has a track of GPMF."""
    try:
        with _opened(video) as container:
            return _track(container) is not None
    except FFmpegError as reason:
        raise DataError(f"{video} is not a video that can be read; copy it again") from reason


def import_video(video: Path, folder: Path) -> tuple[Path, str]:
    """Make a clip of a GoPro video below a folder: a link and its speeds; return the clip and a description."""
    home = folder / video.stem
    remove_partial_files(home, ".*.partial*")
    facts = video.stat()
    state = {"video": video.name, "bytes": facts.st_size, "changed": facts.st_mtime_ns}
    if (home / RECORD).is_file():
        known = read_json(home / RECORD)
        if not isinstance(known, dict) or {key: known.get(key) for key in state} != state:
            raise DataError(f"{home} was imported from another version of {video}; delete it first")
        about = str(known["about"])
    else:
        link, table = home / video.name, home / f"{video.stem}.{SPEEDS}"
        begun = {table, link} if link.is_symlink() else set[Path]()
        if home.is_dir() and set(home.iterdir()) - begun:
            raise DataError(f"{home} holds other files; choose another folder")
        rows, about = _rows(video)
        home.mkdir(parents=True, exist_ok=True)
        link.unlink(missing_ok=True)
        link.symlink_to(video.absolute())
        if rows:
            write_speeds(table, _COLUMNS, rows)
        write_json(home / RECORD, {**state, "about": about})
    return home, about


def _rows(video: Path) -> tuple[list[Row], str]:
    """Return the rows of the table of speeds, and a note about them."""
    with VideoReader(video) as reader:
        start = reader.origin
    rows, unknown = list[Row](), 0
    with _opened(video) as container:
        for packet in _packets(container, video):
            if packet.pts is None or not packet.size:
                continue
            found = list(samples(bytes(packet), f"{video}, telemetry at {float(packet.pts * packet.time_base):.1f} s"))
            first, step = float(packet.pts * packet.time_base), float((packet.duration or 0) * packet.time_base)
            for number, sample in enumerate(found):
                time = round(first + step * number / len(found) - start, 4)
                if sample is None or (rows and time <= rows[-1][0]):
                    unknown += sample is None
                else:
                    rows.append((time, *sample))
    if not rows:
        return [], "no speeds: the camera has no GPS receiver, it was off, or it had no fix"
    rate = (len(rows) - 1) / max(rows[-1][0] - rows[0][0], 1e-9)
    return rows, f"{len(rows)} speeds, {rate:.1f} per second" + (f", {unknown} more without a fix" if unknown else "")


def _packets(container: Any, video: Path) -> Iterator[Any]:
    try:
        yield from container.demux(_track(container))
    except FFmpegError as reason:
        raise DataError(f"{video} cannot be read to its end; copy it again") from reason


def _opened(video: Path) -> Any:
    return av.open(f"file:{video}", options={"protocol_whitelist": "file"}, metadata_errors="replace")


def _track(container: Any) -> Any:
    return next((s for s in container.streams.data if _TRACK in str(s.metadata.get("handler_name", ""))), None)


def samples(payload: bytes, name: str) -> Iterator[Row | None]:
    """Yield (speed over ground m/s, latitude, longitude in degrees, altitude m) of a packet; None without a fix.

    If a camera writes both, the newer ``GPS9`` is used, which has fix and precision of each sample.
    """
    streams = [
        {key: (kind, data) for key, kind, data in _elements(stream, name)}
        for device, _, inner in _elements(payload, name)
        if device == "DEVC"
        for key, _, stream in _elements(inner, name)
        if key == "STRM"
    ]
    for key in ("GPS9", "GPS5"):
        for stream in streams:
            if key in stream:
                yield from _positions(key, stream, name)
                return


def _positions(key: str, stream: dict[str, tuple[str, bytes]], name: str) -> Iterator[Row | None]:
    kind, data = stream[key]
    kinds = stream["TYPE"][1].decode("ascii", "replace").rstrip("\0") if kind == "?" and "TYPE" in stream else kind * 5
    scales = [1.0] if "SCAL" not in stream else [each for row in _numbers(*stream["SCAL"], name) for each in row]
    scales = scales * len(kinds) if len(scales) == 1 else scales
    if len(scales) != len(kinds) or len(kinds) < (9 if key == "GPS9" else 5) or 0 in scales:
        raise DataError(f"{name}: {key} has {len(kinds)} numbers but {len(scales)} scales; the video is damaged")
    fix = next((row[0] for row in _numbers(*stream["GPSF"], name)), 0) if "GPSF" in stream else 3
    precision = next((row[0] for row in _numbers(*stream["GPSP"], name)), 0) / 100 if "GPSP" in stream else 0
    for row in _numbers(kinds, data, name):
        values = [value / scale for value, scale in zip(row, scales, strict=True)]
        if key == "GPS9":
            precision, fix = values[7], values[8]
        latitude, longitude, altitude, speed = values[:4]
        known = fix >= 2 and precision <= _MOST_DOP and speed >= 0
        yield (speed, latitude, longitude, altitude) if known else None


def _numbers(kinds: str, data: bytes, name: str) -> Iterator[tuple[Any, ...]]:
    """Yield groups of numbers of GPMF's types."""
    if not kinds or not set(kinds) <= _TYPES.keys():
        raise DataError(f"{name} has numbers of an unknown type '{kinds[:20]}'; the video is damaged")
    form = struct.Struct(">" + "".join(_TYPES[kind] for kind in kinds))
    yield from form.iter_unpack(data[: len(data) - len(data) % form.size])


def _elements(data: bytes, name: str) -> Iterator[tuple[str, str, bytes]]:
    """Yield key, type and data of consecutive elements; the data of nested ones are elements."""
    at = 0
    while at + 8 <= len(data):
        key, kind, size, count = struct.unpack_from(">4scBH", data, at)
        at += 8
        if at + size * count > len(data):
            raise DataError(f"{name}: an element is longer than its container; the video is damaged")
        yield key.decode("latin-1"), kind.decode("latin-1"), data[at : at + size * count]
        at += size * count + -(size * count) % 4
