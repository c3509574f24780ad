"""Virtual KITTI 2 (Cabon et al., 2020): five drives of KITTI rendered in ten variants, both cameras."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Unpack

from saunet.data.checks import check_rotation
from saunet.data.loading.options import Loading
from saunet.data.sets.base import FilesDataModule, find_root, report_missing
from saunet.data.sets.files import DepthFilesDrive, numbered, pair_up, read_rows
from saunet.errors import ConfigError, DataError, one_of
from saunet.io.images import read_depth
from saunet.registry import datamodules

SCENES: tuple[str, ...] = ("Scene01", "Scene02", "Scene06", "Scene18", "Scene20")
ANGLES: tuple[str, ...] = ("15-deg-left", "15-deg-right", "30-deg-left", "30-deg-right")
VARIANTS: tuple[str, ...] = ("clone", "fog", "morning", "overcast", "rain", "sunset", *ANGLES)
CAMERAS = {"left": (0, "l"), "right": (1, "r")}  # camera name -> its number on disk and its letter in names
SIZE = (375, 1242)  # (height, width) of the images
SKY = 65_535
"""Stored depth of the sky and of everything beyond 655.34 m."""
FPS = 10.0  # of KITTI, whose drives are cloned frame by frame

_FIX = "unpack vkitti_2.0.3_rgb.tar, vkitti_2.0.3_depth.tar and vkitti_2.0.3_textgt.tar.gz into one folder"
_INTRINSICS = ("frame", "cameraID", "K[0,0]", "K[1,1]", "K[0,2]", "K[1,2]")
_EXTRINSICS = ("frame", "cameraID", *(f"E[{row},{column}]" for row in range(4) for column in range(4)))


class VirtualKittiDrive(DepthFilesDrive):
    """One camera of one variant of a scene; depth is the camera's z."""

    @staticmethod
    def read(path: Path) -> NDArray[np.float32]:
        """Return a stored map in meters: 16 bits in centimeters, the sky unknown."""
        depth = read_depth(path, 100)
        depth[depth >= SKY / 100 - 0.005] = 0
        return depth


@datamodules.register("vkitti")
class VirtualKittiDataModule(FilesDataModule):
    """Virtual KITTI 2: five drives of KITTI rendered in ten variants of weather, light and angle, with exact depth.

    Args:
        root: Folder of the scenes (``Scene01/clone/frames/...`` beside ``Scene01/clone/intrinsic.txt``).
        variants: Variants to use; results are grouped by them.
        cameras: ``left``, ``right`` or both.
        val_scenes: Scenes to validate on.
        test_scenes: Scenes to test and predict; all others train.
        **loading: Loader settings, as in `LoadOptions`.

    Raises:
        ConfigError: if a parameter is out of range or a choice is unknown.
    """

    protocol = "synthetic"
    ground_truth = "exact"

    root: str

    def __init__(
        self,
        *,
        root: str = "data/vkitti",
        variants: Sequence[str] = VARIANTS,
        cameras: Sequence[Literal["left", "right"]] = ("left",),
        val_scenes: Sequence[str] = ("Scene02",),
        test_scenes: Sequence[str] = ("Scene20",),
        target_depth: bool = False,
        with_pose: bool = False,
        stereo: bool = False,
        cache: str | None = None,
        **loading: Unpack[Loading],
    ) -> None:
        super().__init__(target_depth=target_depth, with_pose=with_pose, stereo=stereo, cache=cache, **loading)
        self.root = root
        self.variants = tuple(one_of("variants", variant, VARIANTS) for variant in variants)
        self.cameras = tuple(one_of("cameras", camera, CAMERAS) for camera in cameras)
        held = [one_of("scenes", scene, SCENES) for scene in (*val_scenes, *test_scenes)]
        train = tuple(scene for scene in SCENES if scene not in held)
        self.scenes = {"train": train, "val": tuple(val_scenes), "test": tuple(test_scenes)}
        if not self.variants or not self.cameras or not train:
            raise ConfigError("variants, cameras and the scenes that are not held out must not be empty; name some")

    def drives(self, split: str) -> Sequence[VirtualKittiDrive]:
        home = find_root(self.root, "Scene*/*/frames/rgb", f"the folder of Scene01 to Scene20; {_FIX}")
        wanted = list(itertools.product(self.scenes[split if split in self.scenes else "test"], self.variants))
        there = [pair for pair in wanted if (home.joinpath(*pair) / "frames" / "rgb").is_dir()]
        lacking = [home.joinpath(*pair) for pair in wanted if pair not in there]
        what = f"scenes times variants of the {split} split"
        report_missing(lacking, len(wanted), what, f"{_FIX}, or choose existing data.variants and scenes")
        found = [read_variant(home, *pair) for pair in there]
        return [drives[camera] for drives in found for camera in self.cameras if drives[camera].indices]


def read_variant(home: Path, scene: str, variant: str) -> dict[str, VirtualKittiDrive]:
    """Return the recordings of the cameras of a variant of a scene, a rectified pair, by camera."""
    folder = home / scene / variant
    given, moved = folder / "intrinsic.txt", folder / "extrinsic.txt"
    intrinsics = read_rows(given, _INTRINSICS, skip=1, fix=_FIX)
    extrinsics = read_rows(moved, _EXTRINSICS, skip=1, fix=_FIX)
    drives = dict[str, VirtualKittiDrive]()
    E = {number: {int(row[0]): row[2:].reshape(4, 4) for row in extrinsics if row[1] == number} for number in (0, 1)}
    both = E[0].keys() & E[1].keys()  # extrinsics map points of the world to the camera's
    if not both or len(np.unique(intrinsics[:, 2:], axis=0)) != 1:
        raise DataError(
            f"{given} must have one K for all frames, and {moved} must have rows of cameras 0 and 1; {_FIX}"
        )
    fx, fy, cx, cy = intrinsics[0, 2:]  # 620.5 is the middle of 1242 pixels if the center of the first one is 0
    for name, (number, side) in CAMERAS.items():
        paths = numbered(folder / "frames" / "rgb" / f"Camera_{number}", r"rgb_(\d+)\.(?:jpg|png)")
        lacking = sorted(E[number].keys() - paths.keys()) if paths else []
        report_missing(lacking, len(E[number]), f"frames of camera {number} in {folder}", _FIX)
        poses = {frame: np.linalg.inv(E[number][frame]) for frame in paths.keys() & E[number].keys()}
        for frame, pose in poses.items():
            check_rotation(pose[:3, :3], f"{moved}, frame {frame} of camera {number}")
        drives[name] = VirtualKittiDrive(
            f"{scene}/{variant} {side}",
            paths,
            np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
            given,
            SIZE,
            times={frame: frame / FPS for frame in paths},
            poses=poses,
            condition=variant,
            folder=folder,
        )
        drives[name].depths = numbered(folder / "frames" / "depth" / f"Camera_{number}", r"depth_(\d+)\.png")
    pair_up(drives["left"], drives["right"], E[1][min(both)] @ np.linalg.inv(E[0][min(both)]))
    return drives
