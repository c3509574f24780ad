"""Motion of the picture between the frames of a clip: which are doubled, static, or begin another scene.

Most frames of a clip are far from every limit, and a fourth or half of a JPEG's resolution is enough to see that. The
others are measured at the full resolution, so the choice of frames does not depend on the shortcut.
"""

from __future__ import annotations

import functools
import io
import itertools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from saunet.data.loading.selecting import FLOW_WIDTH, MIN_FLOW, gray, median_flow
from saunet.data.video.clips import FramePaths, FramesCacheError, short_hash
from saunet.errors import DataError, UnreadableError
from saunet.io.atomic import remove_partial_files, write_bytes
from saunet.io.images import decode_image, quick_look, read_image, read_jpeg, resize
from saunet.io.plain import read_array
from saunet.threads import available_cores

SAME_PICTURE = 0.01
"""Mean difference over the picture's standard deviation below which two frames show the same picture."""
CUT = 0.75
"""The same measure from which two frames may be of different scenes (1.13 if nothing matches): KITTI's neighbors differ
by up to 0.5, frames of different recordings by 0.88 to 1.0."""
PEAK = 1.3  # times the changes around it that a cut exceeds: fast motion lasts, a cut does not
QUICK = {160: (4 * SAME_PICTURE, 0.6 * CUT, 4 * MIN_FLOW), FLOW_WIDTH: (2 * SAME_PICTURE, 0.75 * CUT, 2 * MIN_FLOW)}
"""Width of a gray picture of a JPEG's reduced decoding -> least and largest change, and least flow, for which it is
trusted: small pictures show less noise and less detail, and parts that move by themselves mislead them."""
_SAME, _STATIC = SAME_PICTURE / 4, MIN_FLOW / 4
"""Change and flow up to which such pictures are trusted, the change that of the wider ones."""
_BLOCK = 64  # frames that a thread measures at a time


@dataclass(frozen=True)
class Motion:
    """What was measured of a sequence of frames; entry i compares frame i with the readable one before it."""

    flow: NDArray[np.float64]
    """Median optical flow in pixels of an image 320 pixels wide; NaN for the first frame and for unreadable ones."""
    change: NDArray[np.float64]  # mean difference over the standard deviation of the picture; NaN likewise
    unreadable: tuple[int, ...] = ()  # frames that cannot be decoded

    def doubled(self) -> NDArray[np.bool_]:
        """Return which frames repeat the previous picture, one value per frame: the frame rate was raised."""
        return np.nan_to_num(self.change, nan=1.0) < SAME_PICTURE

    def static(self, min_flow: float = MIN_FLOW) -> NDArray[np.bool_]:
        """Return which frames show no motion since the previous, one value per frame; the second judges the first."""
        flow = self.flow.copy()
        known = np.flatnonzero(np.isfinite(flow))
        if known.size and known[0] > 0:
            flow[: known[0]] = flow[known[0]]
        return np.nan_to_num(flow, nan=np.inf) < min_flow


def cuts(change: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which frames begin another scene (a cut, a loop, the next recording), given each frame's change."""
    known = np.nan_to_num(change)
    around = np.lib.stride_tricks.sliding_window_view(np.pad(known, 2), 5)[:, [0, 1, 3, 4]]
    # The second largest: next to a cut there may be another one, as around a single black frame.
    return np.asarray((known >= CUT) & (known > PEAK * np.sort(around)[:, -2]))


def relative_change(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> float:
    """Return the mean difference of two images, h x w (x 3), over the second's standard deviation."""
    _, deviation = cv2.meanStdDev(after.reshape(len(after), -1))
    return cv2.norm(before, after, cv2.NORM_L1) / after.size / max(1.0, float(deviation[0, 0]))


def shrink(
    image: NDArray[np.uint8], crop: Sequence[float | int] = (0, 0, 0, 0), to: int = FLOW_WIDTH
) -> NDArray[np.uint8]:
    """Return an image, h x w (x 3), cut by shares of its top, bottom, left and right, and made 320 pixels wide."""
    height, width = image.shape[:2]
    top, bottom, left, right = crop
    rows = slice(round(top * height), height - round(bottom * height))
    cut = image[rows, round(left * width) : width - round(right * width)]
    return np.asarray(resize(cut, max(32, round(cut.shape[0] * to / cut.shape[1])), to))


class _Picture:
    """A frame, decoded only as far as needed."""

    def __init__(self, path: Path, crop: Sequence[float | int], exact: bool) -> None:
        self._path, self._crop = path, crop
        self._jpeg, self.size = (b"", b"") if exact else read_jpeg(path)
        self._stored = int.from_bytes(self.size[2:])
        if self._stored < 2 * FLOW_WIDTH or self.small is None:
            self._jpeg = b""
            _ = self.full  # what cannot be decoded is known at once

    @functools.cached_property
    def small(self) -> NDArray[np.uint8] | None:
        """A gray picture of the narrower width in `QUICK`; None if it has to be decoded in full."""
        return self._look(min(QUICK))

    @functools.cached_property
    def medium(self) -> NDArray[np.uint8] | None:
        """Likewise, of the wider one."""
        return self._look(max(QUICK))

    def _look(self, width: int) -> NDArray[np.uint8] | None:
        quick = quick_look(self._jpeg, self._stored, width) if self._jpeg else None
        return None if quick is None else shrink(quick, self._crop, width)

    @functools.cached_property
    def full(self) -> NDArray[np.uint8]:
        image = decode_image(self._jpeg, str(self._path)) if self._jpeg else read_image(self._path)
        return shrink(image, self._crop)

    @functools.cached_property
    def gray(self) -> NDArray[np.uint8]:
        return gray(self.full)


def _compare(before: _Picture, after: _Picture) -> tuple[float, float]:
    """Return flow and change, NaN for pictures of different sizes."""
    if before.size == after.size:
        found = _compare_quickly(before, after)
        if found is not None:
            return found
    if before.full.shape != after.full.shape:
        return np.nan, np.nan
    return median_flow(before.gray, after.gray), relative_change(before.full, after.full)


def _compare_quickly(before: _Picture, after: _Picture) -> tuple[float, float] | None:
    """Return flow and change from reduced decodings; None if these might decide differently from full ones."""
    if before.small is None or after.small is None:
        return None
    small, wide = QUICK
    low, high, moving = QUICK[small]
    change = relative_change(before.small, after.small)
    flow = median_flow(before.small, after.small) * FLOW_WIDTH / small
    if low <= change <= high and flow >= moving:
        return flow, change
    if before.medium is None or after.medium is None:
        return None
    low, high, moving_wide = QUICK[wide]
    change = relative_change(before.medium, after.medium)
    if not (change <= _SAME or low <= change <= high):
        return None
    if _STATIC < flow < moving:
        flow = median_flow(before.medium, after.medium)
        if _STATIC < flow < moving_wide:
            return None
    return flow, change


def _measure_block(
    paths: FramePaths, first: int, last: int, crop: Sequence[float | int], exact: bool, skip_unreadable: bool
) -> NDArray[np.float64]:
    """Return flow, change and whether it can be read of each frame of a block, 3 x n."""

    def look(place: int) -> _Picture | None:
        try:
            return _Picture(paths[place], crop, exact)
        except DataError:
            if not skip_unreadable:
                raise
            return None

    found = np.full((3, last - first), np.nan)
    before = next(filter(None, map(look, range(first - 1, -1, -1))), None)
    for place in range(first, last):
        after = look(place)
        found[2, place - first] = after is not None
        if after is not None:
            if before is not None:
                found[:2, place - first] = _compare(before, after)
            before = after
    return found


def _settle_cuts(paths: FramePaths, crop: Sequence[float | int], found: NDArray[np.float64]) -> None:
    """Measure exactly around a possible cut, which is judged by the changes beside it."""
    readable = np.flatnonzero(found[2])
    near = np.convolve(found[1, readable] >= CUT, np.ones(5), "full")[2:-2] > 0
    pictures: dict[int, _Picture] = {}
    for pair in itertools.compress(itertools.pairwise(readable.tolist()), near[1:]):
        pictures = {place: pictures.get(place) or _Picture(paths[place], crop, exact=True) for place in pair}
        found[:2, pair[1]] = _compare(*pictures.values())


def measure(
    paths: FramePaths,
    crop: Sequence[float | int],
    *,
    exact: bool = True,
    skip_unreadable: bool = False,
    cache: Path | None = None,
    advance: Callable[[int], None] = lambda count: None,
) -> Motion:
    """Measure the motion between consecutive images, with as many threads as there are cores.

    Unless ``exact``, numbers far from `SAME_PICTURE`, `MIN_FLOW` and `CUT` may come from smaller pictures: the
    decisions are the same, but the numbers do not measure distance.
    """
    key = motion_key(paths, crop) if cache else ""
    names = [cache / f"motion-{key}{kind}.npy" for kind in ("", "-quick")] if cache else []
    for file in names[: 1 if exact else 2]:
        known = _read_motion(file, len(paths))
        if known is not None and (skip_unreadable or not known.unreadable):
            return known
    starts = range(0, len(paths), _BLOCK)
    parts: list[NDArray[np.float64]] = []
    with ThreadPoolExecutor(available_cores()) as pool:

        def block(first: int) -> NDArray[np.float64]:
            return _measure_block(paths, first, min(first + _BLOCK, len(paths)), crop, exact, skip_unreadable)

        try:
            for part in pool.map(block, starts):
                parts.append(part)
                advance(part.shape[1])
        finally:
            pool.shutdown(cancel_futures=True)
    found = np.concatenate([np.empty((3, 0)), *parts], axis=1)
    if not exact:
        _settle_cuts(paths, crop, found)
    if cache:
        remove_partial_files(cache, ".*.partial*")
        stream = io.BytesIO()
        np.save(stream, found)
        write_bytes(names[0 if exact else 1], stream.getvalue(), FramesCacheError)
    return _motion(found)


def _motion(found: NDArray[np.float64]) -> Motion:
    return Motion(found[0], found[1], tuple(np.flatnonzero(found[2] == 0).tolist()))


def even_steps(flow: NDArray[np.float64], parallax: float) -> NDArray[np.bool_]:
    """Choose frames, starting with the first, so that the picture moves by about ``parallax`` between them."""
    chosen, gathered = np.zeros(len(flow), dtype=bool), 0.0
    for place, step in enumerate(np.nan_to_num(flow)):
        gathered += step
        if place == 0 or gathered >= parallax:
            chosen[place], gathered = True, 0.0
    return chosen


def motion_key(paths: FramePaths, crop: Sequence[float | int]) -> str:
    text = [str([round(float(share), 6) for share in crop])]
    for path in paths.texts():
        try:
            state = os.stat(path)
            text.append(f"{path}|{state.st_size}|{state.st_mtime_ns}")
        except OSError:
            text.append(f"{path}|gone")
    return short_hash("\n".join(text))


def _read_motion(file: Path, count: int) -> Motion | None:
    """Return a kept measurement; None if none fits, so that it is made again."""
    try:
        found = read_array(file)
    except (OSError, UnreadableError):
        return None
    return _motion(found) if found.shape == (3, count) and found.dtype == np.float64 else None
