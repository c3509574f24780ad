"""What a recording provides: the interface between data sets and everything that reads them."""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

GAP = 1.5
"""A time step longer than this many median steps is a gap."""
_NAMED = 3
"""Number of camera files that a line names."""


@dataclass(frozen=True, slots=True)
class LensModel:
    """The lens of recorded pictures that are undistorted as they are read (see docs/cameras.md)."""

    model: str
    """Such as ``pinhole`` or ``fisheye``."""
    coefficients: tuple[float, ...]
    """Of its distortion."""
    K: NDArray[np.float64]
    """3 x 3, pixels of the recorded picture."""


class Drive(ABC):
    """One continuous recording of one camera; every data set is presented to training as a list of these.

    Subclass it and implement `name`, `indices`, `image` and `intrinsics`. Everything else has a default that says
    "unknown" (None, False, an empty string); override what the data set knows. Frames are addressed by their index in
    the recording; indices ascend with time and may have gaps.

    Examples:
        >>> data = saunet.build("data", "synthetic_tiny", workers=0)
        >>> data.setup("fit")
        >>> drive = data.datasets["train"].drives[0]
        >>> isinstance(drive, saunet.Drive), drive.image(0).ndim
        (True, 3)
    """

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        for attribute in ("protocol", "ground_truth"):
            if attribute in vars(cls):
                raise TypeError(
                    f"{cls.__name__} has the attribute '{attribute}', which is ignored in a Drive: evaluation "
                    "settings are attributes of the DepthDataModule; move it there"
                )

    @property
    @abstractmethod
    def name(self) -> str:
        """Readable name, unique in the data set, such as ``2011_09_26/2011_09_26_drive_0001_sync l``."""

    @property
    @abstractmethod
    def indices(self) -> Sequence[int]:
        """Indices of the frames that exist, ascending."""

    @abstractmethod
    def image(self, index: int) -> NDArray[np.uint8]:
        """Return the frame, h x w x 3, RGB."""

    @abstractmethod
    def intrinsics(self, index: int) -> NDArray[np.float64]:
        """Return K, 3 x 3, in pixels of `image` (integer coordinates are pixel centers)."""

    def has_depth(self, index: int) -> bool:
        """Return whether `depth` gives a map; override it if that is known without reading one."""
        return self.depth(index) is not None

    def depth(self, index: int) -> NDArray[np.float32] | None:
        """Return ground-truth depth, h x w, meters, 0 where unknown; None if there is none."""
        return None

    def depth_key(self, index: int) -> str | None:
        """Return a hash of everything `depth` is computed from, to cache it; None if it is just read."""
        return None

    def pose(self, index: int) -> NDArray[np.float64] | None:
        """Return T_world_cam, 4 x 4, meters (x right, y down, z forward); None if unknown."""
        return None

    def time(self, index: int) -> float | None:
        """Return when the frame was taken, seconds from any fixed origin; None if unknown."""
        return None

    @property
    def timestamps(self) -> NDArray[np.float64] | None:
        """`time` of each of `indices`, NaN if unknown; None if no time is known."""
        times = np.array([self.time(index) for index in self.indices], dtype=np.float64)
        return None if np.isnan(times).all() else times

    @property
    def fps(self) -> float | None:
        """Frames per second as recorded, by default from the median step of `timestamps`; None if unknown."""
        times, numbers = self.timestamps, [self.recorded(index) for index in self.indices]
        if times is None or len(times) < 2:
            return None
        step = float(np.nanmedian(np.diff(times) / np.diff(numbers)))
        return 1 / step if step > 0 else None

    @property
    def gaps(self) -> frozenset[int]:
        """Indices of frames followed by a gap in time, which no window may bridge.

        By default those followed by a step of `timestamps` longer than `GAP` times the median step.
        """
        times = self.timestamps
        if times is None or len(times) < 3:
            return frozenset()
        steps = np.diff(times) / np.diff(self.indices)
        return frozenset(self.indices[place] for place in np.flatnonzero(steps > GAP * np.nanmedian(steps)).tolist())

    @property
    def duplicates(self) -> Sequence[float]:
        """Times of recorded frames that repeat the previous picture and have no index; empty if there are none."""
        return ()

    def speed(self, index: int) -> float | None:
        """Return the speed of the vehicle in m/s; None if unknown."""
        return None

    def distance(self, first: int, second: int) -> float | None:
        """Return the distance traveled between two frames in meters, at least 0; None if unknown.

        By default the straight line between their poses; without poses, speed integrated over the time between the
        frames.
        """
        T_world_first, T_world_second = self.pose(first), self.pose(second)
        if T_world_first is not None and T_world_second is not None:
            return float(np.linalg.norm(T_world_second[:3, 3] - T_world_first[:3, 3]))
        if self.speed(first) is None:  # before listing every index, which may read a folder
            return None
        between = [index for index in self.indices if min(first, second) <= index <= max(first, second)]
        known = [(self.time(index), self.speed(index)) for index in between]
        pairs = [(time, speed) for time, speed in known if time is not None and speed is not None]
        if len(pairs) < len(known):
            return None
        times, speeds = np.reshape(pairs, (-1, 2)).T
        return float((np.diff(times) * np.abs(speeds[1:] + speeds[:-1]) / 2).sum())

    def stereo(self) -> Drive | None:
        """Return the recording of a rectified pair's other camera, with the same K and indices; None if there is none.

        Raises:
            DataError: if there is a second camera, but its files are missing or broken.
        """
        return None

    @property
    def T_stereo_cam(self) -> NDArray[np.float64] | None:  # noqa: N802 (frames in names)
        """The pose of this camera in the other's frame, 4 x 4, meters: it maps points of this camera to the other."""
        return None

    def path(self, index: int) -> Path | None:
        """Return the image file of a frame; None if it is not stored as one."""
        return None

    @property
    def folder(self) -> Path | None:
        """Folder of the recording; depth maps may be stored beside it. None if it has none."""
        return None

    @property
    def frame_size(self) -> tuple[int, int] | None:
        """(height, width) that every frame should have; None if unknown."""
        return None

    def recorded(self, index: int) -> int:
        """Return a frame's number in its original file, from 0; it differs if `indices` count only chosen frames."""
        return index

    @property
    def numbering(self) -> str:
        """Settings that decide which frame an index means; empty if none do."""
        return ""

    @property
    def camera_id(self) -> str | None:
        """A text that differs between recordings of different cameras; None if all of a data set are of one kind."""
        return None

    @property
    def camera_file(self) -> Path | None:
        """The file that describes the camera, where each recording may have its own; None if there is none."""
        return None

    @property
    def lens(self) -> LensModel | None:
        """The lens that `recorded_image` shows and `image` corrects; None if images are as recorded."""
        return None

    def recorded_image(self, index: int) -> NDArray[np.uint8]:
        """Return the frame before it is undistorted, h x w x 3, RGB; `image` if `lens` is None."""
        return self.image(index)

    @property
    def scene_mask(self) -> NDArray[np.bool_] | None:
        """True where frames show the scene, not the recording vehicle, h x w; None if everywhere."""
        return None

    @property
    def has_scene_mask(self) -> bool:
        """Whether `scene_mask` gives one; override it if that is known without reading one."""
        return self.scene_mask is not None

    @property
    def origin(self) -> str:
        """Whatever besides the image files decides a frame's pixels (camera, crop), as text; empty if nothing does."""
        return ""

    @property
    def camera_height(self) -> float | None:
        """Meters from the road to the camera; None if unknown."""
        return None

    @property
    def condition(self) -> str | None:
        """Weather or light, such as ``night``, to group results by; None if unknown."""
        return None


def camera_files(drives: Iterable[Drive]) -> str:
    """Return a line that names the camera files of recordings, the most used first; empty if they have none."""
    named = {drive.name: drive.camera_file for drive in drives}
    used = Counter(file for file in named.values() if file is not None).most_common()
    if len(used) < 2:
        return f"camera: {used[0][0]}" if used else ""
    listed = [f"{file} ({count} clip{'s' if count > 1 else ''})" for file, count in used[:_NAMED]]
    return f"cameras: {len(used)} files: {', '.join([*listed, *['...'] * (len(used) > _NAMED)])}"


class DriveProxy(Drive):
    """A recording that delegates everything to another; a subclass overrides what differs."""

    def __init__(self, drive: Drive) -> None:
        self._drive = drive

    @property
    def name(self) -> str:
        return self._drive.name

    @property
    def indices(self) -> Sequence[int]:
        return self._drive.indices

    def image(self, index: int) -> NDArray[np.uint8]:
        return self._drive.image(index)

    def intrinsics(self, index: int) -> NDArray[np.float64]:
        return self._drive.intrinsics(index)


def _passed_on(name: str, member: Any) -> Any:
    if isinstance(member, property):
        return property(attrgetter(f"_drive.{name}"), doc=member.__doc__)

    @functools.wraps(member)
    def ask(self: DriveProxy, *args: Any, **kwargs: Any) -> Any:
        return attrgetter(f"_drive.{name}")(self)(*args, **kwargs)

    return ask


for _name, _member in vars(Drive).items():  # the rest of the interface, so that no member is forgotten
    if not _name.startswith("_") and _name not in vars(DriveProxy):
        setattr(DriveProxy, _name, _passed_on(_name, _member))
