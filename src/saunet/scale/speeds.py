"""Speeds from a table: how far the car went between two frames."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from saunet.checks import DataError, positive

_FORMAT = (
    "expected columns 'time' (seconds) or 'frame' (number), 'speed' (metres per second), and for several drives 'drive'"
)


@dataclass(frozen=True, slots=True, eq=False)
class SpeedTable:
    """Speed over time of one or several drives.

    Args:
        times: Seconds since frame 0, ascending, of each drive; the drive ``""`` stands for all.
        metres: Way travelled until then.
        fps: Frames a second.
    """

    times: Mapping[str, NDArray[np.float64]]
    metres: Mapping[str, NDArray[np.float64]]
    fps: float | int

    def distance(self, drive: str, first: int, second: int) -> float:
        """Return the metres travelled between two frames, speed being linear in between; NaN outside the table.

        Args:
            drive: Name of the drive.
            first: Number of a frame.
            second: Number of the other frame.
        """
        key = drive if drive in self.times else ""
        if key not in self.times:
            return math.nan
        times = np.array([first, second]) / self.fps
        slack = 1e-6
        if times.min() < self.times[key][0] - slack or times.max() > self.times[key][-1] + slack:
            return math.nan
        start, end = np.interp(times, self.times[key], self.metres[key])
        return abs(float(end - start))


def read_speeds(path: str | Path, fps: float | int) -> SpeedTable:
    """Read a CSV file of speeds.

    Args:
        path: Columns ``time`` (seconds since frame 0) or ``frame`` (its number, 0 for the first of a folder or video),
            and ``speed`` (metres per second); with a column ``drive`` it may hold several drives by their names.
        fps: Frames a second, which tie frames to time.

    Raises:
        DataError: if the file cannot be read, lacks a column, or holds a line that is not numbers.
        ConfigError: if ``fps`` is not positive.
    """
    positive("scale.fps", fps)
    rows: dict[str, dict[float, float]] = {}
    try:
        with Path(path).open(encoding="utf-8-sig", newline="") as file:
            table = csv.DictReader(file, skipinitialspace=True)
            columns = [name.strip() for name in table.fieldnames or ()]
            table.fieldnames = columns
            if "speed" not in columns or not {"time", "frame"} & set(columns):
                raise DataError(f"{path} has the columns {', '.join(columns) or 'none'}; {_FORMAT}")
            for number, row in enumerate(table, 2):
                time, speed = _numbers(row, f"{path}, line {number}", fps)
                rows.setdefault((row.get("drive") or "").strip(), {})[time] = speed
    except OSError as reason:
        raise DataError(f"cannot read {path}: {reason.strerror or reason}") from reason
    except (UnicodeDecodeError, csv.Error) as reason:
        raise DataError(f"{path} is not a CSV file of text ({reason}); {_FORMAT}") from reason
    if not rows:
        raise DataError(f"{path} holds no line of numbers; {_FORMAT}")
    times = {drive: np.array(sorted(speeds)) for drive, speeds in rows.items()}
    metres = {drive: _travelled(times[drive], rows[drive]) for drive in rows}
    return SpeedTable(times, metres, fps)


def _travelled(times: NDArray[np.float64], speeds: Mapping[float, float]) -> NDArray[np.float64]:
    values = np.array([speeds[time] for time in times.tolist()])
    steps = np.diff(times) * (values[1:] + values[:-1]) / 2
    return np.concatenate([[0.0], np.cumsum(steps)])


def _numbers(row: Mapping[str, str | None], where: str, fps: float | int) -> tuple[float, float]:
    try:
        speed = float(row["speed"] or "")
        time = float(row["time"] or "") if "time" in row else float(row["frame"] or "") / fps
    except ValueError:
        speed = time = math.nan
    if not (math.isfinite(speed) and math.isfinite(time) and speed >= 0):
        given = ", ".join(f"{key}={value}" for key, value in row.items())
        raise DataError(f"{where} is not a time and a speed of at least 0 ({given}); {_FORMAT}")
    return time, speed
