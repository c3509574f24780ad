"""The base of all data modules: selections of frames in, batches on the device out.

A data set subclasses `DepthDataModule`, adds its own parameters to the shared ones, and implements `select`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence, Set
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from lightning.pytorch import LightningDataModule
from lightning.pytorch.utilities import move_data_to_device, rank_zero_info
from torch.utils.data import DataLoader
from typing_extensions import Unpack

from saunet.data.drive import Drive
from saunet.data.loading.options import Loading, LoadOptions
from saunet.data.loading.sampling import EvalBatches, Loader, ResumableLoader, TrainBatches, evenly, processes, share
from saunet.data.loading.selecting import read_manifest, readable
from saunet.data.loading.stored import DepthMaps, ImageCache, check_enlarged
from saunet.data.loading.transforms import Augment, Prepare
from saunet.data.loading.windows import (
    Odometer,
    Selection,
    SkippingWindows,
    Usage,
    WindowDataset,
    collate,
    find_windows,
    measured_distance,
)
from saunet.errors import ConfigError, DataError, checked
from saunet.types import EvalBatch, FrameBatch, TrainBatch

STAGES = {"fit": ("train", "val"), "validate": ("val",), "test": ("test",), "predict": ("predict",)}


@checked
class DepthDataModule(LightningDataModule):
    """Loaders of frame windows, and the transforms that run on the device.

    Args:
        target_depth: Put the target's depth into training batches (0 where unknown), for losses that use it.
        with_pose: Put the true motion into batches.
        stereo: Add the other camera of the pair to training and validation batches as one more source. Its calibrated
            position makes depth metric. With ``offsets: []`` it is the only source.
        cache: Folder of smaller copies made by ``saunet prepare cache``; training and validation read images from it.
        **loading: Fields of `LoadOptions`.

    Attributes:
        neighbors: Splits whose samples have source frames, by default ``train`` and ``val``; without ground truth also
            ``test``, which is then scored by its neighbors.
        protocol: Default evaluation protocol; ``campus`` fits data without depth.
        ground_truth: Kind of depth to evaluate on: ``lidar_x``, ``camera_z``, ``improved``, ``exact`` or ``none``.
        cacheable: Whether ``saunet prepare cache`` can make smaller copies of its images.
        root: Folder of its files; None if it reads none.

    Raises:
        ConfigError: if a parameter is out of range.
        DataError: if the manifest or the cache cannot be read.

    Examples:
        >>> data = saunet.build("data", "synthetic_tiny", workers=0)
        >>> isinstance(data, saunet.DepthDataModule), data.protocol
        (True, 'synthetic')
    """

    neighbors: Sequence[str] = ("train", "val")
    """Splits whose samples have source frames; see `has_neighbors`."""
    protocol: str = "eigen_camera_z"
    """Name of the evaluation protocol that fits this data set's ground truth; ``campus`` if there is none."""
    ground_truth: str = "camera_z"
    """Kind of depth in evaluation batches: ``lidar_x``, ``camera_z``, ``improved``, ``exact`` or ``none``."""
    cacheable: bool = True
    """Whether ``saunet prepare cache`` can make copies for it."""
    root: str | None = None
    """Folder of its files; None if it reads none."""
    static: str | None = None
    """What happens to frames without motion, if a parameter of this name decides it; None otherwise."""
    recognizable: bool = True
    """Whether its file layout is unlike any other data set's, so that it can be recognized."""

    @property
    def camera_height(self) -> float | None:
        """Meters from the road to the camera, the same for all recordings; None if unknown."""
        return None

    def __init__(
        self,
        *,
        target_depth: bool = False,
        with_pose: bool = False,
        stereo: bool = False,
        cache: str | None = None,
        **loading: Unpack[Loading],
    ) -> None:
        super().__init__()
        options = LoadOptions(**loading)
        self.height, self.width = options.height, options.width
        self.offsets, self.seed = tuple(options.offsets), options.seed
        self.batch_size, self.workers = options.batch_size, options.workers
        self.crop_margin, self.on_error = options.crop_margin, options.on_error
        self.track_motion, self.guess_camera = options.track_motion, options.guess_camera
        self.target_depth, self.with_pose, self.stereo = target_depth, with_pose, stereo
        self.manifest = read_manifest(options.manifest) if options.manifest else None
        self.flip_prob, self.color_jitter_prob = options.flip_prob, options.color_jitter_prob
        self.augment = Augment(self.height, self.width, self.flip_prob, self.color_jitter_prob)
        self.prepare = Prepare(self.height, self.width)
        self.maps: dict[str, DepthMaps] = {}
        self.copies = ImageCache(cache) if cache else None
        self.odometer: Odometer | None = measured_distance if options.with_speed else None
        self.usage: dict[str, list[Usage]] = {}
        self.datasets: dict[str, WindowDataset] = {}

    @property
    def protocols(self) -> tuple[str, ...]:
        """Names of the protocols that fit its parts, its own first."""
        return (self.protocol,)

    def select(self, split: str) -> Sequence[Selection]:
        """Return the frames of ``train``, ``val``, ``test`` or ``predict``; the only method a data set must implement.

        Return nothing for ``val`` to train without validation.
        """
        raise NotImplementedError(f"{type(self).__name__} does not define the frames of '{split}'")

    def has_neighbors(self, split: str) -> bool:
        """Return whether a split's samples have source frames: without ground truth, a test compares nothing else."""
        return split in self.neighbors or (split == "test" and self.ground_truth == "none")

    @property
    def holding_out(self) -> list[str]:
        """Keys of this data set that hold recordings out of training, such as ``data.val_drives``."""
        return [f"data.{key}" for key in ("val_clips", "val_drives", "val_share") if hasattr(self, key)]

    def speed_problems(self) -> list[str]:
        """Return a sentence about each table of speeds beside the data that cannot be used, for ``saunet doctor``."""
        return []

    def overlap(self) -> str | None:
        """Return a sentence about splits that share recordings, and how to separate them; None if none do.

        Override it in a data set without published splits.
        """
        return None

    def setup(self, stage: str | None = None) -> None:
        """Find the windows of the splits that a stage needs, and report which frames are used and left out."""
        fresh = "train" not in self.datasets
        for split in STAGES[str(getattr(stage, "value", stage))] if stage else ("train", "val", "test", "predict"):
            self.setup_split(split)
        if fresh and "train" in self.datasets:
            read = [self.datasets[split] for split in STAGES["fit"] if split in self.datasets]
            self._check_manifests({drive.name for dataset in read for drive in dataset.drives})

    def setup_split(self, split: str) -> None:
        """Find the windows of one split, unless done already."""
        selections = [] if split in self.datasets else [Selection(*each) for each in self.select(split)]
        if selections or (split != "val" and split not in self.datasets):
            self.datasets[split] = self._dataset(split, [self._usable(split, each) for each in selections])
            rank_zero_info(self.summary(split))

    def teardown(self, stage: str | None = None) -> None:
        """Report what ``on_error=skip`` skipped."""
        skipped = self.skipped()
        if skipped:
            more = ", ..." if len(skipped) > 5 else ""
            rank_zero_info(f"{len(skipped)} training samples could not be read: {', '.join(skipped[:5])}{more}")

    def skipped(self) -> list[str]:
        """Return the names of the training samples that could not be read so far, with ``on_error=skip``."""
        dataset = self.datasets.get("train")
        return dataset.skipped() if isinstance(dataset, SkippingWindows) else []

    def summary(self, split: str) -> str:
        """Return a readable summary of what a split uses and leaves out, with the fingerprint of its frames."""
        dataset, usage = self.datasets[split], self.usage[split]
        reasons = Counter[str]()
        for drive in usage:
            reasons.update(drive.left_out)
        sources = sum(drive.used > 0 for drive in usage)
        total = Usage(f"{split} ({sources} of {len(usage)} drives)", len(dataset), reasons)
        lines = [str(drive) for drive in usage if len(usage) <= 8 or not drive.used]
        more = [f"... and {len(lines) - 12} more drives"] if len(lines) > 12 else []
        return "\n  ".join([f"{total}; sha256 {dataset.fingerprint()[:16]}", *lines[:12], *more])

    def fingerprints(self) -> dict[str, str]:
        """Return the SHA-256 of the sample names of each split that is set up."""
        return {split: dataset.fingerprint() for split, dataset in self.datasets.items()}

    def _check_manifests(self, names: Set[str]) -> None:
        if self.manifest is not None:
            self.manifest.check(names)

    def _usable(self, split: str, selection: Selection) -> Selection:
        """Leave out the manifest's frames and, if these are to be skipped, unreadable ones."""
        offsets = self.offsets if self.has_neighbors(split) else ()
        if self.manifest is not None and split in ("train", "val"):
            selection = self.manifest.apply(selection, offsets)
        if self.on_error == "skip" and split != "train":
            selection = readable(selection, offsets, with_depth=split in ("val", "test"))
        return selection

    def _dataset(self, split: str, selections: Sequence[Selection]) -> WindowDataset:
        together = self.has_neighbors(split)
        offsets = self.offsets if together else ()
        stereo = self.stereo and together
        windows, usage = find_windows(selections, offsets, stereo)
        if not windows:
            found = "; ".join(map(str, usage[:3])) or "no drives"
            needed = [f"neighbors at {list(offsets)}"] * bool(offsets) + ["a stereo view"] * stereo
            advice = "check the data root and the split"
            if split in ("val", "test") and not usage and self.holding_out:
                advice = f"nothing is held out for it: set {' or '.join(self.holding_out)}"
            if needed:
                advice = f"frames need {' and '.join(needed)}: check the data root, the split and the offsets"
            reasons = Counter[str]()
            for drive in usage:
                reasons.update(drive.left_out)
            still = reasons["doubled"] + reasons["static"]
            if still > reasons.total() / 2:
                keep = ", or set data.static=keep" if self.static not in (None, "keep") else ""
                advice = (
                    f"{still} frames show no motion (duplicates or a standing car): give longer clips with motion{keep}"
                )
            raise DataError(f"split '{split}' has no usable frame ({found}); {advice}")
        if split == "train" and self.odometer is not None:
            self._check_distances(self.odometer, selections, windows)
        self.usage[split] = usage
        kind = SkippingWindows if self.on_error == "skip" and split == "train" else WindowDataset
        return kind(
            self._recordings(split, selections, windows),
            windows,
            offsets=offsets,
            height=self.height,
            width=self.width,
            margin=self._margin(split),
            with_depth=split in ("val", "test"),
            with_target_depth=self.target_depth and together and "target_depth" not in self.maps,
            with_pose=self.with_pose and together,
            track_motion=self.track_motion and together,
            stereo=stereo,
            odometer=self.odometer if together else None,
            maps=self.maps if together else {},
        )

    def _check_distances(
        self, odometer: Odometer, selections: Sequence[Selection], windows: Sequence[tuple[int, int]]
    ) -> None:
        """Refuse data without any known distance traveled, with which the velocity term would train nothing."""
        for place, frame in windows:
            for offset in self.offsets:
                try:
                    if math.isfinite(odometer(selections[place].drive, frame, frame + offset)):
                        return
                except DataError:
                    if self.on_error != "skip":
                        raise
        raise DataError(
            f"with_speed is true but no training frame of {self.root or type(self).__name__} has a speed and its "
            "time, or a pose; add them, or set data.with_speed=false"
        )

    def _margin(self, split: str) -> tuple[int, int]:
        share = self.crop_margin if split == "train" else 0.0
        return round(self.height * share), round(self.width * share)

    def _recordings(
        self, split: str, selections: Sequence[Selection], windows: Sequence[tuple[int, int]]
    ) -> list[Drive]:
        """Return the recordings; only training and validation read the cache, so tests do not depend on it."""
        if self.copies is None or split not in ("train", "val"):
            return [selection.drive for selection in selections]
        needed: dict[int, set[int]] = {position: set() for position, _ in windows}
        if self.on_error == "raise":  # otherwise a missing copy counts as a sample to skip
            for position, frame in windows:
                needed[position].update(frame + offset for offset in (0, *self.offsets))
        copies = {place: self.copies.drive(selections[place].drive, frames) for place, frames in needed.items()}
        check_enlarged(self.copies, copies.values(), (self.height, self.width), self._margin(split))
        return [copies.get(place, selection.drive) for place, selection in enumerate(selections)]

    def train_dataloader(self) -> DataLoader[Any]:
        """Return shuffled training batches, the same for any number of devices."""
        sampler = TrainBatches(self._set_up("train"), self.batch_size, self.seed, *self._place())
        return ResumableLoader(self.datasets["train"], sampler=sampler, **self._loading())

    def val_dataloader(self) -> DataLoader[Any] | list[Any]:
        """Return validation batches, each sample once; an empty list if the data set holds nothing out."""
        return self._eval_loader("val") if "val" in self.datasets or "train" not in self.datasets else []

    def test_dataloader(self) -> DataLoader[Any]:
        """Return test batches, each sample once."""
        return self._eval_loader("test")

    def predict_dataloader(self) -> DataLoader[Any]:
        """Return the frames to predict, each once."""
        return self._eval_loader("predict")

    def batches(
        self, split: str, device: str | torch.device, place: tuple[int, int] | None = None
    ) -> Iterator[EvalBatch]:
        """Yield a split's batches ready for the networks, on a device: evaluation without a trainer.

        With ``place`` (this process's number and the number of processes), each process gets its part of the samples.
        """
        loader = self._eval_loader(split)
        if place is not None:
            samples = range(place[0], len(self._set_up(split)), place[1])
            sampler = [
                list(samples[first : first + self.batch_size]) for first in range(0, len(samples), self.batch_size)
            ]
            loader = Loader(self.datasets[split], sampler=sampler, **self._loading())
        for batch in loader:
            yield self.prepare(move_data_to_device(batch, torch.device(device)))

    def ground_truths(self, split: str, most: int = 500) -> Iterator[Float[torch.Tensor, "1 h w"]]:
        """Yield the true depth of a split's frames that have some, at native size, meters, 0 where unknown."""
        dataset = self._set_up(split)
        for position, frame in (dataset.windows[place] for place in evenly(len(dataset), most)):
            depth = dataset.drives[position].depth(frame)
            if depth is not None:
                yield torch.from_numpy(np.ascontiguousarray(depth, dtype=np.float32))[None]

    def listed(self, split: str) -> list[str]:
        """Return the names of all images that a split lists, in its order, with or without ground truth.

        Arrays of predictions made elsewhere follow this order.
        """
        dataset = self._set_up(split)
        return [dataset.name(index) for index in range(len(dataset))]

    def on_after_batch_transfer(self, batch: FrameBatch, dataloader_idx: int) -> TrainBatch | EvalBatch:
        """Turn bytes into images on the device; samples that come with random numbers are augmented."""
        return self.augment(batch) if "draws" in batch else self.prepare(batch)  # type: ignore[no-any-return]

    def _eval_loader(self, split: str) -> DataLoader[Any]:
        rank, world_size = self._place()
        sampler = EvalBatches(self._set_up(split), share(self.batch_size, world_size), rank, world_size)
        return Loader(self.datasets[split], sampler=sampler, **self._loading())

    def _set_up(self, split: str) -> WindowDataset:
        if split not in self.datasets:
            raise ConfigError(f"the '{split}' split is not set up; call setup() first")
        return self.datasets[split]

    def _place(self) -> tuple[int, int]:
        return (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)

    def _loading(self) -> Mapping[str, Any]:
        return {**processes(self.workers), "batch_size": None, "collate_fn": collate}  # samplers yield whole batches


def surroundings(
    data: DepthDataModule,
    split: str,
    device: str | torch.device,
    *,
    offsets: Sequence[int] = (),
    stereo: bool = False,
    odometer: Odometer | None = None,
    most: int = 100,
) -> Iterator[EvalBatch]:
    """Yield frames of a split one by one, ready for the networks, with the sources needed to measure scale."""
    selections = data._set_up(split).selections()
    windows, usage = find_windows(selections, offsets, stereo)
    if not windows:
        raise DataError(
            f"no frame of split '{split}' has neighbors at {list(offsets)}{' and a stereo view' if stereo else ''} "
            f"({'; '.join(map(str, usage[:3]))}); measure the scale in another way"
        )
    samples = WindowDataset(
        [selection.drive for selection in selections],
        [windows[place] for place in evenly(len(windows), most)],
        offsets=offsets,
        height=data.height,
        width=data.width,
        stereo=stereo,
        odometer=odometer,
    )
    for index in range(len(samples)):
        yield data.prepare(move_data_to_device(collate(samples[index]), torch.device(device)))
