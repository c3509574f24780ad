"""Data with a few broken files: read on, and say how many were passed over (``data.on_error=skip``)."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import torch

from saunet.data.checks import check_frame
from saunet.data.loading.windows import Selection, WindowDataset
from saunet.errors import DataError

_PATIENCE = 100
"""Samples in a row that may be broken before it is the data set that is, not a file."""


class SkippingWindows(WindowDataset):
    """Training windows in which a sample that cannot be read is replaced by the next one, once named and counted.

    The count is shared by all loader processes.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._broken = torch.zeros(len(self.windows), dtype=torch.uint8).share_memory_()  # type: ignore[no-untyped-call]

    def skipped(self) -> list[str]:
        """Return the names of the samples that could not be read so far."""
        return [self.name(int(index)) for index in self._broken.nonzero()[:, 0]]

    def _sample(self, index: int) -> dict[str, Any]:
        problem: DataError | None = None
        for step in range(min(_PATIENCE, len(self))):
            place = (index + step) % len(self)
            if self._broken[place]:
                continue
            try:
                return super()._sample(place)
            except DataError as error:
                problem = error
                self._broken[place] = 1
                warnings.warn(f"sample skipped: {error}", stacklevel=2)
        reason = f"; the last: {problem}" if problem else ""
        raise DataError(
            f"{min(_PATIENCE, len(self))} samples in a row cannot be read, so on_error=skip gives up{reason}"
        )


def readable(selection: Selection, offsets: Sequence[int], with_depth: bool) -> Selection:
    """Return a selection without the frames that cannot be read, themselves or a neighbor, each decoded once."""
    drive, existing = selection.drive, set(selection.drive.indices)
    needed = {frame + offset for frame in selection.frames for offset in (0, *offsets)} & existing
    broken = set()
    for frame in sorted(needed):
        try:
            check_frame(drive, frame, drive.image(frame))
            drive.intrinsics(frame)
            if with_depth and frame in selection.frames:
                drive.depth(frame)
        except DataError as error:
            broken.add(frame)
            warnings.warn(f"frame left out: {error}", stacklevel=2)
    kept = [frame for frame in selection.frames if not any(frame + offset in broken for offset in (0, *offsets))]
    lost = len(selection.frames) - len(kept)
    return Selection(drive, kept, {**selection.left_out, "unreadable": lost})
