"""One clip of any camera as a `Drive`: straightened and cropped frames, without doubled ones, in steps of choice."""

from __future__ import annotations

import functools
import hashlib
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from saunet.data.checks import common_size
from saunet.data.drive import GAP, Drive
from saunet.data.video.clips import Clip, Recording
from saunet.data.video.lens import Lens
from saunet.data.video.motion import Motion, even_steps
from saunet.io.images import read_image

LONGEST_STEP = 5.0
"""Seconds between two frames beyond which they are no neighbors: too much has moved meanwhile."""


class ClipDrive(Drive):
    """A clip of any camera.

    Frames are numbered anew from 0 in the order of time, without those that are left out; a number is skipped where
    frames on both sides are no neighbors (a broken image or a long stop between them).
    """

    def __init__(
        self,
        clip: Clip,
        recording: Recording,
        crop: Sequence[float | int] | None = None,
        motion: Motion | None = None,
        parallax: float = 0.0,
        settings: str = "",
        camera_height: float | None = None,
    ) -> None:
        self.clip, self.recording, self._crop = clip, recording, crop
        self._settings, self._camera_height = settings, camera_height
        self._places, self._left_out = _choose(recording, motion, parallax)
        self._indices = sorted(self._places)
        self._still = frozenset(np.flatnonzero(motion.static()).tolist()) if motion else frozenset()

    @property
    def name(self) -> str:
        return self.clip.name

    @property
    def numbering(self) -> str:
        return self._settings

    @property
    def indices(self) -> Sequence[int]:
        return self._indices

    @property
    def left_out(self) -> Mapping[str, int]:
        """Frames of the recording that got no number, and why."""
        return self._left_out

    @property
    def camera_height(self) -> float | None:
        """Meters of the camera above the road; None where the camera file does not say."""
        known = self.clip.camera.camera_height
        return self._camera_height if known is None else known

    @property
    def condition(self) -> str | None:
        """What the camera file says about weather and light."""
        return self.clip.camera.condition

    @property
    def fps(self) -> float | None:
        """Frames a second of the recording; None where nobody says."""
        return self.recording.fps

    def time(self, index: int) -> float | None:
        """Return when the frame was taken: as recorded, or by its number where only the frame rate is known."""
        if self.recording.times is not None:
            return self.recording.times[self._places[index]]
        return None if self.fps is None else self.recorded(index) / self.fps

    @functools.cached_property
    def gaps(self) -> frozenset[int]:
        """Indices of frames after which the recording lacks frames; the steps between chosen frames are no measure."""
        times, numbers = self.recording.times, self.recording.numbers
        if times is None or len(times) < 3:
            return frozenset()
        steps = np.diff(times) / np.diff(numbers)
        lost = np.concatenate([[0], np.cumsum(steps > GAP * np.median(steps))])
        return frozenset(
            before
            for before, after in itertools.pairwise(self._indices)
            if lost[self._places[before]] != lost[self._places[after]]
        )

    def static(self) -> frozenset[int]:
        """Return the numbers of the frames in which the picture does not move."""
        return frozenset(index for index, place in self._places.items() if place in self._still)

    @property
    def frame_size(self) -> tuple[int, int]:
        """(height, width) of `image`."""
        return self._lens.height, self._lens.width

    @functools.cached_property
    def origin(self) -> str:
        """What the numbers and the pixels of the frames depend on, as a hash: camera, crop, and which file is which."""
        camera, lens = self.clip.camera, self._lens
        files = [(index, self.recorded(index), self.path(index).name) for index in self._indices]
        text = repr((lens.K.tolist(), lens.recorded, self.frame_size, camera.model, camera.distortion, files))
        return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()[:16]

    def path(self, index: int) -> Path:
        """Return the image file of a frame (in the cache, where the clip is a video)."""
        return self.recording.paths[self._places[index]]

    def recorded(self, index: int) -> int:
        """Return the number of a frame in the clip as recorded, from 0."""
        return self.recording.numbers[self._places[index]]

    def image(self, index: int) -> NDArray[np.uint8]:
        """Return the frame, undistorted and cropped, h x w x 3, RGB."""
        path = self.path(index)
        return self._lens(read_image(path), str(path))

    def intrinsics(self, index: int) -> NDArray[np.float64]:
        """Return K, 3 x 3, in pixels of `image`."""
        return self._lens.K.copy()

    @functools.cached_property
    def _lens(self) -> Lens:
        example, size = common_size([self.path(index) for index in self._indices])
        return Lens(self.clip.camera, *size, self._crop, f"the frames of '{self.name}' ({example.name})")


def _choose(recording: Recording, motion: Motion | None, parallax: float) -> tuple[dict[int, int], dict[str, int]]:
    """Return frame number -> place in the recording, and how many places got none, by reason."""
    count = len(recording.paths)
    left_out = {"not decodable": recording.missing, "passed over by fps": recording.passed_over}
    if motion is None:
        return {place: place for place in range(count)}, left_out
    broken = np.isin(np.arange(count), motion.unreadable)
    doubled = motion.doubled() & ~broken
    usable = np.flatnonzero(~broken & ~doubled)
    left_out |= {"unreadable": int(broken.sum()), "doubled": int(doubled.sum())}
    if parallax > 0:
        chosen = usable[even_steps(motion.flow[usable], parallax)]
        left_out["closer than the parallax"] = len(usable) - len(chosen)
        usable = chosen
    places: dict[int, int] = {}
    number, before = -1, None
    for place in usable.tolist():
        number += 1
        if before is not None and _apart(recording, broken, before, place):
            number += 1
        places[number] = before = place
    return places, left_out


def _apart(recording: Recording, broken: NDArray[np.bool_], before: int, after: int) -> bool:
    """Tell whether two places of a recording are no neighbors: a broken frame or a long time lies between."""
    if broken[before:after].any():
        return True
    frames = recording.numbers[after] - recording.numbers[before]
    return after - before > 1 and recording.fps is not None and frames / recording.fps > LONGEST_STEP
