"""Tables of speeds whose clock starts at another time than the frames'."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from saunet.errors import DataError
from saunet.io.alignment import align_speeds
from saunet.io.speeds import SpeedTable


def stop_and_go(seconds: np.ndarray, seed: int = 0) -> np.ndarray:
    """Speeds of a drive through a town, m/s: other speeds every 8 to 25 seconds, reached at 2 m/s²."""
    random, at, knots = np.random.default_rng(seed), 0.0, [(-500.0, 0.0)]
    while at < 2000:
        target = random.choice([0.0, 4.0, 8.0, 13.0])
        knots += [(at, knots[-1][1]), (at + abs(target - knots[-1][1]) / 2 + 0.01, target)]
        at += random.uniform(8, 25)
    return np.interp(seconds, *zip(*knots, strict=True))


def table(ticks: np.ndarray, speeds: np.ndarray) -> SpeedTable:
    return SpeedTable(Path("speeds.csv"), "time", {"": (ticks, speeds)})


def seen(times: np.ndarray, speeds: np.ndarray, seed: int = 1) -> np.ndarray:
    """Motion in the pictures: speed in an unknown unit, a third off at random, and turns."""
    random = np.random.default_rng(seed)
    motion = 3.7 * speeds * np.exp(random.normal(0, 0.3, len(times))) + random.uniform(0, 2, len(times))
    for start in random.uniform(times[0], times[-1], 4):
        motion[(times > start) & (times < start + 3)] += 60
    return motion


@pytest.mark.parametrize("offset", [0.0, 12.34, -47.7, 1_700_000_000.25])
@pytest.mark.parametrize(("rate", "lasts"), [(10, 120), (2.5, 600)])
def test_the_offset_is_found(offset: float, rate: float, lasts: int) -> None:
    times = np.arange(0, lasts, 1 / rate)
    ticks = np.arange(-60, lasts + 90, 0.5)  # the logger ran longer
    moved, found = align_speeds(table(ticks + offset, stop_and_go(ticks)), "a", times, seen(times, stop_and_go(times)))
    assert found.offset == pytest.approx(offset, abs=0.4)
    assert abs(found.offset - offset) <= found.known_to <= 2
    assert found.correlation > 0.7
    assert f"{found.offset:+.2f} s" in str(found)
    assert moved.mean(30.0, 40.0) == pytest.approx(stop_and_go(np.arange(30, 40, 0.01)).mean(), abs=0.6)


def test_gaps_in_either_do_not_matter() -> None:
    times = np.concatenate([np.arange(0, 60, 0.1), np.arange(95, 180, 0.1)])
    motion = seen(times, stop_and_go(times))
    motion[100:140] = math.nan
    ticks = np.arange(20, 160, 1.0)  # it began later and ended earlier
    _, found = align_speeds(table(ticks + 5000, stop_and_go(ticks)), "", times, motion)
    assert found.offset == pytest.approx(5000, abs=0.3)


def test_without_a_clear_peak_it_is_refused() -> None:
    times, ticks = np.arange(0, 200, 0.1), np.arange(0, 400, 0.5)
    motion = seen(times, stop_and_go(times))
    for speeds, words in (
        *((stop_and_go(ticks, seed), "no offset|equally well") for seed in range(50, 56)),  # of other drives
        (np.full(len(ticks), 25.0), "at no offset"),
        (8 + 4 * np.sin(ticks / 3), "no offset|equally well"),
    ):
        with pytest.raises(DataError, match=rf"speeds\.csv cannot be aligned.*({words})"):
            align_speeds(table(ticks, speeds), "", times, motion)
    rounds = 8 + 4 * np.sin(2 * np.pi * np.arange(0, 400, 0.1) / 40)  # laps of 40 s: which one is it?
    with pytest.raises(DataError, match="seconds apart explain the motion equally well"):
        align_speeds(table(np.arange(0, 400, 0.1), rounds), "", times, 8 + 4 * np.sin(2 * np.pi * times / 40))
    with pytest.raises(DataError, match="at least 20 seconds"):
        align_speeds(table(ticks[:10], ticks[:10]), "", times, motion)
    frames = SpeedTable(Path("speeds.csv"), "frame", {"": (ticks, ticks)})
    with pytest.raises(DataError, match="no speeds with times for 'a'"):
        align_speeds(frames, "a", times, motion)
