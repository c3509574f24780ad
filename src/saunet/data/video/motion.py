"""How much a clip's picture moves from frame to frame, measured once and kept: stops, doubled frames, even steps."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from saunet.data.loading.static import FLOW_WIDTH, MIN_FLOW, median_flow
from saunet.data.video.clips import FramesCacheError
from saunet.errors import DataError
from saunet.io.atomic import write_json
from saunet.io.images import read_image, resize
from saunet.io.plain import read_json

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
        """Tell which frames are the same picture as the one before, one value a frame: the frame rate was raised."""
        return np.nan_to_num(self.change, nan=1.0) < SAME_PICTURE

    def static(self, min_flow: float = MIN_FLOW) -> NDArray[np.bool_]:
        """Tell which frames show no motion against the one before, one value a frame; the second judges the first."""
        flow = self.flow.copy()
        known = np.flatnonzero(np.isfinite(flow))
        if known.size and known[0] > 0:
            flow[: known[0]] = flow[known[0]]
        return np.nan_to_num(flow, nan=np.inf) < min_flow


def compare(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> tuple[float, float]:
    """Return the median flow between two images, h x w x 3, in pixels at 320 width, and their relative difference."""
    return median_flow(before, after), relative_change(before, after)


def relative_change(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> float:
    """Return the mean difference of two images, h x w x 3, over the second's standard deviation."""
    return float(np.abs(before.astype(np.float32) - after).mean() / max(1.0, float(after.std())))


def shrink(image: NDArray[np.uint8], crop: Sequence[float | int] = (0, 0, 0, 0)) -> NDArray[np.uint8]:
    """Return an image, h x w x 3, cut by shares of its top, bottom, left and right, and made 320 pixels wide."""
    height, width = image.shape[:2]
    top, bottom, left, right = crop
    cut = image[
        round(top * height) : height - round(bottom * height), round(left * width) : width - round(right * width)
    ]
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
                flow[place], change[place] = compare(before, after)
            before = after
        advance()
    found = Motion(flow, change, tuple(unreadable))
    if file:
        plain = {"flow": _plain(flow), "change": _plain(change), "unreadable": unreadable}
        write_json(file, plain, FramesCacheError, indent=None)
    return found


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


def _plain(values: NDArray[np.float64]) -> list[float | None]:
    return [None if np.isnan(value) else round(float(value), 4) for value in values]
