"""Frames recorded while the car stood: they teach nothing, since nothing moves between neighbors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from saunet.data.drive import Drive
from saunet.data.frame_size import check_frame
from saunet.errors import DataError

FLOW_WIDTH = 320
"""Images are made this wide before flow is measured, so that thresholds mean the same for every camera."""
MIN_FLOW = 0.5
"""Pixels of median flow, at 320 pixels width, under which a frame counts as static."""


def oxts_speed(path: Path) -> float:
    """Return the speed in m/s of a record of KITTI's inertial unit: the length of (vf, vl, vu).

    Raises:
        DataError: if the file cannot be read or holds no such record.
    """
    try:
        words = path.read_text(encoding="utf-8", errors="replace").split()
        velocity = np.array([float(word) for word in words[8:11]])
    except OSError as reason:
        raise DataError(f"cannot read {path}: {reason.strerror or reason}") from reason
    except ValueError:
        velocity = np.empty(0)
    if velocity.size != 3 or not np.isfinite(velocity).all():
        raise DataError(f"{path}: expected the 30 numbers of an OXTS record; values 9 to 11 are the speeds vf, vl, vu")
    return float(np.linalg.norm(velocity))


def median_flow(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> float:
    """Return the median length of the optical flow between two images, in pixels of an image 320 pixels wide.

    Args:
        first: RGB, h x w x 3.
        second: RGB, h x w x 3.
    """
    return float(np.median(np.linalg.norm(optical_flow(first, second), axis=-1)))


def optical_flow(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the optical flow between two images, h x w x 2, in pixels of an image 320 pixels wide.

    Args:
        first: RGB, h x w x 3.
        second: RGB, h x w x 3.
    """
    before, after = _small(first), _small(second)
    flow = np.zeros((*before.shape, 2), np.float32)
    measure = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    return np.asarray(measure.calc(before, after, flow), dtype=np.float32)


def _small(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height = max(32, round(image.shape[0] * FLOW_WIDTH / image.shape[1]))
    small = cv2.resize(image, (FLOW_WIDTH, height), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def static_by_flow(drive: Drive, frames: Sequence[int], min_flow: float, *, skip_unreadable: bool = False) -> set[int]:
    """Return the frames that look like the frame before them (after them for the first), each image decoded once.

    Args:
        drive: The recording.
        frames: The frames to judge.
        min_flow: Median flow in pixels, at 320 pixels width, from which a frame counts as moving.
        skip_unreadable: Count frames that cannot be read as moving in place of raising; who reads them later says so.

    Raises:
        DataError: naming the first frame that cannot be read or has another size, unless ``skip_unreadable``.
    """
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
