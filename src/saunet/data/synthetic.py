"""Data module of the synthetic world: nothing to download; exact depth, poses and intrinsics."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from pathlib import Path

from typing_extensions import Unpack

from saunet.data.loading.module import DepthDataModule
from saunet.data.loading.options import Loading
from saunet.data.loading.windows import Selection
from saunet.errors import ConfigError, positive
from saunet.io.progress import bar
from saunet.registry import datamodules
from saunet.synthetic import SyntheticDrive

_SEEDS_A_SPLIT = 10_000
_SPLITS = ("train", "val", "test")


@datamodules.register("synthetic", height=64, width=192, batch_size=8, workers=0)
@datamodules.register(
    "synthetic_tiny",
    height=64,
    width=96,
    batch_size=2,
    workers=0,
    train_drives=1,
    val_drives=1,
    test_drives=1,
    frames_per_drive=6,
)
class SyntheticDataModule(DepthDataModule):
    """Procedurally generated streets with exact ground truth; train, val and test drives are different streets.

    Args:
        train_drives: Number of drives to train on.
        val_drives: Number of drives to validate on.
        test_drives: Number of drives to test on.
        frames_per_drive: Length of each drive, at 10 frames per second.
        moving_cars: Moving cars in each drive, alternately ahead and oncoming.
        camera_height: Meters above the road.
        cache: Folder that keeps rendered drives between runs; None renders them each time.
        stereo: Add the right camera's image, 0.54 m to the right, as one more source; with ``offsets: []`` it is the
            only one.
        **loading: Loader settings, as in `LoadOptions`; ``seed`` also chooses the streets.

    Raises:
        ConfigError: if a parameter is out of range.
    """

    protocol = "synthetic"
    camera_height: float = 1.65
    cacheable = False  # it renders once, into its own cache
    ground_truth = "exact"

    def __init__(
        self,
        *,
        target_depth: bool = False,
        with_pose: bool = False,
        train_drives: int = 8,
        val_drives: int = 1,
        test_drives: int = 1,
        frames_per_drive: int = 60,
        moving_cars: int = 0,
        camera_height: float = 1.65,
        cache: str | None = None,
        stereo: bool = False,
        **loading: Unpack[Loading],
    ) -> None:
        super().__init__(target_depth=target_depth, with_pose=with_pose, stereo=stereo, **loading)
        self.counts = {"train": train_drives, "val": val_drives, "test": test_drives}
        for split, count in self.counts.items():
            positive(f"{split}_drives", count)
            if count > _SEEDS_A_SPLIT:
                raise ConfigError(
                    f"{split}_drives is {count}; at most {_SEEDS_A_SPLIT} different drives per split are possible"
                )
        self.frames_per_drive = int(positive("frames_per_drive", frames_per_drive))
        self.moving_cars = int(positive("moving_cars", moving_cars, allow_zero=True))
        self.camera_height = positive("camera_height", camera_height)
        self.cache = None if cache is None else Path(cache)
        self._drives: dict[str, list[SyntheticDrive]] = {}

    def drives(self, split: str) -> list[SyntheticDrive]:
        """Return the drives of ``train``, ``val`` or ``test`` (``predict`` is ``test``), rendered."""
        name = "test" if split == "predict" else split
        if name not in self._drives:
            first = (self.seed * len(_SPLITS) + _SPLITS.index(name)) * _SEEDS_A_SPLIT
            larger = 1 + self.crop_margin if name == "train" else 1.0
            self._drives[name] = [
                SyntheticDrive(
                    seed=first + number,
                    frames=self.frames_per_drive,
                    height=round(self.height * larger),
                    width=round(self.width * larger),
                    moving_cars=self.moving_cars,
                    camera_height=self.camera_height,
                    cache=self.cache,
                )
                for number in range(self.counts[name])
            ]
            pairs = [drive.stereo() for drive in self._drives[name]] if self.stereo and self.has_neighbors(name) else []
            _render([*self._drives[name], *pairs], name, show=self._place()[0] == 0)
        return self._drives[name]

    def driven(self) -> SyntheticDataModule:
        """Return a data module whose test drives are this one's training drives, at the size of its networks.

        For adapting to a clip, whose depth is wanted: the video was learned from, its true depth was not.
        """
        other = copy.copy(self)
        other.crop_margin, other.datasets, other.usage = 0.0, {}, {}
        other._drives = {name: drives for name, drives in self._drives.items() if name != "train"}
        other._drives["test"] = other.drives("train")
        return other

    def select(self, split: str) -> Sequence[Selection]:
        return [Selection(drive, drive.indices) for drive in self.drives(split)]


def _render(drives: Sequence[SyntheticDrive], split: str, show: bool) -> None:
    """Render before loading starts: loader processes then share the frames."""
    with bar(show) as shown:
        task = shown.add_task(f"rendering {split} drives", total=sum(len(d.indices) for d in drives))
        for drive in drives:
            drive.render(lambda: shown.advance(task))
