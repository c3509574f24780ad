"""Selections without the frames of a standing car, by its recorded speed and, where that is unknown, by flow."""

from __future__ import annotations

import warnings

from saunet.data.drive import Drive
from saunet.data.static import MIN_FLOW, static_by_flow
from saunet.data.windows import Selection
from saunet.errors import DataError

MIN_SPEED = 0.5
"""Meters a second under which a car counts as standing."""


def moving(selection: Selection, *, by_speed: bool, skip_unreadable: bool = False) -> Selection:
    """Return a selection without the frames in which the car stands, and their count as ``static``.

    Args:
        selection: Frames of one drive.
        by_speed: Judge by the OXTS speed where it is known; else, and without this everywhere, by flow.
        skip_unreadable: Keep frames that cannot be read, in place of raising; who reads them later passes them over.

    Raises:
        DataError: naming the first record or frame that cannot be read, unless ``skip_unreadable``.
    """
    drive, existing = selection.drive, set(selection.drive.indices)
    frames = [frame for frame in selection.frames if frame in existing]
    speeds = {frame: _speed(drive, frame, skip_unreadable) if by_speed else None for frame in frames}
    static = {frame for frame, speed in speeds.items() if speed is not None and speed < MIN_SPEED}
    unknown = [frame for frame, speed in speeds.items() if speed is None]
    static |= static_by_flow(drive, unknown, MIN_FLOW, skip_unreadable=skip_unreadable)
    kept = [frame for frame in selection.frames if frame not in static]
    return Selection(drive, kept, {**selection.left_out, "static": len(static)})


def has_speed(selection: Selection, skip_unreadable: bool = False) -> bool:
    """Tell whether the speed is known in any of the frames.

    Raises:
        DataError: naming a broken record that comes before the first good one, unless ``skip_unreadable``.
    """
    return any(_speed(selection.drive, frame, skip_unreadable) is not None for frame in selection.frames)


def _speed(drive: Drive, frame: int, skip_unreadable: bool) -> float | None:
    """Return the speed in m/s; None where it is unknown, with ``skip_unreadable`` also for a broken record."""
    try:
        return drive.speed(frame)
    except DataError as error:
        if not skip_unreadable:
            raise
        warnings.warn(f"speed unknown: {error}", stacklevel=2)
        return None
