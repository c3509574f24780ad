"""Speeds from a table: how far the car went between two frames."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from saunet.errors import DataError, positive

_FORMAT = (
    "expected columns 'time' (seconds) or 'frame' (number), 'speed' (meters per second), and for several drives 'drive'"
)


@dataclass(frozen=True, slots=True, eq=False)
class SpeedTable:
    """Speed over time of one or several drives."""

    path: Path
    unit: Literal["time", "frame"]
    ticks: Mapping[str, NDArray[np.float64]]
    speeds: Mapping[str, NDArray[np.float64]]

    def distance(
        self, drive: str, first: int, second: int, fps: float | int, times: Sequence[float | None] | None = None
    ) -> float:
        """Return the meters traveled between two frames, speed being linear in between; NaN outside the table."""
        positive("fps", fps)
        key = drive if drive in self.ticks else ""
        if key not in self.ticks:
            return math.nan
        start, end = sorted((first, second))
        seconds = (end - start) / fps if times is None else (times[end] or 0.0) - (times[start] or 0.0)
        if self.unit == "frame":
            return self._mean(key, float(start), float(end)) * seconds
        low, high = (start / fps, end / fps) if times is None else (times[start] or 0.0, times[end] or 0.0)
        return self._mean(key, low, high) * seconds

    def _mean(self, key: str, start: float, end: float) -> float:
        """Return the mean speed between two ticks; NaN outside the table."""
        slack, ticks = 1e-6, self.ticks[key]
        if start < ticks[0] - slack or end > ticks[-1] + slack:
            return math.nan
        if end <= start:
            return 0.0
        at = np.array([start, *ticks[(ticks > start) & (ticks < end)], end])
        speeds = np.interp(at, ticks, self.speeds[key])
        return float(np.sum(np.diff(at) * (speeds[1:] + speeds[:-1]) / 2)) / (end - start)

    def check_drives(self, names: Sequence[str]) -> None:
        """Check that at least one drive has speeds."""
        if "" in self.ticks or any(name in self.ticks for name in names):
            return
        expected = f"call them {_some(names)}, or leave" if names else "a single recording has no name, so leave"
        raise DataError(
            f"{self.path} gives speeds of the drives {_some(list(self.ticks))}, which are not asked for; "
            f"{expected} the column 'drive' out"
        )


def read_speeds(path: str | Path) -> SpeedTable:
    """Read a CSV file of speeds."""
    rows: dict[str, dict[float, float]] = {}
    try:
        with Path(path).open(encoding="utf-8-sig", newline="") as file:
            table = csv.DictReader(file, skipinitialspace=True)
            columns = [name.strip() for name in table.fieldnames or ()]
            table.fieldnames = columns
            if "speed" not in columns or not {"time", "frame"} & set(columns):
                raise DataError(f"{path} has the columns {', '.join(columns) or 'none'}; {_FORMAT}")
            unit: Literal["time", "frame"] = "time" if "time" in columns else "frame"
            for number, row in enumerate(table, 2):
                tick, speed = _numbers(row, f"{path}, line {number}", unit)
                drive = (row.get("drive") or "").strip()
                of_drive = rows.setdefault(drive, {})
                if tick in of_drive:
                    raise DataError(
                        f"{path}, line {number} gives a second speed at {unit} {tick:g}"
                        f"{f' of {drive}' if drive else ''}; keep one line of each"
                    )
                of_drive[tick] = speed
    except OSError as reason:
        raise DataError(f"cannot read {path}: {reason.strerror or reason}") from reason
    except (UnicodeDecodeError, csv.Error) as reason:
        raise DataError(f"{path} is not a CSV file of text ({reason}); {_FORMAT}") from reason
    if not rows:
        raise DataError(f"{path} holds no line of numbers; {_FORMAT}")
    ticks = {drive: np.array(sorted(of_drive)) for drive, of_drive in rows.items()}
    speeds = {drive: np.array([rows[drive][tick] for tick in each.tolist()]) for drive, each in ticks.items()}
    return SpeedTable(Path(path), unit, ticks, speeds)


def _numbers(row: Mapping[str, str | None], where: str, unit: str) -> tuple[float, float]:
    try:
        speed, tick = float(row["speed"] or ""), float(row[unit] or "")
    except ValueError:
        speed = tick = math.nan
    if not (math.isfinite(speed) and math.isfinite(tick) and speed >= 0):
        given = ", ".join(f"{key}={value}" for key, value in row.items())
        raise DataError(f"{where} is not a time and a speed of at least 0 ({given}); {_FORMAT}")
    return tick, speed


def _some(names: Sequence[str]) -> str:
    """Name the first three."""
    return ", ".join([*names[:3], *(["..."] if len(names) > 3 else [])])
