"""What a recording must offer, so that training, evaluation and preparation can work on any data set."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray


@runtime_checkable
class Drive(Protocol):
    """One continuous recording of one camera: what every data set is reduced to before training sees it.

    Frames are addressed by their number in the recording; numbers may have gaps.
    """

    name: str
    """Readable and unique in the data set, such as ``2011_09_26/2011_09_26_drive_0001_sync l``."""

    @property
    def indices(self) -> Sequence[int]:
        """Numbers of the frames that exist, ascending."""

    def image(self, index: int) -> NDArray[np.uint8]:
        """Return the frame, h x w x 3, RGB."""

    def intrinsics(self, index: int) -> NDArray[np.float64]:
        """Return K, 3 x 3, in pixels of `image` (integer coordinates are pixel centers)."""

    def depth(self, index: int) -> NDArray[np.float32] | None:
        """Return ground-truth depth, h x w, meters, 0 where unknown; None where there is none."""

    def pose(self, index: int) -> NDArray[np.float64] | None:
        """Return T_world_cam, 4 x 4, meters (x right, y down, z forward); None where unknown."""


@runtime_checkable
class StereoDrive(Drive, Protocol):
    """A recording with a second camera beside it; both share one rectified image plane and one K."""

    def partner(self) -> Drive:
        """Return the other camera's recording of the same drive, with the same frame numbers."""

    @property
    def T_partner_cam(self) -> NDArray[np.float64]:  # noqa: N802 (frames in names)
        """Where the partner is, 4 x 4, meters: a point of this camera times it is a point of the partner."""


@runtime_checkable
class MeasuredDrive(Drive, Protocol):
    """A recording that knows how far the car went, from its speed or its poses."""

    def distance(self, first: int, second: int) -> float | None:
        """Return the meters traveled between two frames, at least 0; None where unknown."""


@runtime_checkable
class ClockedDrive(Drive, Protocol):
    """A recording whose frame numbers are ours, and which knows the numbers and the rate of the file behind them."""

    @property
    def fps(self) -> float | None:
        """Frames a second as recorded; None where nobody says."""

    def recorded(self, index: int) -> int:
        """Return the number of a frame as recorded, from 0."""
