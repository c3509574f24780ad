"""Measurements of a data set: frames, motion, light, cameras, ground truth, and reading speed."""

from __future__ import annotations

import itertools
import math
import os
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from saunet.data.drive import Drive, LensModel, camera_files
from saunet.data.loading.module import DepthDataModule
from saunet.data.loading.sampling import evenly
from saunet.data.loading.selecting import optical_flow
from saunet.data.loading.windows import WindowDataset, find_windows, measured_distance
from saunet.data.video.focal import WINDOW, FocalEstimate, drive_windows
from saunet.data.video.focal_check import check_focal
from saunet.data.video.motion import SAME_PICTURE, relative_change, shrink
from saunet.errors import CameraError, DataError, SaunetError

SPLITS = ("train", "val", "test")
ABSENT = "in absent recordings"
"""Reason for counting the frames of recordings without any frame, separate from gaps in others."""
BANDS = 32
"""Number of horizontal bands of the image with separate motion."""
_TRUTHS = 16
"""Number of ground-truth maps to examine."""
_PICTURES = 8
_STEPS = 1000
"""Number of steps between frames whose distance traveled is examined, over all recordings."""
_FOCALS = 3
"""Number of cameras whose focal length is estimated."""
FOCAL_SECONDS = 20.0
"""Processor time for all of these, in seconds; at least three windows of each are examined anyway."""


@dataclass(frozen=True)
class FrameFacts:
    """One frame that was read."""

    drive: str
    index: int
    size: tuple[int, int] = (0, 0)
    """(height, width)."""
    seconds: float = 0.0
    """Seconds to read and decode it."""
    file_bytes: int | None = None
    brightness: float = 0.0
    """Mean brightness, 0 to 1."""
    contrast: float = 0.0
    """Contrast (standard deviation), 0 to 1."""
    flow: float | None = None
    """Median motion against a neighbor, pixels at 320 width; None without a neighbor."""
    change: float | None = None
    """Mean difference from the neighbor, relative to the picture's standard deviation."""
    bands: NDArray[np.float64] | None = None
    """Mean motion of each horizontal band, from top to bottom."""
    problem: str | None = None
    """Why it cannot be read; None if it can."""
    of_camera: bool = False
    """Whether the camera is the cause, which is reported once for all frames."""
    damage: str | None = None
    """Damage that its decoder hid, if reported."""


@dataclass(frozen=True)
class CameraFacts:
    """The camera of one drive."""

    drive: str
    K: NDArray[np.float64]
    size: tuple[int, int]
    fps: float | None
    height: float | None
    """Meters above the road."""
    recorded: float = 0.0
    """The given focal length, in widths of the pictures before undistortion."""
    estimate: FocalEstimate | None = None
    """The focal length estimated from those pictures; None if it was not, or could not be, estimated."""

    @property
    def view(self) -> float:
        """Horizontal field of view in degrees."""
        return math.degrees(2 * math.atan(self.size[1] / 2 / self.K[0, 0]))


@dataclass(frozen=True)
class Timeline:
    """Times of one recording's frames, in seconds from the first."""

    drive: str
    frames: int
    times: NDArray[np.float64]
    """Time of each frame; empty if unknown."""
    gaps: tuple[tuple[float, float], ...] = ()
    """Pairs of times between which frames are missing."""
    duplicates: tuple[float, ...] = ()
    """Times of frames that repeat the previous picture or time stamp."""
    recorded: float | None = None
    """Frames per second of the file; only some frames may be used."""

    @property
    def rates(self) -> tuple[float, float, float] | None:
        """Lowest, usual and highest rate, frames per second, of 90 % of the steps outside gaps; None if unknown."""
        steps = np.diff(self.times)[~np.isin(self.times[:-1], [start for start, _ in self.gaps])]
        steps = steps[steps > 0]
        if not steps.size:
            return None
        high, usual, low = (1 / np.quantile(steps, [0.05, 0.5, 0.95])).tolist()
        return low, usual, high


@dataclass(frozen=True)
class SpeedFacts:
    """How much of one recording's distance traveled is known."""

    drive: str
    known: float
    """Fraction of the examined steps between frames with a known distance."""
    speed: float | None
    """Median speed in m/s; None if unknown, as for poses without times."""


@dataclass(frozen=True)
class TruthFacts:
    """One ground-truth map that was read."""

    known: float
    """Fraction of the pixels with depth."""
    low: float
    middle: float
    high: float
    """Smallest, median and largest depth in meters."""


@dataclass
class Survey:
    """All measurements."""

    problems: dict[str, SaunetError] = field(default_factory=dict)
    """Split -> why it cannot be used."""
    windows: dict[str, int] = field(default_factory=dict)
    left_out: dict[str, dict[str, int]] = field(default_factory=dict)
    """Split -> reason -> number of frames."""
    absent: dict[str, tuple[int, int]] = field(default_factory=dict)
    """Split -> number of its recordings without any frame, and of all its recordings."""
    test_only: frozenset[str] = frozenset()
    """Recordings that neither training nor validation read."""
    fingerprints: dict[str, str] = field(default_factory=dict)
    overlap: str | None = None
    """A sentence about splits that share recordings."""
    shared_frames: int = 0
    """Number of frames in both training and validation windows."""
    known: int = 0
    """Number of frames that any split reads."""
    judged: int = 0
    """Number of these that were to be read."""
    frames: list[FrameFacts] = field(default_factory=list)
    cameras: list[CameraFacts] = field(default_factory=list)
    focals: tuple[int, int] = 0, 0
    """Number of cameras (with one K each) whose focal length was examined, and of all cameras."""
    camera_problems: list[str] = field(default_factory=list)
    timelines: list[Timeline] = field(default_factory=list)
    truths: list[TruthFacts] = field(default_factory=list)
    truth_wanted: int = 0
    """Number of frames whose ground truth was requested."""
    protocol: str = ""
    """The data set's own evaluation protocol."""
    compared_views: tuple[int, int] | None = None
    """Number of test frames with neighbors, whose views can be compared, and of all; None if all have them."""
    views_too: bool = False
    """Whether evaluation compares such views besides ground truth, unless told otherwise."""
    camera_files: str = ""
    """A line that names the camera files in use."""
    speeds: list[SpeedFacts] = field(default_factory=list)
    speed_problems: list[str] = field(default_factory=list)
    """Sentences about speeds that lie with the data and cannot be used."""
    with_speed: bool = False
    """Whether batches have the distance traveled."""
    pictures: list[tuple[str, NDArray[np.uint8]]] = field(default_factory=list)
    """A few frames with their names, 320 pixels wide."""
    numbering: dict[str, str] = field(default_factory=dict)
    """Recording -> the numbering of its frames; without ambiguous names."""
    ambiguous: list[str] = field(default_factory=list)
    """Names that different recordings share."""
    step: int = 1
    """Offset of the neighbor that motion is measured against."""
    samples: int = 12
    """Samples per training step, over all devices."""
    images: int = 3
    """Images per sample: the target and its sources."""
    holding_out: list[str] = field(default_factory=list)
    """Keys of the data set that hold recordings out of training."""
    cacheable: bool = False
    """Whether the data module could read a cache of smaller images but does not."""

    def readable(self) -> list[FrameFacts]:
        return [frame for frame in self.frames if frame.problem is None]

    def compared(self) -> list[FrameFacts]:
        """Return the frames whose motion against a neighbor was measured."""
        return [frame for frame in self.readable() if frame.flow is not None]


def survey(
    data: DepthDataModule,
    splits: Sequence[str] = SPLITS,
    frames: int = 1000,
    advance: Callable[[int, int], None] = lambda done, total: None,
) -> Survey:
    """Set up a data module's splits, and read at most ``frames`` frames (0: all) of all recordings, evenly spread."""
    cacheable = data.cacheable and data.copies is None
    found = Survey(
        step=min((abs(offset) for offset in data.offsets), default=1),
        samples=data.batch_size,
        images=1 + len(data.offsets) + data.stereo,
        cacheable=cacheable,
        holding_out=data.holding_out,
        protocol=data.protocol,
        with_speed=data.odometer is not None,
    )
    datasets = dict(_set_up(data, splits, found))
    if "train" in datasets and "val" in datasets:
        found.shared_frames = len(_read_by(datasets["train"]) & _read_by(datasets["val"]))
        found.overlap = data.overlap()
    drives: dict[str, Drive] = {}
    timed: dict[str, Drive] = {}
    wanted: dict[str, set[int]] = {}
    for split, dataset in datasets.items():
        labels = [_label(drive, split, drives) for drive in dataset.drives]
        timed |= {label: drive for label, drive in zip(labels, dataset.drives, strict=True) if drive.indices}
        for position, frame in dataset.windows:
            drives[labels[position]] = dataset.drives[position]
            wanted.setdefault(labels[position], set()).update(frame + offset for offset in (0, *dataset.offsets))
    found.ambiguous = sorted({drives[label].name for label in wanted if drives[label].name != label})
    for label in wanted:
        if drives[label].name not in found.ambiguous:
            found.numbering[label] = drives[label].numbering
    trained = {drive.name for split in ("train", "val") if split in datasets for drive in datasets[split].drives}
    found.test_only = frozenset(wanted.keys() - trained) if trained else frozenset()
    if "test" in datasets and not data.has_neighbors("test"):
        windows, _ = find_windows(datasets["test"].selections(), data.offsets)
        found.compared_views = len(windows), len(datasets["test"])
        found.views_too = "campus" in data.protocols
    found.camera_files = camera_files(drives.values())
    everything = [(name, frame) for name, numbers in wanted.items() for frame in sorted(numbers)]
    plan = _spread(everything, frames)
    found.known, found.judged = len(everything), len(plan)
    _read_frames(found, drives, plan, advance)
    found.timelines = [_timeline(found, name, drive) for name, drive in timed.items()]
    for name in wanted:
        _look_at_camera(found, name, drives[name], min(wanted[name]))
    _measure_speeds(found, drives, wanted)
    if datasets:
        found.speed_problems += data.speed_problems()
    _estimate_focal(found, drives, min(frames or found.known, found.known))
    for split in ("test", "val"):
        if split in datasets and not found.truths:
            _read_truths(found, datasets[split])
    return found


def _set_up(data: DepthDataModule, splits: Sequence[str], found: Survey) -> Iterator[tuple[str, WindowDataset]]:
    for split in splits:
        try:
            data.setup_split(split)
        except SaunetError as error:
            found.problems[split] = error
        if split not in data.datasets:
            continue
        dataset = data.datasets[split]
        found.windows[split] = len(dataset)
        found.fingerprints[split] = dataset.fingerprint()
        found.left_out[split] = {}
        absent = [not drive.indices for drive in dataset.drives]
        found.absent[split] = (sum(absent), len(absent))
        for usage, gone in zip(data.usage[split], absent, strict=True):
            for reason, count in usage.left_out.items():
                reason = ABSENT if gone and reason == "missing" else reason
                found.left_out[split][reason] = found.left_out[split].get(reason, 0) + count
        yield split, dataset


def _label(drive: Drive, split: str, drives: Mapping[str, Drive]) -> str:
    """Return a recording's name, followed by the split if another recording has the same name."""
    known = drives.get(drive.name)
    if known is None or not known.indices:
        return drive.name
    first = known.indices[0]
    same = list(known.indices) == list(drive.indices) and known.path(first) == drive.path(first)
    return drive.name if same else f"{drive.name} ({split})"


def _read_by(dataset: WindowDataset) -> set[tuple[str, int]]:
    return {
        (dataset.drives[position].name, frame + offset)
        for position, frame in dataset.windows
        for offset in (0, *dataset.offsets)
    }


def _spread(plan: Sequence[tuple[str, int]], most: int) -> list[tuple[str, int]]:
    if not most or len(plan) <= most:
        return list(plan)
    return [plan[place] for place in evenly(len(plan), most)]


def _read_frames(
    found: Survey, drives: Mapping[str, Drive], plan: Sequence[tuple[str, int]], advance: Callable[[int, int], None]
) -> None:
    shown = set(evenly(len(plan), _PICTURES))
    existing = {name: set(drives[name].indices) for name in {name for name, _ in plan}}
    last: tuple[tuple[str, int], NDArray[np.uint8]] | None = None
    for place, (name, index) in enumerate(plan):
        drive = drives[name]
        neighbor = index - found.step if index - found.step in existing[name] else index + found.step
        before = None
        if last is not None and last[0] == (name, neighbor):
            before = last[1]
        elif neighbor in existing[name]:
            with suppress(DataError):  # reported in its own turn
                before = shrink(drive.image(neighbor))
        complaints: list[str] = []
        try:
            with _complaints(complaints):
                start = time.perf_counter()
                image = drive.image(index)
                seconds = time.perf_counter() - start
        except DataError as error:
            found.frames.append(FrameFacts(name, index, problem=str(error), of_camera=isinstance(error, CameraError)))
            continue
        small, size, path = shrink(image), None, drive.path(index)
        with suppress(OSError):
            size = path.stat().st_size if path else None
        light, contrast = float(small.mean()) / 255, float(small.mean(axis=2).std()) / 255
        facts = FrameFacts(name, index, (image.shape[0], image.shape[1]), seconds, size, light, contrast)
        facts = replace(facts, damage=next(iter(complaints), None))
        if before is not None and before.shape == small.shape:
            lengths = np.linalg.norm(optical_flow(before, small), axis=-1)
            bands = np.array([band.mean() for band in np.array_split(lengths, BANDS)], dtype=np.float64)
            change = relative_change(before, small)
            facts = replace(facts, flow=float(np.median(lengths)), change=change, bands=bands)
        found.frames.append(facts)
        if place in shown:
            found.pictures.append((f"{name} {index}", small))
        last = ((name, index), small)
        advance(place + 1, len(plan))


@contextmanager
def _complaints(found: list[str]) -> Iterator[None]:
    """Collect libjpeg's messages about damaged data from standard error, because OpenCV does not pass them on."""
    kept = os.dup(2)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            file.seek(0)
            for line in file:
                if line.startswith((b"Corrupt JPEG data", b"Premature end of JPEG")):
                    found.append(line.decode(errors="replace").strip())
                else:
                    os.write(2, line)


def _timeline(found: Survey, name: str, drive: Drive) -> Timeline:
    times, indices, cuts = drive.timestamps, drive.indices, drive.gaps
    if times is None or not np.isfinite(times).all():
        return Timeline(name, len(indices), np.empty(0), recorded=drive.fps)
    start, same = float(times[0]), dict(zip(indices, times.tolist(), strict=True))
    doubled = [frame.index for frame in found.compared() if frame.drive == name and is_doubled(frame)]
    repeated = {*drive.duplicates, *times[1:][np.diff(times) <= 0].tolist(), *(same[i] for i in doubled if i in same)}
    gaps = tuple(
        (same[before] - start, same[after] - start) for before, after in itertools.pairwise(indices) if before in cuts
    )
    return Timeline(name, len(indices), times - start, gaps, tuple(sorted(t - start for t in repeated)), drive.fps)


def is_doubled(frame: FrameFacts) -> bool:
    """Return whether a frame is the same picture as its neighbor."""
    return frame.change is not None and frame.change < SAME_PICTURE


def _look_at_camera(found: Survey, name: str, drive: Drive, index: int) -> None:
    sizes = Counter(frame.size for frame in found.readable() if frame.drive == name)
    try:
        K = np.asarray(drive.intrinsics(index), dtype=np.float64)
    except DataError as error:
        broken = any(frame.drive == name and frame.problem and not frame.of_camera for frame in found.frames)
        if isinstance(error, CameraError) or not broken:  # otherwise its size could not be read: the frames say why
            found.camera_problems.append(str(error))
        return
    if sizes:
        size, lens = sizes.most_common(1)[0][0], drive.lens
        # the picture before undistortion has the same size as after
        recorded = float((K if lens is None else lens.K)[0, 0]) / size[1]
        found.cameras.append(CameraFacts(name, K, size, drive.fps, drive.camera_height, recorded))


def _measure_speeds(found: Survey, drives: Mapping[str, Drive], wanted: Mapping[str, set[int]]) -> None:
    """Ask for the distance traveled between some neighbors of each recording, as training with speeds does."""
    for name, frames in wanted.items():
        steps = [(frame, frame + found.step) for frame in sorted(frames) if frame + found.step in frames]
        chosen = [steps[place] for place in evenly(len(steps), max(2, _STEPS // len(wanted)))] if steps else []
        distances, speeds = list[float](), list[float]()
        try:
            for first, second in chosen:
                distance = measured_distance(drives[name], first, second)
                start, end = drives[name].time(first), drives[name].time(second)
                if math.isfinite(distance):
                    distances.append(distance)
                    speeds += [] if start is None or end is None or end <= start else [distance / (end - start)]
        except DataError as error:
            found.speed_problems.append(str(error))
        known, median = len(distances) / max(1, len(chosen)), float(np.median(speeds)) if speeds else None
        found.speeds.append(SpeedFacts(name, known, median))


def _estimate_focal(found: Survey, drives: Mapping[str, Drive], frames: int) -> None:
    """Examine a few seconds of each camera if many frames may be read; those with the strongest turns tell the most."""
    groups: dict[bytes, list[int]] = {}
    for place, camera in enumerate(found.cameras):
        groups.setdefault(camera.K.tobytes(), []).append(place)
    chosen, began = list(groups.values())[:_FOCALS], time.process_time()
    for number, places in enumerate(chosen):
        camera, several = found.cameras[places[0]], [drives[found.cameras[place].drive] for place in places]
        lens = several[0].lens or LensModel("pinhole", (), camera.K)
        left = (FOCAL_SECONDS - (time.process_time() - began)) / (len(chosen) - number)
        windows = drive_windows(several, min(20, 2 * frames // WINDOW))  # which overlap by half
        estimate = check_focal(windows, lens, camera.size[1], most=12, seconds=left)
        for place in places:
            found.cameras[place] = replace(found.cameras[place], estimate=estimate)
    found.focals = len(chosen), len(groups)


def _read_truths(found: Survey, dataset: WindowDataset) -> None:
    chosen = _spread([(dataset.drives[position].name, frame) for position, frame in dataset.windows], _TRUTHS)
    drives = {drive.name: drive for drive in dataset.drives}
    for name, index in chosen:
        found.truth_wanted += 1
        try:
            depth = drives[name].depth(index)
        except DataError as error:
            found.frames.append(FrameFacts(name, index, problem=str(error)))
            continue
        if depth is not None and (known := depth[depth > 0]).size:
            low, middle, high = np.quantile(known, [0, 0.5, 1]).tolist()
            found.truths.append(TruthFacts(known.size / depth.size, low, middle, high))
