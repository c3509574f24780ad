"""One clip of any camera as a `Drive`: straight, cropped frames in steps of choice, by how much the picture moves."""

from __future__ import annotations

import functools
import hashlib
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from saunet.data.checks import common_size
from saunet.data.drive import GAP, Drive
from saunet.data.loading.selecting import FLOW_WIDTH, MIN_FLOW, median_flow
from saunet.data.video.camera import Lens
from saunet.data.video.clips import Clip, FramesCacheError, Recording
from saunet.errors import DataError
from saunet.io.atomic import write_json
from saunet.io.images import read_image, resize
from saunet.io.plain import read_json

LONGEST_STEP = 5.0
"""Seconds between two frames beyond which they are no neighbors: too much has moved meanwhile."""
SAME_PICTURE = 0.01
"""Mean difference over the picture's standard deviation under which two frames are the same picture twice."""


@dataclass(frozen=True)
class Motion:
    """What was measured of a sequence of frames; entry i compares frame i with the readable one before it."""

    flow: NDArray[np.float64]
    """Median optical flow in pixels of an image 320 pixels wide; NaN for the first frame and for unreadable ones."""
    change: NDArray[np.float64]
    """Mean difference over the standard deviation of the picture; NaN likewise."""
    unreadable: tuple[int, ...] = ()
    """Frames that cannot be decoded."""

    def doubled(self) -> NDArray[np.bool_]:
        """Say which frames are the same picture as the one before, one value a frame: the frame rate was raised."""
        return np.nan_to_num(self.change, nan=1.0) < SAME_PICTURE

    def static(self, min_flow: float = MIN_FLOW) -> NDArray[np.bool_]:
        """Say which frames show no motion against the one before, one value a frame; the second judges the first."""
        flow = self.flow.copy()
        known = np.flatnonzero(np.isfinite(flow))
        if known.size and known[0] > 0:
            flow[: known[0]] = flow[known[0]]
        return np.nan_to_num(flow, nan=np.inf) < min_flow


def relative_change(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> float:
    """Return the mean difference of two images, h x w x 3, over the second's standard deviation."""
    return float(np.abs(before.astype(np.float32) - after).mean() / max(1.0, float(after.std())))


def shrink(image: NDArray[np.uint8], crop: Sequence[float | int] = (0, 0, 0, 0)) -> NDArray[np.uint8]:
    """Return an image, h x w x 3, cut by shares of its top, bottom, left and right, and made 320 pixels wide."""
    height, width = image.shape[:2]
    top, bottom, left, right = crop
    rows = slice(round(top * height), height - round(bottom * height))
    cut = image[rows, round(left * width) : width - round(right * width)]
    return np.asarray(resize(cut, max(32, round(cut.shape[0] * FLOW_WIDTH / cut.shape[1])), FLOW_WIDTH))


def measure(
    paths: Sequence[Path],
    crop: Sequence[float | int],
    *,
    skip_unreadable: bool = False,
    cache: Path | None = None,
    advance: Callable[[], None] = lambda: None,
) -> Motion:
    """Measure the motion between consecutive images, each decoded once."""
    file = cache / f"motion-{_key(paths, crop)}.json" if cache else None
    known = _read(file, len(paths)) if file else None
    if known is not None and (skip_unreadable or not known.unreadable):
        return known
    flow, change = np.full(len(paths), np.nan), np.full(len(paths), np.nan)
    unreadable, before = [], None
    for place, path in enumerate(paths):
        try:
            after = shrink(read_image(path), crop)
        except DataError:
            if not skip_unreadable:
                raise
            unreadable.append(place)
        else:
            if before is not None and before.shape == after.shape:
                flow[place], change[place] = median_flow(before, after), relative_change(before, after)
            before = after
        advance()
    if file:
        rounded = {
            key: [None if np.isnan(value) else round(value, 4) for value in values.tolist()]
            for key, values in (("flow", flow), ("change", change))
        }
        write_json(file, {**rounded, "unreadable": unreadable}, FramesCacheError, indent=None)
    return Motion(flow, change, tuple(unreadable))


def even_steps(flow: NDArray[np.float64], parallax: float) -> NDArray[np.bool_]:
    """Choose frames so that the picture moves by about ``parallax`` from each to the next; the first is one."""
    chosen, gathered = np.zeros(len(flow), dtype=bool), 0.0
    for place, step in enumerate(np.nan_to_num(flow)):
        gathered += step
        if place == 0 or gathered >= parallax:
            chosen[place], gathered = True, 0.0
    return chosen


def _key(paths: Sequence[Path], crop: Sequence[float | int]) -> str:
    text = [str([round(float(share), 6) for share in crop])]
    for path in paths:
        try:
            state = path.stat()
            text.append(f"{path.absolute()}|{state.st_size}|{state.st_mtime_ns}")
        except OSError:
            text.append(f"{path.absolute()}|gone")
    return hashlib.sha256("\n".join(text).encode("utf-8", "surrogateescape")).hexdigest()[:16]


def _read(file: Path, count: int) -> Motion | None:
    """Return a kept measurement; None where there is none that fits, and then it is made anew."""
    try:
        plain = read_json(file)
        flow, change = (np.array(plain[key], dtype=np.float64) for key in ("flow", "change"))
        unreadable = tuple(int(place) for place in plain["unreadable"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return Motion(flow, change, unreadable) if len(flow) == len(change) == count else None


class ClipDrive(Drive):
    """A clip of any camera.

    Frames are numbered anew from 0 in the order of time, without those that are `left_out`; a number is skipped where
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
        self._places, self.left_out = _choose(recording, motion, parallax)
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
        return self._lens.height, self._lens.width

    @functools.cached_property
    def origin(self) -> str:
        camera, lens = self.clip.camera, self._lens
        files = [(index, self.recorded(index), self.path(index).name) for index in self._indices]
        text = repr((lens.K.tolist(), lens.recorded, self.frame_size, camera.model, camera.distortion, files))
        return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()[:16]

    def path(self, index: int) -> Path:
        return self.recording.paths[self._places[index]]

    def recorded(self, index: int) -> int:
        return self.recording.numbers[self._places[index]]

    def image(self, index: int) -> NDArray[np.uint8]:
        path = self.path(index)
        return self._lens(read_image(path), str(path))

    def intrinsics(self, index: int) -> NDArray[np.float64]:
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
    number, before = 0, None
    for place in usable.tolist():
        if before is not None:
            seconds = (recording.numbers[place] - recording.numbers[before]) / (recording.fps or math.inf)
            apart = broken[before:place].any() or (place - before > 1 and seconds > LONGEST_STEP)
            number += 2 if apart else 1
        places[number] = before = place
    return places, left_out
