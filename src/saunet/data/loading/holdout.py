"""Frames held out for validation: whole drives, a random share, or the tails of drives."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from saunet.errors import ConfigError


class Frame(NamedTuple):
    """One frame of one camera."""

    drive: str
    """``<date>/<drive>``."""
    number: int
    side: str
    """``l`` or ``r``."""

    def __str__(self) -> str:
        return f"{self.drive} {self.number:010d} {self.side}"


Parts = tuple[list[Frame], list[Frame]]
"""Training and validation frames."""


def hold_out_drives(frames: Iterable[Frame], drives: Iterable[str]) -> Parts:
    """Put the frames of the named drives into validation; a name may be the end of ``<date>/<drive>``."""
    frames, held = list(frames), set()
    known = sorted({frame.drive for frame in frames})
    for name in drives:
        fitting = [drive for drive in known if drive == name or drive.endswith(f"/{name}")]
        if not fitting:
            raise ConfigError(f"no drive '{name}' to hold out; drives: {', '.join(known[:40])}")
        held.update(fitting)
    return [f for f in frames if f.drive not in held], [f for f in frames if f.drive in held]


def hold_out_random(frames: Iterable[Frame], share: float, seed: int) -> Parts:
    """Put a seeded random share of the frames, each camera for itself, into validation."""
    ordered = sorted(frames)
    chosen = set(np.random.default_rng(seed).permutation(len(ordered))[: math.ceil(share * len(ordered))].tolist())
    return (
        [frame for place, frame in enumerate(ordered) if place not in chosen],
        [frame for place, frame in enumerate(ordered) if place in chosen],
    )


def hold_out_tails(frames: Iterable[Frame], share: float, gap: int) -> Parts:
    """Put the last share of each drive into validation, and leave out ``gap`` frames before it.

    With a gap as long as the farthest neighbors of both sides, no validation window shares a frame with a training
    window.
    """
    train, val = [], []
    by_drive: dict[str, set[int]] = {}
    frames = list(frames)
    for frame in frames:
        by_drive.setdefault(frame.drive, set()).add(frame.number)
    first_held = {}
    for drive, numbers in by_drive.items():
        ordered = sorted(numbers)
        held = math.ceil(share * len(ordered))
        first_held[drive] = ordered[-held] if held else ordered[-1] + gap + 1
    for frame in frames:
        if frame.number >= first_held[frame.drive]:
            val.append(frame)
        elif frame.number < first_held[frame.drive] - gap:
            train.append(frame)
    return train, val


def hold_out(frames: Sequence[Frame], share: float, gap: int, seed: int) -> Parts:
    """Hold out whole drives, drawn by seed, where there are ten or more; the tails of all drives where there are fewer.

    Drives are added until they hold the share; a drive that would exceed twice the share is passed over.

    Args:
        frames: All frames there are.
        share: Of the frames to hold out, 0 to 1.
        gap: Frames to leave between a training part and a held-out tail.
        seed: Decides which drives are held out.
    """
    counts: dict[str, int] = {}
    for frame in frames:
        counts[frame.drive] = counts.get(frame.drive, 0) + 1
    if len(counts) < 10:
        return hold_out_tails(frames, share, gap)
    held: list[str] = []
    wanted, total = share * len(frames), 0
    names = sorted(counts)
    for place in np.random.default_rng(seed).permutation(len(names)):
        if total < wanted and total + counts[names[place]] <= 2 * wanted:
            held.append(names[place])
            total += counts[names[place]]
    return hold_out_drives(frames, held)
