"""The one size that the frames of a recording share, to which its K belongs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from saunet.data.drive import Drive
from saunet.errors import DataError
from saunet.io.images import image_size

LOOKED_AT = 5
"""Frames whose size is looked at: a broken or odd one among them decides nothing."""


def common_size(paths: Sequence[Path]) -> tuple[Path, tuple[int, int]]:
    """Return the (height, width) that most of a recording's readable frames have, and a frame that has it.

    Args:
        paths: Its frames in order; a few of them, the first included, are looked at.

    Raises:
        DataError: naming the first, if none of those looked at can be read.
    """
    sizes: dict[Path, tuple[int, int]] = {}
    problem: DataError | None = None
    for place in np.linspace(0, len(paths) - 1, min(LOOKED_AT, len(paths))).round().astype(int):
        try:
            sizes[paths[place]] = image_size(paths[place])
        except DataError as error:
            problem = problem or error
    if not sizes:
        raise problem or DataError("a recording without frames has no size")
    (size, _), *_ = Counter(sizes.values()).most_common()
    return next(path for path, each in sizes.items() if each == size), size


def check_frame(drive: Drive, frame: int, image: NDArray[np.uint8]) -> None:
    """Check that a frame has the size that its recording's K belongs to.

    Args:
        drive: The recording; one that does not know its ``frame_size`` passes.
        frame: Number of the frame.
        image: The frame, h x w x 3.

    Raises:
        DataError: naming the frame's file, if it has another size.
    """
    size = drive.frame_size
    if size is not None and image.shape[:2] != size:
        what = drive.path(frame) or f"frame {frame}"
        raise DataError(
            f"{what} is {image.shape[1]}x{image.shape[0]} (width x height) where the frames of '{drive.name}' are "
            f"{size[1]}x{size[0]}; frames of a recording share one size"
        )
