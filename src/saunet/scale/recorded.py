"""What the scale is measured from: frames of a folder or video as batches, and the speeds in a table."""

from __future__ import annotations

import csv
import itertools
import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import UInt8
from numpy.typing import NDArray

from saunet.errors import DataError, positive
from saunet.io.images import network_input
from saunet.types import TrainBatch

Image = UInt8[np.ndarray, "_ _ 3"]
_FORMAT = (
    "expected columns 'time' (seconds) or 'frame' (number), 'speed' (meters per second), and for several drives 'drive'"
)


def clip_batches(
    frames: Iterable[Image],
    height: int,
    width: int,
    *,
    offsets: Sequence[int] = (),
    distance: Callable[[int, int], float] | None = None,
    intrinsics: Callable[[int, int], NDArray[np.float64]] | None = None,
    partner: Iterable[Image] | None = None,
    baseline: float = 0.0,
    count: int | None = None,
    most: int = 100,
) -> Iterator[TrainBatch]:
    """Yield frames of a clip one by one as a network wants them, with neighbors, intrinsics and partner as asked for.

    ``distance`` gives meters between two frames by their numbers (NaN if unknown), ``intrinsics`` K of an image of a
    (height, width), and ``baseline`` is the meters to the partner, positive if that is the right camera. Of more frames
    than ``most``, only so many are used, evenly spread if ``count`` is known.
    """
    before, after = -min(0, *offsets, 0), max(0, *offsets, 0)
    step = max(1, (count - before - after) // most) if count else 1
    window: deque[NDArray[np.float32]] = deque(maxlen=before + 1 + after)
    others: deque[Image | None] = deque(maxlen=after + 1)
    yielded = 0
    for number, (frame, other) in enumerate(itertools.zip_longest(frames, () if partner is None else partner)):
        if frame is None or (partner is not None and other is None):
            raise DataError(
                f"the two cameras have different numbers of images (one ends after {number}); give pairs of one moment"
            )
        window.append(network_input(frame, height, width))
        others.append(other)
        index = number - after
        if len(window) < before + 1 + after or (index - before) % step:
            continue
        target = torch.from_numpy(window[before])[None]
        sources = [window[before + offset] for offset in offsets]
        batch: TrainBatch = {
            "target": target,
            "sources": target.new_zeros(1, 0, 3, height, width),
            "loss_target": target,
            "loss_sources": target.new_zeros(1, 0, 3, height, width),
            "K": torch.eye(3)[None],
            "name": [f"frame {index}"],
        }
        if intrinsics is not None:
            batch["K"] = torch.from_numpy(intrinsics(height, width)).float()[None]
        if distance is not None:
            batch["distance"] = torch.tensor([[distance(index, index + offset) for offset in offsets]])
        if others[0] is not None:
            sources.append(network_input(others[0], height, width))
            batch["T_stereo_tgt"] = torch.eye(4)[None]
            batch["T_stereo_tgt"][0, 0, 3] = -baseline
        if sources:
            batch["sources"] = batch["loss_sources"] = torch.from_numpy(np.stack(sources))[None]
        yield batch
        yielded += 1
        if yielded == most:
            return


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
        known = self.drives.get(drive) or self.drives.get("")
        if known is None or low < known[0][0] - 1e-6 or high > known[0][-1] + 1e-6:
            return math.nan
        if high <= low:
            return 0.0
        ticks, speeds = known
        at = np.array([low, *ticks[(ticks > low) & (ticks < high)], high])
        speeds = np.interp(at, ticks, speeds)
        mean = float(np.sum(np.diff(at) * (speeds[1:] + speeds[:-1]) / 2)) / (high - low)
        return mean * seconds

    def check_drives(self, names: Sequence[str]) -> None:
        """Check that at least one drive has speeds."""
        if not {"", *names} & set(self.drives):
            expected = f"call them {_some(names)}, or leave" if names else "a single recording has no name, so leave"
            raise DataError(
                f"{self.path} gives speeds of the drives {_some(list(self.drives))}, which are not asked for; "
                f"{expected} the column 'drive' out"
            )


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
