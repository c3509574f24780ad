"""Synthetic drives rendered once a test run, for tests of what is done with them."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from saunet.synthetic import SyntheticDrive
from saunet.synthetic.world import turn


class Winding(SyntheticDrive):
    """A rendered street driven in bends of 30 degrees to both sides."""

    def pose(self, index: int) -> NDArray[np.float64]:
        heading = np.radians(30) * np.sin(2 * np.pi * np.arange(index + 1) / 40)
        T = super().pose(0).copy()
        T[:3, :3] = turn(heading[-1]) @ T[:3, :3]
        T[0, 3] += 0.45 * np.sin(heading).sum()
        T[2, 3] += 0.45 * np.cos(heading).sum()
        return T


@contextlib.contextmanager
def share_renderings() -> Iterator[None]:
    """Let drives with equal settings share what they have generated and rendered, which is equal too."""
    checked, known = SyntheticDrive.__post_init__, dict[Any, SyntheticDrive]()

    def shared(drive: SyntheticDrive) -> None:
        checked(drive)
        settings = tuple(getattr(drive, each.name) for each in dataclasses.fields(drive) if each.init)
        first = known.setdefault(settings, drive)
        drive._frames, drive.__dict__["world"] = first._frames, first.world
        drive.__dict__["travel"] = first.travel

    SyntheticDrive.__post_init__ = shared  # type: ignore[method-assign]
    try:
        yield
    finally:
        SyntheticDrive.__post_init__ = checked  # type: ignore[method-assign]
