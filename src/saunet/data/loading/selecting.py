"""Which frames of a split are used: held out, named in a manifest, static, or unreadable."""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from lightning.pytorch.utilities import rank_zero_warn
from numpy.typing import NDArray

from saunet.data.checks import check_frame
from saunet.data.drive import Drive
from saunet.data.loading.windows import Selection
from saunet.errors import ConfigError, DataError
from saunet.io.atomic import write_json
from saunet.io.plain import read_json

FORMAT = 1  # version of the layout of a manifest
UNREADABLE = "unreadable"
"""The reason in a manifest that also rules out a frame as a neighbor; all others only rule it out as a target."""
MIN_SPEED = 0.5  # meters per second below which a car counts as standing
FLOW_WIDTH = 320
"""Images are resized to this width before flow is measured, so that thresholds mean the same for every camera."""
MIN_FLOW = 0.5  # pixels of median flow, at 320 pixels width, below which a frame counts as static


class Frame(NamedTuple):
    """One frame of one camera."""

    drive: str  # ``<date>/<drive>``
    number: int
    side: str  # ``l`` or ``r``

    def __str__(self) -> str:
        return f"{self.drive} {self.number:010d} {self.side}"


FEW = 10
"""With fewer validation frames, scores are mostly chance."""
BETWEEN = "between training and validation"
"""Reason for leaving out frames that training and validation windows would share."""
Parts = tuple[list[Frame], list[Frame]]
"""Training and validation frames."""


def parse_ranges(text: str) -> list[int]:
    """Return the numbers of ``"0-6/3,9"``: 0, 3, 6, 9 (a-b/s is a, a+s, ..., up to and including b)."""
    numbers: list[int] = []
    for part in filter(None, text.strip().split(",")):
        first, dash, rest = part.partition("-")
        last, _, step = rest.partition("/")
        numbers += range(int(first), int(last) + 1, int(step or 1)) if dash else [int(first)]
    return numbers


def hold_out_drives(frames: Sequence[Frame], drives: Iterable[str]) -> Parts:
    """Move the frames of the named drives to validation; a name may be the end of ``<date>/<drive>``."""
    held, known = set(), sorted({frame.drive for frame in frames})
    for name in drives:
        fitting = [drive for drive in known if drive == name or drive.endswith(f"/{name}")]
        if not fitting:
            raise ConfigError(f"no drive '{name}' to hold out; drives: {', '.join(known[:40])}")
        held.update(fitting)
    return [f for f in frames if f.drive not in held], [f for f in frames if f.drive in held]


def hold_out_random(frames: Iterable[Frame], share: float, seed: int) -> Parts:
    """Move a seeded random fraction of the frames, each camera separately, to validation."""
    ordered = sorted(frames)
    drawn = np.random.default_rng(seed).permutation(len(ordered))[: math.ceil(share * len(ordered))]
    chosen = {ordered[place] for place in drawn}
    return [frame for frame in ordered if frame not in chosen], [frame for frame in ordered if frame in chosen]


def hold_out_tails(frames: Sequence[Frame], share: float, gap: int) -> Parts:
    """Move the last fraction of each drive to validation, and leave out ``gap`` frames before it.

    If the gap spans the farthest neighbors of both sides, no validation window shares a frame with a training window.
    """
    numbers: dict[str, set[int]] = {}
    for frame in frames:
        numbers.setdefault(frame.drive, set()).add(frame.number)
    first_held = {}
    for drive, each in numbers.items():
        held = math.ceil(share * len(each))
        first_held[drive] = sorted(each)[-held] if held else max(each) + gap + 1
    train = [frame for frame in frames if frame.number < first_held[frame.drive] - gap]
    return train, [frame for frame in frames if frame.number >= first_held[frame.drive]]


def hold_out(frames: Sequence[Frame], share: float, gap: int, seed: int) -> Parts:
    """Hold out whole drives, drawn by seed, if there are ten or more; otherwise the ends of all drives.

    Drives are added until they make up the fraction ``share``; a drive that would exceed twice that is skipped. ``gap``
    frames are left out between a training part and a held-out end.
    """
    counts = Counter(frame.drive for frame in frames)
    if len(counts) < 10:
        return hold_out_tails(frames, share, gap)
    held: list[str] = []
    wanted, total = share * len(frames), 0
    names = sorted(counts)
    for place in np.random.default_rng(seed).permutation(len(names)):
        if total < wanted and total + counts[names[place]] <= 2 * wanted:
            held.append(names[place])
            total += counts[names[place]]
    return hold_out_drives(frames, held)


class Division(NamedTuple):
    """The frames of recordings, divided into splits."""

    train: list[Frame]
    val: list[Frame]
    test: list[Frame]  # those of ``val`` if no recordings are named for it
    unused: Mapping[str, int]  # recording -> frames between its training and its validation part
    settings: tuple[str, str]  # the settings that name recordings for validation and test

    def of(self, split: str) -> dict[str, list[int]]:
        """Return recording -> frame numbers of ``train``, ``val``, ``test`` or ``predict``.

        Training includes recordings too short for a training part, without frames, so that they are counted.
        """
        numbers: dict[str, list[int]] = {}
        for frame in {"train": self.train, "val": self.val}.get(split, self.test):
            numbers.setdefault(frame.drive, []).append(frame.number)
        for name in self.unused if split == "train" else ():
            numbers.setdefault(name, [])
        return numbers

    def overlap(self) -> str | None:
        """Return a sentence about what splits share, and how to separate them; None if they share nothing."""
        val, test = (f"data.{setting}" for setting in self.settings)
        held = {frame.drive for frame in self.val}
        shared = sorted({frame.drive for frame in self.train} & held)
        told, fix = list[str](), list[str]()
        if shared:
            names = ", ".join(map(repr, shared[:5])) + (", ..." if len(shared) > 5 else "")
            told.append(f"training and validation share {names} (validation has the end of each)")
            fix.append(f"{val}=[NAME]")
        if self.val and {*self.val} == {*self.test}:
            told.append("validation, which chooses best.ckpt, and test are the same frames")
            fix.append(f"{test}=[{'ANOTHER' if fix else 'NAME'}]")
        if not told:
            return None
        whole = f"hold out whole recordings with {' and '.join(fix)}"
        few = "; to score more of these, raise data.val_share" if shared and len(self.val) < FEW else ""
        return f"{'; '.join(told)}: for scores that also hold on other roads, {whole}{few}"


def divide(
    frames: Mapping[str, Sequence[int]], held: Mapping[str, Sequence[str]], share: float, gap: int, seed: int
) -> Division:
    """Divide recordings: into those named for validation and test, or by holding out a fraction; see `hold_out`.

    Args:
        frames: Recording -> frame numbers.
        held: Name of the setting for validation, then of that for test -> names or patterns of recordings.
        share: Fraction to hold out if none are named for validation.
        gap: Frames left out before a held-out end.
        seed: Seed of the random choice.
    """
    (val_setting, val_names), (test_setting, test_names) = held.items()
    test = matching(test_names, list(frames), test_setting)
    for pattern in val_names:
        if set(both := matching([pattern], list(frames), val_setting)) <= set(test):
            raise ConfigError(
                f"{val_setting} and {test_setting} both name {', '.join(both)}; name each in only one of them, or "
                f"leave {test_setting} out to test on the validation frames"
            )
    named = [name for name in matching(val_names, list(frames), val_setting) if name not in test]

    def listed(names: Iterable[str]) -> list[Frame]:
        return [Frame(name, number, "l") for name in names for number in frames[name]]

    rest = listed(name for name in frames if name not in test and name not in named)
    train, val = (rest, listed(named)) if named else hold_out(rest, share, gap, seed)
    used = {*train, *val}
    unused = {} if named else Counter(frame.drive for frame in rest if frame not in used)
    return Division(train, val, listed(test) if test else val, unused, (val_setting, test_setting))


def matching(patterns: Sequence[str], names: Sequence[str], setting: str) -> list[str]:
    """Return the names that match any of the patterns, such as ``night_*``; a pattern without a match is an error."""
    found: list[str] = []
    for pattern in patterns:
        fitting = [name for name in names if name == pattern or fnmatchcase(name, pattern)]
        if not fitting:
            what = setting.rpartition("_")[2]
            raise ConfigError(
                f"{setting} names '{pattern}', which matches no {what[:-1]}; {what}: {', '.join(names[:20]) or 'none'}"
            )
        found += (name for name in fitting if name not in found)
    return found


@dataclass(frozen=True)
class Manifest:
    """Frames to leave out of training and validation, written by ``saunet doctor`` and read by ``data.manifest=``."""

    leave_out: Mapping[str, Mapping[str, Sequence[int]]]  # drive -> reason -> frame numbers
    numbering: Mapping[str, str] = field(default_factory=dict)
    facts: Mapping[str, Any] = field(default_factory=dict)
    path: Path = Path("manifest.json")
    test_only: Set[str] = frozenset()

    def check(self, names: Set[str]) -> None:
        """Check that the manifest belongs to these drives; warn if some of its drives are not among them."""
        mine = self.leave_out.keys() - self.test_only
        strange = sorted(mine - names)
        if not strange:
            return
        listed = f"such as '{strange[0]}'" + (f"; here they are called '{min(names)}'" if names else "")
        if len(strange) == len(mine):
            raise DataError(
                f"{self.path} names {len(mine)} recordings, none of them in the training data ({listed}...); make it "
                "with saunet doctor and the data settings of this run, or set data.manifest=null"
            )
        rank_zero_warn(
            f"{self.path} names {len(mine)} recordings, and {len(strange)} of them are not in the training data "
            f"({listed}...); if they should be, run saunet doctor again with the data settings of this run"
        )

    def apply(self, selection: Selection, offsets: Sequence[int]) -> Selection:
        """Return a selection without the frames to leave out, which are counted by reason."""
        name, numbering = selection.drive.name, selection.drive.numbering
        if self.numbering.get(name, numbering) != numbering:
            raise DataError(
                f"{self.path} was made for '{name}' with {self.numbering[name] or 'other settings'} and is now read "
                f"with {numbering or 'other settings'}, which numbers its frames differently; run saunet doctor "
                "again with the settings of this run, or set data.manifest=null"
            )
        kept, left_out = list(selection.frames), dict(selection.left_out)
        for reason, numbers in self.leave_out.get(name, {}).items():
            unwanted = set(numbers)
            if reason == UNREADABLE:
                unwanted |= {number - offset for number in numbers for offset in offsets}
            before = len(kept)
            kept = [frame for frame in kept if frame not in unwanted]
            left_out[f"{reason} (manifest)"] = before - len(kept)
        return Selection(selection.drive, kept, left_out)


def write_manifest(path: str | Path, manifest: Manifest) -> None:
    leave_out = {
        drive: {reason: sorted(numbers) for reason, numbers in reasons.items()}
        for drive, reasons in manifest.leave_out.items()
    }
    more = {"numbering": dict(manifest.numbering), "test_only": sorted(manifest.test_only), "leave_out": leave_out}
    write_json(path, {"format": FORMAT, **manifest.facts, **more}, indent=1)


def read_manifest(path: str | Path) -> Manifest:
    """Read the list of usable frames that `saunet doctor` wrote."""
    path = Path(path).expanduser()
    try:
        plain = read_json(path)
    except FileNotFoundError as reason:
        raise DataError(f"no manifest at {path}; make one with saunet doctor, or set data.manifest=null") from reason
    except (OSError, ValueError) as reason:
        raise DataError(f"{reason}; make it again with saunet doctor") from reason
    if not isinstance(plain, dict) or plain.get("format") != FORMAT:
        found = plain.get("format") if isinstance(plain, dict) else type(plain).__name__
        raise DataError(f"{path} is not a manifest of format {FORMAT} (found {found}); make it with saunet doctor")
    leave_out, numbered = plain.get("leave_out"), plain.get("numbering", {})
    if not isinstance(leave_out, dict) or not isinstance(numbered, dict) or not all(map(_is_entry, leave_out.values())):
        raise DataError(
            f"{path}: 'leave_out' must map each drive to reasons, and each reason to frame numbers, such as "
            '{"clip l": {"static": [4, 5]}}'
        )
    test_only = frozenset(map(str, plain.get("test_only") or ()))
    return Manifest(leave_out, {str(key): str(value) for key, value in numbered.items()}, {}, path, test_only)


def _is_entry(reasons: Any) -> bool:
    return isinstance(reasons, dict) and all(
        isinstance(numbers, list) and all(isinstance(number, int) for number in numbers) for numbers in reasons.values()
    )


def median_flow(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> float:
    """Return the median length of `optical_flow`."""
    x, y = cv2.split(optical_flow(first, second))
    squares = (x * x + y * y).ravel()
    low, high = (squares.size - 1) // 2, squares.size // 2
    middle = np.sqrt(np.partition(squares, [low, high])[[low, high]])
    return float((middle[0] + middle[1]) / 2)


def optical_flow(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the optical flow between two images, h x w x 2, in pixels of an image 320 pixels wide.

    Gray images are used as they are: those from `gray`, so that none is converted twice, or of another width.
    """
    before, after = gray(first), gray(second)
    flow = np.zeros((*before.shape, 2), np.float32)
    measure = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    return np.asarray(measure.calc(before, after, flow), dtype=np.float32)


def gray(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return an RGB image in gray, 320 pixels wide; a gray image unchanged."""
    if image.ndim == 2:
        return image
    height = max(32, round(image.shape[0] * FLOW_WIDTH / image.shape[1]))
    small = cv2.resize(image, (FLOW_WIDTH, height), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def static_by_flow(drive: Drive, frames: Sequence[int], min_flow: float, *, skip_unreadable: bool = False) -> set[int]:
    """Return the frames that look like the previous frame (the first: like the next), decoding each image once."""
    existing, wanted = set(drive.indices), set(frames)
    static: set[int] = set()
    last: tuple[int, NDArray[np.uint8]] | None = None
    for frame in sorted(existing & {each + step for each in wanted for step in (-1, 0, 1)}):
        try:
            image = drive.image(frame)
            check_frame(drive, frame, image)
        except DataError:
            if not skip_unreadable:
                raise
            existing.discard(frame)  # the next frame is then judged like a first one
            continue
        small = gray(image)
        if last is not None and last[0] == frame - 1 and median_flow(last[1], small) < min_flow:
            static.add(frame)
            if frame - 2 not in existing:
                static.add(frame - 1)
        last = (frame, small)
    return static & wanted


def moving(selection: Selection, *, by_speed: bool, skip_unreadable: bool = False) -> Selection:
    """Return a selection without the frames in which the car stands still, counted as ``static``.

    Nothing can be learned from them, because nothing moves between neighbors.
    """
    drive, existing = selection.drive, set(selection.drive.indices)
    frames = [frame for frame in selection.frames if frame in existing]
    speeds = {frame: _speed(drive, frame, skip_unreadable) if by_speed else None for frame in frames}
    static = {frame for frame, speed in speeds.items() if speed is not None and speed < MIN_SPEED}
    unknown = [frame for frame, speed in speeds.items() if speed is None]
    static |= static_by_flow(drive, unknown, MIN_FLOW, skip_unreadable=skip_unreadable)
    kept = [frame for frame in selection.frames if frame not in static]
    return Selection(drive, kept, {**selection.left_out, "static": len(static)})


def has_speed(selection: Selection, skip_unreadable: bool = False) -> bool:
    """Return whether the speed is known for any of the frames."""
    return any(_speed(selection.drive, frame, skip_unreadable) is not None for frame in selection.frames)


def _speed(drive: Drive, frame: int, skip_unreadable: bool) -> float | None:
    """Return the speed in m/s; None if unknown, and with ``skip_unreadable`` also for a broken record."""
    try:
        return drive.speed(frame)
    except DataError as error:
        if not skip_unreadable:
            raise
        warnings.warn(f"speed unknown: {error}", stacklevel=2)
        return None


def with_truth(selection: Selection) -> Selection:
    """Return a selection without the frames that have no ground truth; missing frames stay, to be counted."""
    existing = set(selection.drive.indices)
    have = [f for f in selection.frames if f not in existing or selection.drive.has_depth(f)]
    lost = len(selection.frames) - len(have)
    return Selection(selection.drive, have, {**selection.left_out, "without ground truth": lost})


def with_poses(selection: Selection, offsets: Sequence[int]) -> Selection:
    """Return a selection without the frames whose pose, or that of a neighbor that exists, is unknown."""
    drive, frames, left_out = selection
    unknown = {index for index in drive.indices if drive.pose(index) is None}
    known = [frame for frame in frames if not unknown & {frame + offset for offset in (0, *offsets)}]
    return Selection(drive, known, {**left_out, "without pose": len(frames) - len(known)})


def readable(selection: Selection, offsets: Sequence[int], with_depth: bool) -> Selection:
    """Return a selection without frames that, or whose neighbors, cannot be read; each is decoded once."""
    drive, window = selection.drive, (0, *offsets)
    broken = set()
    for frame in sorted({each + offset for each in selection.frames for offset in window}.intersection(drive.indices)):
        try:
            check_frame(drive, frame, drive.image(frame))
            drive.intrinsics(frame)
            if with_depth and frame in selection.frames:
                drive.depth(frame)
        except DataError as error:
            broken.add(frame)
            warnings.warn(f"frame left out: {error}", stacklevel=2)
    kept = [frame for frame in selection.frames if not any(frame + offset in broken for offset in window)]
    lost = len(selection.frames) - len(kept)
    return Selection(drive, kept, {**selection.left_out, "unreadable": lost})
