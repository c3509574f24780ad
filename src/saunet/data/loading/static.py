"""Frames recorded while the car stood still: they teach nothing, since nothing moves between neighbors."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from saunet.data.checks import check_frame
from saunet.data.drive import Drive
from saunet.data.loading.windows import Selection
from saunet.errors import DataError

MIN_SPEED = 0.5
"""Meters a second under which a car counts as standing."""
FLOW_WIDTH = 320
"""Images are made this wide before flow is measured, so that thresholds mean the same for every camera."""
MIN_FLOW = 0.5
"""Pixels of median flow, at 320 pixels width, under which a frame counts as static."""


def median_flow(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> float:
    """Return the median length of the optical flow between two images, in pixels of an image 320 pixels wide."""
    return float(np.median(np.linalg.norm(optical_flow(first, second), axis=-1)))


def optical_flow(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the optical flow between two images, h x w x 2, in pixels of an image 320 pixels wide."""
    before, after = _small(first), _small(second)
    flow = np.zeros((*before.shape, 2), np.float32)
    measure = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    return np.asarray(measure.calc(before, after, flow), dtype=np.float32)


def _small(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height = max(32, round(image.shape[0] * FLOW_WIDTH / image.shape[1]))
    small = cv2.resize(image, (FLOW_WIDTH, height), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def static_by_flow(drive: Drive, frames: Sequence[int], min_flow: float, *, skip_unreadable: bool = False) -> set[int]:
    """Return the frames that look like the frame before them (after them for the first), each image decoded once."""
    existing, wanted = set(drive.indices), set(frames)
    static: set[int] = set()
    last: tuple[int, NDArray[np.uint8]] | None = None
    for frame in sorted(existing & (wanted | {each - 1 for each in wanted} | {each + 1 for each in wanted})):
        try:
            image = drive.image(frame)
            check_frame(drive, frame, image)
        except DataError:
            if not skip_unreadable:
                raise
            existing.discard(frame)  # the frame after it is then judged as a first one
            continue
        if last is not None and last[0] == frame - 1 and median_flow(last[1], image) < min_flow:
            static.add(frame)
            if frame - 2 not in existing:
                static.add(frame - 1)
        last = (frame, image)
    return static & wanted


def moving(selection: Selection, *, by_speed: bool, skip_unreadable: bool = False) -> Selection:
    """Return a selection without the frames in which the car stands, and their count as ``static``."""
    drive, existing = selection.drive, set(selection.drive.indices)
    frames = [frame for frame in selection.frames if frame in existing]
    speeds = {frame: _speed(drive, frame, skip_unreadable) if by_speed else None for frame in frames}
    static = {frame for frame, speed in speeds.items() if speed is not None and speed < MIN_SPEED}
    unknown = [frame for frame, speed in speeds.items() if speed is None]
    static |= static_by_flow(drive, unknown, MIN_FLOW, skip_unreadable=skip_unreadable)
    kept = [frame for frame in selection.frames if frame not in static]
    return Selection(drive, kept, {**selection.left_out, "static": len(static)})


def has_speed(selection: Selection, skip_unreadable: bool = False) -> bool:
    """Tell whether the speed is known in any of the frames."""
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
