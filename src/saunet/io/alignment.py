"""The clock of a table of speeds, found by matching changes of speed with motion in the pictures."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve

from saunet.errors import DataError
from saunet.io.speeds import SpeedTable

Series = NDArray[np.float64]
STEP = 0.1
"""Seconds between tried offsets."""
_SHORTEST = 20.0
"""Shortest common time to compare, in seconds."""
_POSSIBLE = 6.6
"""Chi-squared of one degree of freedom at 99 %: offsets that explain the motion so much worse are excluded."""
_MIN_CORRELATION = 0.5
_MOST = 2.0
"""Required accuracy of an offset in seconds."""


@dataclass(frozen=True, slots=True)
class Alignment:
    """The offset of a table's clock from a recording's."""

    offset: float
    """Seconds to subtract from the table's times."""
    known_to: float
    """Uncertainty of the offset: seconds to either side."""
    correlation: float

    def __str__(self) -> str:
        return (
            f"its clock is {self.offset:+.2f} s off that of the frames (known to {self.known_to:.1f} s, correlation "
            f"of speed and motion {self.correlation:.2f})"
        )


def align_speeds(table: SpeedTable, drive: str, times: Series, motion: Series) -> tuple[SpeedTable, Alignment]:
    """Return a table with a drive's speeds on the clock of its frames, and the offset found.

    Args:
        table: Speeds over seconds of any clock.
        drive: The recording; the table may have one without a name instead.
        times: Times of the motion, ascending, in seconds.
        motion: Speed of the camera's motion, in any unit (translation or optical flow per second); NaN if unknown.

    Raises:
        DataError: if no offset, or more than one, explains the motion.
    """
    name = drive if drive in table.drives else ""
    if table.unit != "time" or name not in table.drives:
        raise DataError(f"{table.path} has no speeds with times for '{drive}', so its clock cannot be aligned")
    ticks, speeds = table.drives[name]
    what = f"the speeds of {table.path} cannot be aligned with the frames"
    known = np.isfinite(motion)
    times, motion = times[known], motion[known]
    if min(np.ptp(times) if len(times) > 1 else 0.0, np.ptp(ticks)) < _SHORTEST:
        raise DataError(f"{what}: both must last at least {_SHORTEST:g} seconds")
    # Turns and near objects move the picture more than speed does, so the largest motions are cut off.
    motion = np.sqrt(np.minimum(motion, np.quantile(motion, 0.95)))
    offsets, r, seconds = _correlations(ticks - ticks[0], np.sqrt(speeds), times - times[0], motion)
    best = int(np.argmax(r))
    if r[best] < _MIN_CORRELATION:
        raise DataError(
            f"{what}: they explain the motion in the pictures at no offset (correlation {r[best]:.2f}, at least "
            f"{_MIN_CORRELATION:g} is required); check that they belong to this drive, and that its speed changes"
        )
    at = times - times[0] + ticks[0] + offsets[best]
    common = (at >= ticks[0]) & (at <= ticks[-1])
    memory = _memory(times[common], motion[common], np.sqrt(np.interp(at[common], ticks, speeds)))
    samples = np.minimum(seconds, seconds[best]) / memory
    possible = offsets[samples * np.log((1 - r**2) / (1 - r[best] ** 2)) < _POSSIBLE]
    known_to = max(STEP / 2, float(np.ptp(possible)) / 2)
    if known_to > _MOST:
        raise DataError(
            f"{what}: offsets up to {2 * known_to:.0f} seconds apart explain the motion equally well; use a part of "
            "the drive with stops and starts, or correct the times of the table"
        )
    shift = 0.0
    if 0 < best < len(r) - 1:  # the top of the parabola through three points
        before, top, after = r[best - 1 : best + 2]
        shift = 0.5 * (before - after) / max(before - 2 * top + after, -1e9) if top > max(before, after) else 0.0
    offset = float(offsets[best] + shift * STEP + ticks[0] - times[0])
    moved = {**table.drives, name: (ticks - offset, speeds)}
    return replace(table, drives=moved), Alignment(offset, known_to, float(r[best]))


def _memory(times: Series, motion: Series, speeds: Series) -> float:
    """Return the seconds over which what a line through speed and motion leaves is alike: one independent sample."""
    left = motion - np.polyval(np.polyfit(speeds, motion, 1), speeds)
    step = float(np.median(np.diff(times)))
    alike = fftconvolve(left, left[::-1])[len(left) - 1 :]
    alike = alike / max(float(alike[0]), 1e-12)
    return step * (1 + 2 * float(np.sum(alike[1 : max(1, int(np.argmax(alike < 0)))])))


def _correlations(ticks: Series, speeds: Series, times: Series, motion: Series) -> tuple[Series, Series, Series]:
    """Return offsets (table minus frames) at which enough is common, the correlation at each, and common seconds."""
    table = np.interp(np.arange(0, ticks[-1], STEP), ticks, speeds)
    places = np.round(times / STEP).astype(int)
    frames = np.zeros(places[-1] + 1)
    count = np.bincount(places, minlength=len(frames)).astype(np.float64)
    np.add.at(frames, places, motion)
    frames[count > 0] /= count[count > 0]
    there = (count > 0).astype(np.float64)
    gain = there / there.mean()

    def sums(a: Series, b: Series) -> Series:
        return np.asarray(fftconvolve(a, b[::-1]))  # for b shifted by 1 - len(b), ..., len(a) - 1 steps

    table = (table - table.mean()) / max(float(table.std()), 1e-9)
    frames = there * (frames - motion.mean()) / max(float(motion.std()), 1e-9)
    ones = np.ones_like(table)
    n = np.maximum(sums(ones, there), 1e-6)
    s, ss = sums(table, there) / n, sums(table**2, there) / n
    m, mm = sums(ones, frames) / n, sums(ones, frames**2) / n
    covariance = sums(table, frames) / n - s * m
    spread = np.sqrt(np.maximum(ss - s**2, 0) * np.maximum(mm - m**2, 0))
    seconds = n * gain.max() * STEP
    enough = seconds >= max(_SHORTEST, 0.5 * min(len(table), len(frames)) * STEP)
    r = np.where(spread > 1e-3, covariance / np.maximum(spread, 1e-3), 0.0)
    offsets = (np.arange(len(r)) - (len(frames) - 1)) * STEP
    return offsets[enough], np.clip(r[enough], 0.0, 0.9999), seconds[enough]
