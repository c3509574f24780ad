"""Sequences of the KITTI odometry benchmark, with calibration and true poses."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from saunet.data.checks import check_intrinsics, check_rotation, common_size
from saunet.data.drive import Drive
from saunet.data.kitti.calibration import read_matrices, zero_based
from saunet.data.kitti.raw import CAMERA_HEIGHT, frame_files
from saunet.errors import DataError, one_of
from saunet.geometry.camera import scale_intrinsics
from saunet.io.images import read_image
from saunet.io.trajectories import read_kitti

_SIZES = {(607.19, 185.22): (376, 1241), (609.56, 172.85): (375, 1242), (601.89, 183.11): (370, 1226)}
"""Principal point in the benchmark's calibration files -> (height, width) of its images."""

CAMERAS = {"gray_left": (0, "l"), "gray_right": (1, "r"), "color_left": (2, "l"), "color_right": (3, "r")}
"""Camera name -> its number on disk and its letter in names."""


class OdometrySequence(Drive):
    """One camera of one sequence."""

    camera_height = CAMERA_HEIGHT
    """Meters from the road to the camera."""

    def __init__(self, root: Path, sequence: str, camera: str = "color_left") -> None:
        number, side = CAMERAS[one_of("camera", camera, CAMERAS)]
        self._given = (root, sequence, camera)
        folder = root / "sequences" / sequence
        if not folder.is_dir():
            there = ", ".join(sequences(root)) or "none"
            raise DataError(f"no sequence '{sequence}' at {folder.parent.absolute()}; sequences there: {there}")
        self._name = f"odometry/{sequence} {side}"
        self._images = folder / f"image_{number}"
        self._files = frame_files(self._images)
        if not self._files:
            cameras = ", ".join(name for name, (n, _) in CAMERAS.items() if (folder / f"image_{n}").is_dir()) or "none"
            raise DataError(f"{self._images} holds no images; cameras of sequence '{sequence}' there: {cameras}")
        self._indices = sorted(self._files)
        key = f"P{number}"
        matrices = read_matrices(folder / "calib.txt", {key: (3, 4)})
        if key not in matrices:
            raise DataError(f"{folder / 'calib.txt'} lacks {key}; expected a line '{key}: ' with 12 numbers")
        self._K = matrices[key][:, :3]
        _, self._size = common_size([self.path(index) for index in self._indices])
        self._native = _native_size(self._K, self._size)
        if abs(self._size[0] / self._native[0] * self._native[1] / self._size[1] - 1) > 0.02:
            raise DataError(
                f"{self._images} has images of {self._size[0]}x{self._size[1]} (height x width) but "
                f"{folder / 'calib.txt'} is for {self._native[0]}x{self._native[1]}; use the original images or ones "
                "scaled as a whole"
            )
        check_intrinsics(self._K, *self._native, f"{folder / 'calib.txt'}: {key}")
        # P = K [I | t] maps points of camera 0, so t is where camera 0 lies seen from this camera
        self._T_cam_cam0 = np.eye(4)
        self._T_cam_cam0[:3, 3] = np.linalg.solve(self._K, matrices[key][:, 3])
        poses = root / "poses" / f"{sequence}.txt"
        self._poses = read_kitti(poses) if poses.is_file() else None
        for number, T_world_cam in enumerate(() if self._poses is None else self._poses, 1):
            check_rotation(T_world_cam[:3, :3], f"{poses}, line {number}")
        self._times = _read_times(folder / "times.txt")

    @property
    def name(self) -> str:
        return self._name

    @property
    def origin(self) -> str:
        return self._given[2]  # of which the name says only left or right

    @property
    def frame_size(self) -> tuple[int, int]:
        return self._size

    @property
    def indices(self) -> Sequence[int]:
        return self._indices

    def path(self, index: int) -> Path:
        """Return the file of a frame."""
        return self._images / self._files[index]

    def image(self, index: int) -> NDArray[np.uint8]:
        """Return the frame, h x w x 3, RGB; gray cameras give three equal channels."""
        return read_image(self.path(index))

    def intrinsics(self, index: int) -> NDArray[np.float64]:
        """Return K of this camera, 3 x 3, in pixels counted from zero."""
        K = torch.from_numpy(zero_based(self._K))
        return scale_intrinsics(K, self._size[1] / self._native[1], self._size[0] / self._native[0]).numpy()

    def time(self, index: int) -> float | None:
        """Return the seconds at which a frame was taken, by ``times.txt``; None where that is missing or shorter."""
        return float(self._times[index]) if 0 <= index < len(self._times) else None

    def pose(self, index: int) -> NDArray[np.float64] | None:
        """Return T_world_cam of this camera, 4 x 4, meters; None where the file of poses is missing or shorter."""
        if self._poses is None or not 0 <= index < len(self._poses):
            return None
        pose: NDArray[np.float64] = self._poses[index] @ np.linalg.inv(self._T_cam_cam0)
        return pose

    def stereo(self) -> OdometrySequence:
        """Return the other camera's recording of this sequence, of the same color."""
        return self._stereo

    @functools.cached_property
    def _stereo(self) -> OdometrySequence:
        root, sequence, camera = self._given
        other = camera.replace("left", "right") if "left" in camera else camera.replace("right", "left")
        return OdometrySequence(root, sequence, other)

    @functools.cached_property
    def T_stereo_cam(self) -> NDArray[np.float64]:  # noqa: N802 (frames in names)
        """By the sequence's calibration."""
        T: NDArray[np.float64] = self._stereo._T_cam_cam0 @ np.linalg.inv(self._T_cam_cam0)
        return T


def find_root(root: str | Path) -> Path:
    """Return the folder that holds ``sequences``: the one given, or ``dataset`` or ``odometry`` in it."""
    folder = Path(root).expanduser()
    for candidate in (folder, folder / "dataset", folder / "odometry", folder.parent):
        if (candidate / "sequences").is_dir():
            return candidate
    raise DataError(f"no folder 'sequences' at {folder.absolute()}; set data.root to the KITTI odometry data")


def sequences(root: Path) -> list[str]:
    """Return the names of the sequences on disk, sorted."""
    folder = root / "sequences"
    return sorted(entry.name for entry in folder.iterdir() if entry.is_dir()) if folder.is_dir() else []


def _native_size(K: NDArray[np.float64], size: tuple[int, int]) -> tuple[int, int]:
    """Return the (height, width) that K belongs to: the benchmark's own, where it is its K, else that of the images."""
    for (cx, cy), native in _SIZES.items():
        if abs(K[0, 2] - cx) < 0.05 and abs(K[1, 2] - cy) < 0.05:
            return native
    return size


def _read_times(path: Path) -> NDArray[np.float64]:
    if not path.is_file():
        return np.empty(0)
    words = path.read_text(encoding="utf-8", errors="replace").split()
    times = np.empty(len(words))
    for number, word in enumerate(words):
        try:
            times[number] = float(word)
        except ValueError:
            times[number] = np.nan
        if not np.isfinite(times[number]):
            raise DataError(
                f"{path}, line {number + 1}: expected seconds, got the non-numeric value '{word[:40]}'; "
                "copy the file again"
            )
    return times
