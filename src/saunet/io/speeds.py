"""Tables of speeds: CSV files of one recording or several."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from saunet.errors import DataError, positive
from saunet.io.atomic import write_bytes

_FORMAT = (
    "expected columns 'time' (seconds) or 'frame' (number), 'speed' (meters per second), and for several drives 'drive'"
)


_MONTHS = 1e7
"""Seconds between two clocks that count from different days."""


@dataclass(frozen=True, slots=True, eq=False)
class SpeedTable:
    """Speed over time of one drive, called '', or of several."""

    path: Path
    unit: Literal["time", "frame"]
    drives: Mapping[str, tuple[NDArray[np.float64], NDArray[np.float64]]]
    """Ascending ticks, and the speed at each."""

    def distance(
        self, drive: str, first: int, second: int, fps: float | int, times: Sequence[float | None] | None = None
    ) -> float:
        """Return the meters traveled between two frames, speed being linear in between; NaN outside the table."""
        positive("fps", fps)
        start, end = sorted((first, second))
        low, high = (start / fps, end / fps) if times is None else (times[start] or 0.0, times[end] or 0.0)
        seconds = (end - start) / fps if times is None else high - low
        if self.unit == "frame":
            low, high = float(start), float(end)
        return self.mean(low, high, drive) * seconds

    def mean(self, low: float, high: float, drive: str = "") -> float:
        """Return the mean speed between two ticks; NaN outside the table."""
        known = self.drives.get(drive) or self.drives.get("")
        if known is None or low < known[0][0] - 1e-6 or high > known[0][-1] + 1e-6:
            return math.nan
        ticks, speeds = known
        if high <= low:
            return float(np.interp(low, ticks, speeds))
        at = np.array([low, *ticks[(ticks > low) & (ticks < high)], high])
        speeds = np.interp(at, ticks, speeds)
        return float(np.sum(np.diff(at) * (speeds[1:] + speeds[:-1]) / 2)) / (high - low)

    def start(self, first: float, drive: str = "") -> float:
        """Return the table's zero on a clock that shows ``first`` at the first frame.

        It is that clock's own, but the first frame if the two clocks are months apart: frames with Unix time, and a
        table that counts from their start.
        """
        known = self.drives.get(drive) or self.drives.get("")
        return 0.0 if known is None or abs(first - float(known[0][0])) < _MONTHS else first

    def check_drives(self, names: Sequence[str]) -> None:
        """Check that at least one drive has speeds."""
        if not {"", *names} & set(self.drives):
            expected = f"call them {_some(names)}, or leave" if names else "a single recording has no name, so leave"
            raise DataError(
                f"{self.path} has speeds of the drives {_some(list(self.drives))}, which are not needed; {expected} "
                "the column 'drive' out"
            )


def write_speeds(path: Path, columns: Sequence[str], rows: Iterable[Sequence[float | int]]) -> None:
    """Write a table that `read_speeds` reads, whole or not at all."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([columns, *rows])
    write_bytes(path, text.getvalue().encode())


def read_speeds(path: str | Path) -> SpeedTable:
    """Read a CSV file of speeds."""
    rows: dict[str, dict[float, float]] = {}
    try:
        with Path(path).open(encoding="utf-8-sig", newline="") as file:
            table = csv.DictReader(file, skipinitialspace=True)
            table.fieldnames = columns = [name.strip() for name in table.fieldnames or ()]
            if "speed" not in columns or not {"time", "frame"} & set(columns):
                raise DataError(f"{path} has the columns {', '.join(columns)[:100] or 'none'}; {_FORMAT}")
            unit: Literal["time", "frame"] = "time" if "time" in columns else "frame"
            for number, row in enumerate(table, 2):
                tick, speed = _numbers(row, f"{path}, line {number}", unit)
                drive = (row.get("drive") or "").strip()
                of_drive = rows.setdefault(drive, {})
                if tick in of_drive:
                    raise DataError(
                        f"{path}, line {number} has a second speed for {unit} "
                        f"{tick:g}{f' of {drive}' if drive else ''}; keep one line of each"
                    )
                of_drive[tick] = speed
    except OSError as reason:
        raise DataError(f"cannot read {path}: {reason.strerror or reason}") from reason
    except (UnicodeDecodeError, csv.Error) as reason:
        raise DataError(f"{path} is not a CSV file of text ({reason}); {_FORMAT}") from reason
    if not rows:
        raise DataError(f"{path} has no line of numbers; {_FORMAT}")
    sorted_rows = {drive: np.array(sorted(of_drive.items())) for drive, of_drive in rows.items()}
    return SpeedTable(Path(path), unit, {drive: (each[:, 0], each[:, 1]) for drive, each in sorted_rows.items()})


def _numbers(row: Mapping[str, str | None], where: str, unit: str) -> tuple[float, float]:
    try:
        speed, tick = float(row["speed"] or ""), float(row[unit] or "")
    except ValueError:
        speed = tick = math.nan
    if not (math.isfinite(speed) and math.isfinite(tick) and speed >= 0):
        given = ", ".join(f"{key}={value}" for key, value in row.items())
        raise DataError(f"{where} is not a time and a speed of at least 0 ({given[:100]}); {_FORMAT}")
    return tick, speed


def _some(names: Sequence[str]) -> str:
    """Name the first three."""
    return ", ".join([*names[:3], *(["..."] if len(names) > 3 else [])])
