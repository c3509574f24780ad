"""A clip of any camera as a recording: its frames in order, with times, speeds and the lens."""

from __future__ import annotations

import copy
import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from saunet.data.checks import common_size
from saunet.data.drive import GAP, Drive, LensModel
from saunet.data.video.calibrations import FILE_NAME
from saunet.data.video.camera import CameraFile, Lens
from saunet.data.video.clips import Clip, Recording, short_hash
from saunet.data.video.motion import Motion, cuts, even_steps
from saunet.errors import DataError
from saunet.io.alignment import align_speeds
from saunet.io.images import read_image
from saunet.io.speeds import SpeedTable, read_speeds

SPEEDS = "speeds.csv"
"""File of a clip's speeds: in its folder, or beside a video as ``NAME.speeds.csv``."""
LONGEST_STEP = 5.0
"""Two frames farther apart than this, in seconds, are not neighbors: too much has moved meanwhile."""


class ClipDrive(Drive):
    """A clip of any camera.

    Frames are numbered from 0 in the order of time, without those `left_out`; a number is skipped if the frames on both
    sides are not neighbors (a broken image, a long stop or a cut between them).
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
        self._places, self.left_out = _choose(recording, motion, parallax)
        self._indices = sorted(self._places)
        self._still = frozenset(np.flatnonzero(motion.static()).tolist()) if motion else frozenset()
        self._doubled = tuple(np.flatnonzero(motion.doubled()).tolist()) if motion else ()

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
    def camera_height(self) -> float | None:
        known = self.clip.camera.camera_height
        return self._camera_height if known is None else known

    @property
    def condition(self) -> str | None:
        return self.clip.camera.condition

    @property
    def fps(self) -> float | None:
        return self.recording.fps

    def time(self, index: int) -> float | None:
        return self.recording.time(self._places[index])

    @property
    def duplicates(self) -> Sequence[float]:
        return [time for time in map(self.recording.time, self._doubled) if time is not None]

    @functools.cached_property
    def gaps(self) -> frozenset[int]:
        """Indices of frames after which the recording lacks frames; the steps between chosen frames do not tell."""
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

    @functools.cached_property
    def _speeds(self) -> SpeedTable | None:
        file = speeds_file(self.clip.path)
        return read_speeds(file) if file.is_file() else None

    def align_speeds(self, flow: NDArray[np.float64]) -> str:
        """Align the clip's speeds with the clock of its frames, given each frame's flow, and return the alignment."""
        if self._speeds is None:
            raise DataError(f"'{self.name}' has no {SPEEDS} to align; leave out data.align_speeds")
        times = np.array([self.recording.time(place) for place in range(len(flow))], dtype=np.float64)
        if np.isnan(times).any():
            raise DataError(f"the frames of '{self.name}' have no times; give fps in its {FILE_NAME}")
        steps = np.maximum(np.diff(times), 1e-6)
        moved, found = align_speeds(self._speeds, "", times[1:] - steps / 2, flow[1:] / steps)
        vars(self)["_speeds"] = moved
        return f"{moved.path}: {found}"

    def check_speeds(self) -> None:
        """Check that the clip's speeds, if it has any, are of its frames."""
        if not self._indices or self._speeds is None:
            return
        self._speeds.check_drives([])
        if self.time(self._indices[0]) is None:
            raise DataError(f"'{self.name}' has a {SPEEDS}, but its frames have no times; give fps in its {FILE_NAME}")
        first, last = self._tick(self._indices[0]), self._tick(self._indices[-1])
        low, *_, high = self._speeds.drives[""][0].tolist()
        if first <= high and last >= low:
            return
        if self._speeds.unit == "frame":
            raise DataError(
                f"the speeds of '{self.name}' are of the frames {low:.0f} to {high:.0f}, but it has the frames "
                f"{first:.0f} to {last:.0f}; number them from 0, in the order of the original frames"
            )
        raise DataError(
            f"the speeds of '{self.name}' are from {low:.2f} to {high:.2f} s, and its frames from {first:.2f} to "
            f"{last:.2f} s; set data.align_speeds=true to find the offset of their clock"
        )

    def _tick(self, index: int) -> float:
        """Return a frame's time in the table of speeds; NaN if unknown."""
        at = self.recorded(index) if self._speeds and self._speeds.unit == "frame" else self.time(index)
        return math.nan if at is None else float(at)

    def speed(self, index: int) -> float | None:
        tick = self._tick(index)
        value = self._speeds.mean(tick, tick) if self._speeds else math.nan
        return None if math.isnan(value) else value

    def distance(self, first: int, second: int) -> float | None:
        times = self.time(first), self.time(second)
        if self._speeds is None or times[0] is None or times[1] is None:
            return None
        low, high = sorted((self._tick(first), self._tick(second)))
        mean = self._speeds.mean(low, high)
        return None if math.isnan(mean) else mean * abs(times[1] - times[0])

    def static(self) -> frozenset[int]:
        """Return the numbers of the frames in which the picture does not move."""
        return frozenset(index for index, place in self._places.items() if place in self._still)

    @property
    def frame_size(self) -> tuple[int, int]:
        return self._lens.height, self._lens.width

    @property
    def recorded_size(self) -> tuple[int, int]:
        """(height, width) of the frames before they are cropped."""
        return self._lens.recorded

    @property
    def camera_file(self) -> Path | None:
        file = self.clip.camera.path
        return file if file.is_file() else None  # none describes an unknown camera

    @property
    def camera_id(self) -> str:
        camera = self.clip.camera
        known = (camera.K.tolist(), camera.image_size, camera.model, camera.distortion)
        return repr((*known, self.camera_height))

    def seen_by(self, camera: CameraFile) -> ClipDrive:
        """Return the same drive with another camera."""
        twin = copy.copy(self)
        twin.clip = replace(self.clip, camera=camera)
        for name in ("_lens", "origin"):
            twin.__dict__.pop(name, None)
        return twin

    @functools.cached_property
    def origin(self) -> str:
        camera, lens = self.clip.camera, self._lens
        files = [(index, self.recorded(index), self.path(index).name) for index in self._indices]
        text = repr((lens.K.tolist(), lens.recorded, self.frame_size, camera.model, camera.distortion, files))
        return short_hash(text)

    def path(self, index: int) -> Path:
        return self.recording.paths[self._places[index]]

    def recorded(self, index: int) -> int:
        return self.recording.numbers[self._places[index]]

    def image(self, index: int) -> NDArray[np.uint8]:
        path = self.path(index)
        return self._lens(read_image(path), str(path))

    @property
    def lens(self) -> LensModel | None:
        return self._lens.model

    def recorded_image(self, index: int) -> NDArray[np.uint8]:
        path = self.path(index)
        return self._lens(read_image(path), str(path), undistort=False)

    def intrinsics(self, index: int) -> NDArray[np.float64]:
        return self._lens.K.copy()

    @functools.cached_property
    def _lens(self) -> Lens:
        example, size = common_size([self.path(index) for index in self._indices])
        return Lens(self.clip.camera, *size, self._crop, f"the frames of '{self.name}' ({example.name})")


def speeds_file(clip: Path) -> Path:
    """Return where the speeds of a folder of frames or of a video are."""
    return clip / SPEEDS if clip.is_dir() else clip.with_suffix(f".{SPEEDS}")


def _choose(recording: Recording, motion: Motion | None, parallax: float) -> tuple[dict[int, int], dict[str, int]]:
    """Return frame number -> position in the recording, and how many positions got none, by reason."""
    count = len(recording.paths)
    left_out = {"not decodable": recording.missing, "passed over by fps": recording.passed_over}
    if motion is None:
        return {place: place for place in range(count)}, left_out
    broken = np.isin(np.arange(count), motion.unreadable)
    doubled = motion.doubled() & ~broken
    usable = np.flatnonzero(~broken & ~doubled)
    cut = np.zeros(count, dtype=bool)
    cut[usable] = cuts(motion.change[usable])
    left_out |= {"unreadable": int(broken.sum()), "doubled": int(doubled.sum()), "split at cuts": int(cut.sum())}
    if parallax > 0:
        chosen = usable[even_steps(motion.flow[usable], parallax)]
        left_out["closer than the parallax"] = len(usable) - len(chosen)
        usable = chosen
    places: dict[int, int] = {}
    number, before = 0, None
    losses = np.cumsum(broken | cut).tolist()  # from one usable frame to the next it grows where time or scene is lost
    for place in usable.tolist():
        if before is not None:
            seconds = (recording.time(place) or 0.0) - (recording.time(before) or 0.0)
            apart = losses[place] > losses[before] or (place - before > 1 and seconds > LONGEST_STEP)
            number += 2 if apart else 1
        places[number] = before = place
    return places, left_out
