"""The preparation tool: dense depth from LiDAR, a teacher's depth, smaller images, imported clips, or packed data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal, get_args

from saunet.data.drive import Drive
from saunet.data.kitti import splits
from saunet.data.kitti.raw import CAMERAS, DepthKind, KittiRaw
from saunet.data.loading.module import DepthDataModule
from saunet.data.loading.stored import DENSE_KINDS, CacheSettings
from saunet.data.loading.windows import other_view
from saunet.errors import ConfigError, DataError, checked, one_of, positive, suggest, usable_device
from saunet.prediction.foreign import NOTHING, ForeignOptions, ForeignPredictor
from saunet.prediction.prediction import load
from saunet.registry import Spec
from saunet.threads import available_cores
from saunet.tools.prepare.cache import CacheReport, build_cache
from saunet.tools.prepare.importing import ImportReport, import_recordings
from saunet.tools.prepare.pack import PackReport, pack
from saunet.tools.prepare.pool import Done, OnError, Workers
from saunet.tools.prepare.targets import DenseKind, FileTeacher, ModelTeacher, Recording, Values, densify, teach

Job = Literal["densify", "teacher", "cache", "import", "pack"]
_KITTI = ("root", "cameras", "drives", "split")
_WORKERS = ("workers", "executor", "scheduler")
_SHARED = ("job", *_KITTI, "folder", "on_error")
KEYS: dict[str, tuple[str, ...]] = {
    "densify": (*_SHARED, "kinds", "depth", *_WORKERS),
    "teacher": (*_SHARED, "checkpoint", "foreign", "input", "values", "device", "executor", "scheduler"),
    "cache": (*_SHARED, "data", "height", "width", "format", "quality", *_WORKERS),
    "import": ("job", "folder", "on_error", "input", "topics", "camera"),
    "pack": ("job", "folder", "data", "shard_mb", "workers"),
}
"""Job -> the options that it reads."""


@checked
@dataclass(frozen=True, kw_only=True)
class PrepareOptions:
    """Options of `prepare`: one of five jobs, each with its own options.

    Raises:
        ConfigError: for an invalid value, or an option that the job does not have.

    Examples:
        >>> options = saunet.PrepareOptions(job="densify", root="/data/kitti", kinds=["linear"])
        >>> options.cameras
        ('left', 'right')
    """

    job: Job
    """``densify`` (dense depth maps from LiDAR), ``teacher`` (another model's depth), ``cache`` (smaller images),
    ``import`` (bags and GoPro videos as clips), or ``pack`` (a data set in a few large files, for ``data=packed``)."""
    data: Spec | None = None
    """``cache``, ``pack``: the data module to read; for ``cache``, None reads the KITTI raw tree at ``root``."""
    root: str | None = None
    """Root of a KITTI raw tree."""
    folder: str | None = None
    """Folder for results; None puts depth maps beside each recording. A cache needs its own folder."""
    cameras: Sequence[str] = ("left", "right")
    """``left``, ``right`` or both."""
    drives: Sequence[str] = ()
    """Only these drives, by name or by the end of a name; all if empty."""
    split: str = "all"
    """``all`` frames, those of a named split with their neighbors in time, or a file in Monodepth2's format."""
    kinds: Sequence[DenseKind] = ("linear",)
    """``densify``: ``linear``, ``colorization`` or both."""
    depth: Literal["camera_z", "improved"] = "camera_z"
    """``densify``: the ground truth to start from, ``camera_z`` (scans) or ``improved`` (KITTI's accumulated depth)."""
    checkpoint: str | None = None
    """``teacher``: the trained model that predicts the depth."""
    foreign: ForeignOptions = NOTHING
    """``teacher``: input and output of another system's ONNX or TorchScript model."""
    input: str | None = None
    """``teacher``: a folder of depth that another system predicted. ``import``: a bag of ROS 1 or 2, an MCAP file, a
    GoPro video, or a folder of them."""
    topics: Sequence[str] = ()
    """``import``: only these image topics; all if empty."""
    camera: str | None = None
    """``import``: a camera file for clips without a calibration in the recording."""
    values: Values = "depth"
    """``teacher``: content of those files, ``depth`` or ``disparity``."""
    device: str = "auto"
    """``teacher``: where the model runs; ``auto`` uses a GPU if there is one."""
    height: int = 202
    """``cache``: of the copies, in pixels."""
    width: int = 672
    """``cache``: of the copies, in pixels."""
    format: Literal["jpg", "webp"] = "jpg"
    """``cache``: ``jpg`` or ``webp``."""
    quality: int = 95
    """``cache``: compression quality, 1 to 100."""
    shard_mb: int = 256
    """``pack``: largest size of a file in megabytes."""
    workers: int | None = None
    """Number of processes; 0 works in this one, None uses one per core."""
    executor: Literal["processes", "dask"] = "processes"
    """The workers: ``processes`` of this machine, or a ``dask`` cluster that sees the same folders."""
    scheduler: str | None = None
    """``executor=dask``: address of the cluster's scheduler, such as ``tcp://10.0.0.1:8786``."""
    on_error: OnError = "raise"
    """What to do with a broken file: ``raise`` stops and names it, ``skip`` continues without the frame."""

    def __post_init__(self) -> None:
        for key in ("cameras", "drives", "kinds", "topics"):
            object.__setattr__(self, key, tuple(getattr(self, key)))
        one_of("job", self.job, KEYS)
        given = [each.name for each in fields(self) if getattr(self, each.name) != each.default]
        for key in given:
            if key not in KEYS[self.job]:
                owners = " and ".join(job for job, keys in KEYS.items() if key in keys)
                raise ConfigError(f"{key} belongs to the job {owners}, not to {self.job}; leave it out")
            if self.data is not None and key in _KITTI:
                raise ConfigError(f"{key} is for KITTI raw trees; with data=..., set data.{key} or leave it out")
        one_of("on_error", self.on_error, get_args(OnError))
        one_of("executor", self.executor, ("processes", "dask"))
        if (self.executor == "dask") != (self.scheduler is not None):
            raise ConfigError("executor=dask and scheduler=... (such as tcp://10.0.0.1:8786) belong together; set both")
        if self.executor == "dask" and self.workers is not None:
            raise ConfigError("workers counts processes of this machine; with executor=dask, leave it out")
        if self.job == "import":
            if self.input is None or self.folder is None:
                raise ConfigError(
                    "import needs input=... (a bag, a GoPro video, or a folder of them) and folder=... (for the clips)"
                )
            return
        if self.job == "pack" and (self.data is None or self.folder is None):
            raise ConfigError("a pack needs data=... (what to pack) and folder=... (a new one)")
        positive("shard_mb", self.shard_mb)
        if self.data is None and self.root is None:
            raise ConfigError("root is not set; add root=... (a KITTI raw tree)")
        if self.workers is not None:
            positive("workers", self.workers, allow_zero=True)
        for camera in self.cameras:
            one_of("cameras", camera, CAMERAS)
        one_of("depth", self.depth, ("camera_z", "improved"))
        if not self.kinds:
            raise ConfigError(f"kinds is empty; name at least one of {', '.join(DENSE_KINDS)}")
        for kind in self.kinds:
            one_of("kinds", kind, DENSE_KINDS)
        one_of("values", self.values, get_args(Values))
        if self.job == "teacher" and (self.checkpoint is None) == (self.input is None):
            raise ConfigError("teacher needs either checkpoint=... (a trained model) or input=... (a folder of depth)")
        if self.job == "cache":
            if self.folder is None:
                raise ConfigError("a cache needs a folder of its own; set folder=...")
            CacheSettings(self.height, self.width, self.format, self.quality)


def prepare(options: PrepareOptions) -> Done | CacheReport | ImportReport | PackReport:
    """Run one job; existing results are checked and kept, so an interrupted job resumes.

    Args:
        options: The job and its options.

    Returns:
        The numbers of new and existing results, and one sentence per skipped frame (``failures``); ``print`` shows it.

    Raises:
        DataError: if a recording cannot be read, or the folder holds something else.
        CheckpointError: if the teacher's checkpoint cannot be read.
        ConfigError: if a drive, split or data module does not fit.

    Examples:
        >>> tree = saunet.PrepareOptions(job="densify", root="/nowhere")
        >>> saunet.prepare(tree)
        Traceback (most recent call last):
        saunet.errors.DataError: no data root at /nowhere...
    """
    if options.job == "import":
        return import_recordings(
            str(options.input), str(options.folder), options.topics, options.camera, options.on_error
        )
    count = available_cores() if options.workers is None else options.workers
    workers = Workers(count, options.scheduler)
    if options.job == "pack":
        assert options.data is not None
        return pack(options.data.build(), str(options.folder), options.shard_mb, count)
    if options.data is not None:
        skips = options.on_error == "skip" and "on_error" in options.data.parameters
        changes = {"on_error": "skip"} if skips else {}
        recordings = module_recordings(options.data.build(**changes))
    else:
        assert options.root is not None
        kitti = kitti_recordings(options.root, options.cameras, options.drives, options.split, options.depth)
        if options.job == "densify":
            return densify(kitti, options.kinds, options.folder, workers, options.on_error)
        if options.job == "teacher":
            return teach(kitti, _teacher(options), options.folder, Workers(0, options.scheduler), options.on_error)
        recordings = list(kitti)
    settings = CacheSettings(options.height, options.width, options.format, options.quality)
    return build_cache(recordings, Path(str(options.folder)), settings, workers, options.on_error)


def _teacher(options: PrepareOptions) -> ModelTeacher | FileTeacher:
    device = str(usable_device(options.device))
    if options.input is not None:
        return FileTeacher(options.input, options.values)
    predictor = load(str(options.checkpoint), device=device, foreign=options.foreign)
    if isinstance(predictor, ForeignPredictor) and predictor.shifted:
        raise ConfigError(
            f"{options.checkpoint} gives disparity with an unknown shift, which cannot be turned into depth up to "
            "scale; set foreign.factor and foreign.shift, or use a teacher that gives depth"
        )
    return ModelTeacher(predictor)


def kitti_recordings(
    root: str | Path,
    cameras: Sequence[str] = ("left", "right"),
    drives: Sequence[str] = (),
    split: str = "all",
    depth: DepthKind = "camera_z",
) -> list[Recording]:
    """Find the recordings of a KITTI raw tree that have frames of a split (see `PrepareOptions`)."""
    raw = KittiRaw(root)
    for drive in drives:
        if not any(name.endswith(drive) for name in raw.drives):
            hint = suggest(drive, [name.rpartition("/")[2] for name in raw.drives])
            raise ConfigError(f"drives holds '{drive}', which is not below {raw.root}{hint}")
    wanted = _frames(split)
    found: list[Recording] = []
    for name in raw.drives:
        if drives and not name.endswith(tuple(drives)):
            continue
        for camera in cameras:
            recording = raw.drive(name, camera, depth)
            side = CAMERAS[camera][1]
            frames = [n for n in recording.indices if wanted is None or (name, n, side) in wanted]
            if frames:
                found.append((recording, frames))
    if not found:
        raise DataError(f"the drives below {raw.root} hold no frames of cameras {list(cameras)} and split '{split}'")
    return found


def _frames(split: str) -> set[tuple[str, int, str]] | None:
    if split == "all":
        return None
    if split in splits.TRAINING:
        train, val = splits.training_split(split, 0)
        frames = [*train, *val]
    elif split in splits.TEST:
        frames = splits.test_split(split)
    elif Path(split).is_file():
        frames = splits.read_split(Path(split))
    else:
        words = ("all", *splits.TRAINING, *splits.TEST)
        hint = suggest(split, words)
        raise ConfigError(
            f"split is '{split}'{hint or ','} allowed: {', '.join(words)}, or the path of an existing file"
        )
    return {(frame.drive, frame.number + step, frame.side) for frame in frames for step in (-1, 0, 1)}


def module_recordings(data: DepthDataModule) -> list[tuple[Drive, Sequence[int]]]:
    """Return a data module's training and validation recordings; with ``stereo`` the other cameras too."""
    if not data.cacheable:
        raise ConfigError(
            f"{type(data).__name__} reads no copies made by saunet prepare; use data=kitti, kitti_odometry or video"
        )
    data.prepare_data()
    drives: dict[str, Drive] = {}
    for split in ("train", "val"):
        for drive, *_ in data.select(split):
            drives.setdefault(drive.name, drive)
            if data.stereo:
                other, _ = other_view(drive)
                drives.setdefault(other.name, other)
    return [(drive, drive.indices) for drive in drives.values() if len(drive.indices)]
