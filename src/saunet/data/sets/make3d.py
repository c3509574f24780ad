"""Make3D (Saxena et al., 2009): 134 test images of a campus with depth from a laser; to test on only."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import scipy.io
import torch
from lightning.pytorch.utilities import rank_zero_warn
from numpy.typing import NDArray
from scipy.io.matlab import MatReadError
from typing_extensions import Unpack

from saunet.data.loading.module import DepthDataModule
from saunet.data.loading.options import Loading
from saunet.data.loading.windows import Selection
from saunet.data.sets.base import find_root, report_missing
from saunet.data.sets.files import DepthFilesDrive
from saunet.errors import ConfigError, DataError
from saunet.geometry.camera import crop_intrinsics
from saunet.io.images import natural_order, read_image
from saunet.registry import datamodules

SIZE = (2272, 1704)  # (height, width) of the images
COUNT = 134
"""Test images of the data set."""
K = np.array([[2407.3312729885838, 0, 833.72104535435108], [0, 2400.2091651084, 1110.7122391785729], [0, 0, 1]])
"""The camera in the settings of Make3D's own code."""
ROWS = slice(17, 38)
"""The 21 of 55 rows of depth that belong to the central 2:1 part of an image, as Monodepth (Godard et al., 2017) and
those after it evaluate."""
_FIX = "unpack Test134.tar.gz and Test134Depth.tar.gz into one folder"


class Make3dDrive(DepthFilesDrive):
    """The test images, or their central parts, which are twice as wide as high."""

    crop = True

    @staticmethod
    def read(path: Path) -> NDArray[np.float32]:
        """Return the laser's distances, 55 x 305, meters: the fourth number of each point, which papers compare."""
        try:
            grid = scipy.io.loadmat(str(path), variable_names=["Position3DGrid"])["Position3DGrid"]
        except (OSError, ValueError, KeyError, TypeError, NotImplementedError, MatReadError) as reason:
            raise DataError(f"{path} is not a readable MATLAB file with a Position3DGrid; {_FIX}") from reason
        if grid.ndim != 3 or grid.shape[2] != 4:
            raise DataError(f"{path}: Position3DGrid has shape {grid.shape}; expected 55 x 305 x 4: {_FIX}")
        depth = np.asarray(grid[..., 3], np.float32)
        return np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)

    @property
    def frame_size(self) -> tuple[int, int]:
        height, width = self.recorded_size
        return (round(width / 2), width) if self.crop else (height, width)

    @property
    def _top(self) -> int:
        return (self.recorded_size[0] - self.frame_size[0]) // 2

    def image(self, index: int) -> NDArray[np.uint8]:
        whole = read_image(self.path(index))
        return np.ascontiguousarray(whole[self._top : self._top + self.frame_size[0]])

    def intrinsics(self, index: int) -> NDArray[np.float64]:
        return crop_intrinsics(torch.from_numpy(super().intrinsics(index)), 0, self._top).numpy()

    def depth(self, index: int) -> NDArray[np.float32] | None:
        depth = super().depth(index)
        return depth[ROWS] if self.crop and depth is not None else depth


@datamodules.register("make3d")
class Make3dDataModule(DepthDataModule):
    """Make3D's 134 test images, which show how a model trained elsewhere generalizes (C1 error: truth below 70 m).

    Args:
        root: Folder of the images (``img-*.jpg``) and depth maps (``depth_sph_corr-*.mat``), at most two levels below.
        crop: Test the central 2:1 part of each image, as published numbers do; otherwise all of it.
        **loading: Loader settings, as in `LoadOptions`.

    Raises:
        ConfigError: if a parameter is out of range, or if it is used for training or validation.
    """

    protocol = "make3d"
    ground_truth = "camera_z"
    cacheable = False  # copies are only read in training

    root: str

    def __init__(self, *, root: str = "data/make3d", crop: bool = True, **loading: Unpack[Loading]) -> None:
        super().__init__(**loading)
        self.root, self.crop = root, crop

    def select(self, split: str) -> Sequence[Selection]:
        if split in ("train", "val"):
            raise ConfigError("make3d has only single test images; train on other data and evaluate with data=make3d")
        home = find_root(self.root, "img-*.jpg", f"the folder of Test134; {_FIX}").parent
        images = sorted(home.glob("*/img-*.jpg"), key=natural_order)
        maps = {path.stem.removeprefix("depth_sph_corr-"): path for path in home.rglob("depth_sph_corr-*.mat")}
        if len(images) < COUNT:
            rank_zero_warn(f"{COUNT - len(images)} of {COUNT} test images are missing at {home}; {_FIX}")
        without = [path for path in images if path.stem.removeprefix("img-") not in maps]
        report_missing(without, len(images), "depth maps of images", _FIX)
        drive = Make3dDrive("make3d", dict(enumerate(images)), K, Path("Make3D's camera"), SIZE, folder=home)
        drive.crop = self.crop
        drive.depths = {
            frame: maps[key] for frame, path in drive.paths.items() if (key := path.stem.removeprefix("img-")) in maps
        }
        with_truth = sorted(drive.depths) if split == "test" else drive.indices
        return [Selection(drive, with_truth, {"without ground truth": len(drive.indices) - len(with_truth)})]
