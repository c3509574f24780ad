"""The KITTI odometry benchmark: its sequences with calibration and true poses, and their data module."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Unpack

from saunet.data.checks import check_intrinsics, check_rotation, common_size, scaled
from saunet.data.drive import Drive
from saunet.data.kitti.files import read_matrices, read_times, zero_based
from saunet.data.kitti.raw import CAMERA_HEIGHT, frame_files
from saunet.data.loading.module import DepthDataModule
from saunet.data.loading.options import Loading
from saunet.data.loading.selecting import BETWEEN, Frame, hold_out_tails, with_poses
from saunet.data.loading.windows import Selection, reach
from saunet.errors import DataError, in_range, one_of
from saunet.io.images import read_image
from saunet.io.trajectories import read_kitti
from saunet.registry import datamodules

_SIZES = {(607.19, 185.22): (376, 1241), (609.56, 172.85): (375, 1242), (601.89, 183.11): (370, 1226)}
"""Principal point in the benchmark's calibration files -> (height, width) of its images."""
CAMERAS = {"gray_left": (0, "l"), "gray_right": (1, "r"), "color_left": (2, "l"), "color_right": (3, "r")}
"""Camera name -> its number on disk and its letter in names."""


class OdometrySequence(Drive):
    """One camera of one sequence; gray cameras give three equal channels."""

    camera_height = CAMERA_HEIGHT

    def __init__(self, root: Path, sequence: str, camera: str = "color_left") -> None:
        number, side = CAMERAS[one_of("camera", camera, CAMERAS)]
        self._given = (root, sequence, camera)
        folder = root / "sequences" / sequence
        if not folder.is_dir():
            there = [entry.name for entry in folder.parent.glob("*") if entry.is_dir()]
            listed = ", ".join(sorted(there)) or "none"
            raise DataError(f"no sequence '{sequence}' at {folder.parent.absolute()}; sequences there: {listed}")
        self._name = f"odometry/{sequence} {side}"
        self._images = folder / f"image_{number}"
        self._files = frame_files(self._images)
        if not self._files:
            cameras = ", ".join(name for name, (n, _) in CAMERAS.items() if (folder / f"image_{n}").is_dir()) or "none"
            raise DataError(f"{self._images} holds no images; cameras of sequence '{sequence}' there: {cameras}")
        self._indices = sorted(self._files)
        key, path = f"P{number}", folder / "calib.txt"
        matrices = read_matrices(path, {key: (3, 4)})
        if key not in matrices:
            raise DataError(f"{path} lacks {key}; expected a line '{key}: ' with 12 numbers")
        K = matrices[key][:, :3]
        _, self._size = common_size([self.path(index) for index in self._indices])
        native = next((each for center, each in _SIZES.items() if np.abs(K[:2, 2] - center).max() < 0.05), self._size)
        self._K = scaled(zero_based(K), native, self._size, self._images, path)
        check_intrinsics(K, *native, f"{path}: {key}")
        # P = K [I | t] maps points of camera 0, so t is the position of camera 0 seen from this camera
        self._T_cam_cam0 = np.eye(4)
        self._T_cam_cam0[:3, 3] = np.linalg.solve(K, matrices[key][:, 3])
        poses = root / "poses" / f"{sequence}.txt"
        self._poses = read_kitti(poses) if poses.is_file() else np.empty((0, 4, 4))
        for line, T_world_cam in enumerate(self._poses, 1):
            check_rotation(T_world_cam[:3, :3], f"{poses}, line {line}")
        self._times = read_times(folder / "times.txt")

    @property
    def name(self) -> str:
        return self._name

    @property
    def origin(self) -> str:
        return self._given[2]  # whose name says only left or right

    @property
    def frame_size(self) -> tuple[int, int]:
        return self._size

    @property
    def indices(self) -> Sequence[int]:
        return self._indices

    def path(self, index: int) -> Path:
        return self._images / self._files[index]

    def image(self, index: int) -> NDArray[np.uint8]:
        return read_image(self.path(index))

    def intrinsics(self, index: int) -> NDArray[np.float64]:
        return self._K.copy()

    def time(self, index: int) -> float | None:
        return float(self._times[index]) if 0 <= index < len(self._times) else None

    def pose(self, index: int) -> NDArray[np.float64] | None:
        if not 0 <= index < len(self._poses):
            return None
        pose: NDArray[np.float64] = self._poses[index] @ np.linalg.inv(self._T_cam_cam0)
        return pose

    def stereo(self) -> OdometrySequence:
        return self._stereo

    @functools.cached_property
    def _stereo(self) -> OdometrySequence:
        root, sequence, camera = self._given
        other = camera.replace("left", "right") if "left" in camera else camera.replace("right", "left")
        return OdometrySequence(root, sequence, other)

    @functools.cached_property
    def T_stereo_cam(self) -> NDArray[np.float64]:  # noqa: N802 (frames in names)
        T: NDArray[np.float64] = self._stereo._T_cam_cam0 @ np.linalg.inv(self._T_cam_cam0)
        return T


def find_root(root: str | Path) -> Path:
    """Return the folder that holds ``sequences``: the one given, or ``dataset`` or ``odometry`` in it."""
    folder = Path(root).expanduser()
    for candidate in (folder, folder / "dataset", folder / "odometry", folder.parent):
        if (candidate / "sequences").is_dir():
            return candidate
    raise DataError(f"no folder 'sequences' at {folder.absolute()}; set data.root to the KITTI odometry data")


@datamodules.register("kitti_odometry")
class KittiOdometryDataModule(DepthDataModule):
    """KITTI odometry sequences with true camera motion: color or gray, standard or chosen sequences.

    Args:
        root: Folder that holds ``sequences`` and ``poses``.
        train_sequences: Sequences to train on.
        test_sequences: Sequences to test and predict.
        val_share: Fraction of each training sequence, at its end, to validate on.
        camera: ``color_left``, ``color_right``, ``gray_left`` or ``gray_right``.
        **loading: Loader settings, as in `LoadOptions`.

    Raises:
        ConfigError: if a parameter is out of range or a choice is unknown.
    """

    protocol = "campus"
    ground_truth = "none"
    camera_height = CAMERA_HEIGHT

    root: str

    def __init__(
        self,
        *,
        root: str = "data/kitti_odometry",
        train_sequences: Sequence[str] = ("00", "01", "02", "03", "04", "05", "06", "07", "08"),
        test_sequences: Sequence[str] = ("09", "10"),
        val_share: float = 0.05,
        camera: Literal["color_left", "color_right", "gray_left", "gray_right"] = "color_left",
        with_pose: bool = False,
        stereo: bool = False,
        cache: str | None = None,
        **loading: Unpack[Loading],
    ) -> None:
        super().__init__(with_pose=with_pose, stereo=stereo, cache=cache, **loading)
        self.root = root
        self.train_sequences, self.test_sequences = tuple(train_sequences), tuple(test_sequences)
        self.val_share = in_range("val_share", val_share, 0.0, 0.9)
        self.camera = one_of("camera", camera, CAMERAS)

    def select(self, split: str) -> Sequence[Selection]:
        root, training = find_root(self.root), split in ("train", "val")
        selections = []
        for name in self.train_sequences if training else self.test_sequences:
            drive = OdometrySequence(root, name, self.camera)
            frames: Sequence[int] = drive.indices
            left_out = {}
            if training:
                listed = [Frame(name, index, "l") for index in frames]
                train, val = hold_out_tails(listed, self.val_share, gap=reach(self.offsets))
                if split == "train":
                    left_out = {BETWEEN: len(frames) - len(train) - len(val)}
                frames = [frame.number for frame in (train if split == "train" else val)]
                if not frames:
                    continue
            selection = Selection(drive, frames, left_out)
            posed = self.with_pose and self.has_neighbors(split)
            selections.append(with_poses(selection, self.offsets) if posed else selection)
        return selections
