"""KITTI-360: nine sequences with poses, two perspective and two fisheye cameras, a laser scanner.

Pixels of its perspective cameras are counted from 0, as in its own scripts (those of KITTI raw from 1).
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Unpack

from saunet.data.drive import Drive, LensModel
from saunet.data.kitti.files import read_matrices, read_timestamps
from saunet.data.kitti.raw import frame_files
from saunet.data.lidar import read_scan
from saunet.data.loading.options import Loading
from saunet.data.sets.base import FilesDataModule, Listing, ScannedDrive, chosen, find_root, those_present
from saunet.data.sets.files import read_rows
from saunet.data.video.camera import Lens, read_camera
from saunet.errors import DataError
from saunet.io.images import read_image
from saunet.registry import datamodules

CAMERAS = {"perspective_left": 0, "perspective_right": 1, "fisheye_left": 2, "fisheye_right": 3}
"""Camera -> its number on disk."""
TRAIN, VAL, TEST = ("0000", "0002", "0003", "0004", "0005", "0007", "0010"), ("0006",), ("0009",)
"""The sequences with poses as SSCBench divides them."""
_MOTION = tuple(f"T[{row},{column}]" for row in range(3) for column in range(4))
"""The numbers of a line: the upper rows of a rigid motion."""

Array = NDArray[np.float64]


class Kitti360Drive(ScannedDrive):
    """One camera of one sequence; fisheye images are undistorted, and depth is z, not the distance of points."""

    def __init__(self, root: Path, sequence: str, camera: str) -> None:
        self._given, number, home = (root, sequence, camera), CAMERAS[camera], root / "calibration"
        images, fisheye = root / "data_2d_raw" / sequence / f"image_{number:02d}", camera.startswith("fisheye")
        cam_to_car = _Matrices(home / "calib_cam_to_pose.txt", {f"image_{each:02d}": (3, 4) for each in range(4)})
        self.T_car_cam = _rigid(cam_to_car[f"image_{number:02d}"])
        self._camera = read_camera(home / f"image_{number:02d}.yaml") if fisheye else None
        if self._camera:
            path, K, size = self._camera.path, self._camera.K, self._camera.image_size
        else:
            path, (P, R, S) = home / "perspective.txt", (f"{key}_rect_{number:02d}" for key in "PRS")
            read = _Matrices(path, {P: (3, 4), R: (3, 3), S: (2,)})
            K, size = read[P][:, :3], (int(read[S][1]), int(read[S][0]))
            self.shift = np.linalg.solve(K, read[P][:, 3])  # of rectified camera 0 in this one
            self.T_car_cam[:3, :3] = self.T_car_cam[:3, :3] @ read[R].T
        T_velo_cam0 = _rigid(read_rows(home / "calib_cam_to_velo.txt", _MOTION).reshape(3, 4))
        T_car_velo = _rigid(cam_to_car["image_00"]) @ np.linalg.inv(T_velo_cam0)
        # A scan and an image with the same number belong together, so depth needs no pose.
        self._T: Array = np.asarray(np.linalg.inv(self.T_car_cam) @ T_car_velo, np.float64)
        poses, times = root / "data_poses" / sequence / "poses.txt", read_timestamps(images / "timestamps.txt")
        rows = read_rows(poses, ("frame", *_MOTION)) if poses.is_file() else np.empty((0, 13))
        folder = images / ("data_rgb" if fisheye else "data_rect")
        files, scans = frame_files(folder), root / "data_3d_raw" / sequence / "velodyne_points" / "data"
        super().__init__(
            f"{sequence}/{camera}" if fisheye else f"{sequence} {'lr'[number]}",
            {index: folder / name for index, name in files.items()},
            K,
            path,
            size,
            times={} if times is None else dict(enumerate(times.tolist())),
            poses={int(row[0]): _rigid(row[1:].reshape(3, 4)) @ self.T_car_cam for row in rows},
            folder=root / "data_2d_raw" / sequence,
            scans={index: (scans / f"{index:010d}.bin", np.eye(4)) for index in files},
        )

    @property
    def origin(self) -> str:
        return self._given[2]

    @functools.cached_property
    def _lens(self) -> Lens | None:
        return Lens(self._camera, *self.recorded_size, what=str(self.folder)) if self._camera else None

    def image(self, index: int) -> NDArray[np.uint8]:
        image, path = read_image(self.path(index)), str(self.path(index))
        return self._lens(image, path) if self._lens else image

    @property
    def lens(self) -> LensModel | None:
        return self._lens.model if self._lens else None

    def recorded_image(self, index: int) -> NDArray[np.uint8]:
        return read_image(self.path(index))

    def intrinsics(self, index: int) -> Array:
        return self._lens.K.copy() if self._lens else super().intrinsics(index)

    @property
    def native_size(self) -> tuple[int, int]:
        return self.recorded_size if self._lens else super().native_size

    @property
    def depth_K(self) -> Array:  # noqa: N802 (matrices in names)
        return self._lens.K if self._lens else self.calibrated_K

    def points(self, scan: Path) -> NDArray[np.float32]:
        return read_scan(scan)

    def _T_cam_lidar(self, index: int) -> Array:  # noqa: N802 (frames in names)
        return self._T

    def stereo(self) -> Kitti360Drive | None:
        return None if self._camera else self._stereo

    @functools.cached_property
    def _stereo(self) -> Kitti360Drive:
        root, sequence, camera = self._given
        return Kitti360Drive(root, sequence, "perspective_right" if camera.endswith("left") else "perspective_left")

    @functools.cached_property
    def T_stereo_cam(self) -> Array:  # noqa: N802 (frames in names)
        T = np.eye(4)
        T[:3, 3] = self._stereo.shift - self.shift
        return T


@datamodules.register("kitti_360")
class Kitti360DataModule(FilesDataModule):
    """KITTI-360: perspective or undistorted fisheye video with poses for most frames, LiDAR depth as the camera's z.

    Args:
        root: Folder with ``calibration``, ``data_2d_raw``, ``data_poses`` and ``data_3d_raw``.
        train_sequences: Sequences to train on, such as ``0003`` for ``2013_05_28_drive_0003_sync``.
        val_sequences: Sequences to validate on.
        test_sequences: Sequences to test and predict.
        cameras: ``perspective_left``, ``perspective_right``, ``fisheye_left`` or ``fisheye_right``, for all splits.
        **loading: Loader settings, as in `LoadOptions`.

    Raises:
        ConfigError: if a parameter is out of range or a choice is unknown.
    """

    protocol = "kitti_360"

    def __init__(
        self,
        *,
        root: str = "data/kitti_360",
        train_sequences: Sequence[str] = TRAIN,
        val_sequences: Sequence[str] = VAL,
        test_sequences: Sequence[str] = TEST,
        cameras: Sequence[str] = ("perspective_left",),
        target_depth: bool = False,
        with_pose: bool = False,
        stereo: bool = False,
        cache: str | None = None,
        **loading: Unpack[Loading],
    ) -> None:
        super().__init__(target_depth=target_depth, with_pose=with_pose, stereo=stereo, cache=cache, **loading)
        self.root, self.cameras = root, chosen("cameras", cameras, tuple(CAMERAS))
        self.sequences = {"train": tuple(train_sequences), "val": tuple(val_sequences), "test": tuple(test_sequences)}

    def drives(self, split: str) -> Sequence[Drive]:
        root = find_root(self.root, "data_2d_raw", "the folder with calibration and data_2d_raw")
        names = self.sequences["test" if split == "predict" else split]
        folders = [root / "data_2d_raw" / f"2013_05_28_drive_{name}_sync" for name in names]
        fix = "unpack them there, or name existing ones"
        present = those_present(folders, Listing(), f"{split} sequences", fix)
        return [Kitti360Drive(root, folder.name, camera) for folder in present for camera in self.cameras]


class _Matrices:
    """Matrices of a calibration file by key; a missing one is reported when it is needed."""

    def __init__(self, path: Path, shapes: dict[str, tuple[int, ...]]) -> None:
        self._path, self._found = path, read_matrices(path, shapes)

    def __getitem__(self, key: str) -> Array:
        if key not in self._found:
            raise DataError(f"{self._path} lacks {key}; copy KITTI-360's calibration again")
        return self._found[key]


def _rigid(matrix: Array) -> Array:
    T = np.eye(4)
    T[:3] = matrix
    return T
