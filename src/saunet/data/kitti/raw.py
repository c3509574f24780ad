"""KITTI raw recordings: where they lie on disk, and each as a `Drive`."""

from __future__ import annotations

import functools
import hashlib
import os
import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from saunet.data.checks import check_intrinsics, common_size
from saunet.data.drive import Drive
from saunet.data.kitti.calibration import KittiCalibration, read_calibration
from saunet.data.kitti.lidar import lidar_depth, read_scan
from saunet.data.kitti.oxts import oxts_speed, read_timestamps
from saunet.errors import DataError, one_of
from saunet.geometry.camera import scale_intrinsics
from saunet.io.images import read_depth, read_image

DepthKind = Literal["camera_z", "lidar_x", "improved"]
DEPTH_KINDS = ("camera_z", "lidar_x", "improved")
CAMERAS = {"left": (2, "l"), "right": (3, "r")}
"""Camera name -> its number on disk and its letter in names."""
CAMERA_HEIGHT = 1.65
"""Meters from the road to the cameras."""
FRAME_SECONDS = 0.1037
"""Mean time between frames over KITTI's drives, whose own stamps are 0.1031 to 0.1042 s apart."""

PROJECTION = 1
"""Version of the LiDAR projection, part of `KittiDrive.depth_key`; raise it when cached maps become wrong."""

_DATE = re.compile(r"\d{4}_\d{2}_\d{2}")
_DRIVE = re.compile(r"(\d{4}_\d{2}_\d{2})_drive_\d{4}_sync")
_FRAME = re.compile(r"(\d+)\.(png|jpg|jpeg)", re.IGNORECASE)


class KittiDrive(Drive):
    """One camera of one KITTI raw drive."""

    camera_height = CAMERA_HEIGHT
    """Meters from the road to the camera."""

    def __init__(
        self,
        folder: Path,
        calibration: KittiCalibration,
        camera: str = "left",
        depth_kind: DepthKind = "camera_z",
    ) -> None:
        self.number, side = CAMERAS[one_of("camera", camera, CAMERAS)]
        one_of("depth kind", depth_kind, DEPTH_KINDS)
        self.depth_kind: DepthKind = depth_kind
        self._folder, self._side, self.calibration = folder, side, calibration
        self._files = frame_files(folder / f"image_{self.number:02d}" / "data")
        self._indices = sorted(self._files)

    @property
    def name(self) -> str:
        return f"{self._folder.parent.name}/{self._folder.name} {self._side}"

    @property
    def folder(self) -> Path:
        return self._folder

    @property
    def indices(self) -> Sequence[int]:
        return self._indices

    def path(self, index: int) -> Path:
        """Return the file of a frame."""
        return self.folder / f"image_{self.number:02d}" / "data" / self._files[index]

    def image(self, index: int) -> NDArray[np.uint8]:
        """Return the frame, h x w x 3, RGB."""
        return read_image(self.path(index))

    def intrinsics(self, index: int) -> NDArray[np.float64]:
        """Return K of this camera on this date, in pixels of `image`; images made smaller beforehand scale it."""
        return self._intrinsics.copy()

    @functools.cached_property
    def _intrinsics(self) -> NDArray[np.float64]:
        K = self.calibration.intrinsics(self.number)
        example, (height, width) = self._common_size
        rows, columns = self.native_size
        if self.number not in self.calibration.sizes:  # or else it was checked against that size
            where = f"{self.calibration.path}: P_rect_{self.number:02d} (without S_rect)"
            check_intrinsics(self.calibration.projections[self.number][:, :3], height, width, where)
        if (height, width) == (rows, columns):
            return K
        if abs(height / rows * columns / width - 1) > 0.02:
            raise DataError(
                f"{example} has {height}x{width} (height x width) but {self.calibration.path} is for {rows}x{columns}; "
                "use the original images or ones scaled as a whole"
            )
        return scale_intrinsics(torch.from_numpy(K), width / columns, height / rows).numpy()

    @property
    def frame_size(self) -> tuple[int, int]:
        """(height, width) of the images, which `intrinsics` belongs to."""
        return self._common_size[1]

    @property
    def native_size(self) -> tuple[int, int]:
        """(height, width) of the original images, which ground truth has too."""
        if self.number in self.calibration.sizes:
            return self.calibration.sizes[self.number]
        return self.frame_size

    @functools.cached_property
    def _common_size(self) -> tuple[Path, tuple[int, int]]:
        return common_size([self.path(index) for index in self._indices])

    def has_depth(self, index: int) -> bool:
        """Tell whether there is ground truth for a frame, without reading it."""
        return self.depth_file(index).is_file() and (
            self.depth_kind == "improved" or self.calibration.T_cam_velo is not None
        )

    def depth(self, index: int) -> NDArray[np.float32] | None:
        """Return ground truth at the original image size, meters, 0 where unknown; None where there is none."""
        if not self.has_depth(index):
            return None
        if self.depth_kind == "improved":
            return read_depth(self.depth_file(index))
        calibration = self.calibration
        assert calibration.T_cam_velo is not None
        return lidar_depth(
            read_scan(self.depth_file(index)),
            calibration.projections[self.number],
            calibration.rectification,
            calibration.T_cam_velo,
            self.native_size,
            "lidar_x" if self.depth_kind == "lidar_x" else "camera_z",
        )

    def depth_key(self, index: int) -> str | None:
        """Return a hash of scan (path, size, time of change), calibration, image size and kind of depth."""
        if self.depth_kind == "improved" or not self.has_depth(index):
            return None
        scan, calibration = self.depth_file(index), self.calibration
        state = scan.stat()
        digest = hashlib.sha256(
            repr((PROJECTION, self.depth_kind, str(scan.absolute()), state.st_size, state.st_mtime_ns)).encode()
        )
        digest.update(repr(self.native_size).encode())
        for matrix in (calibration.projections[self.number], calibration.rectification, calibration.T_cam_velo):
            digest.update(np.asarray(matrix, dtype=np.float64).tobytes())
        return digest.hexdigest()

    def speed(self, index: int) -> float | None:
        """Return the car's speed in m/s; None where there is no OXTS record."""
        record = self.folder / "oxts" / "data" / f"{index:010d}.txt"
        return oxts_speed(record) if record.is_file() else None

    def distance(self, first: int, second: int) -> float | None:
        """Return the meters traveled between two frames, by OXTS speeds and time stamps; None if a record is missing.

        Without ``timestamps.txt``, frames are taken to be `FRAME_SECONDS` apart, and a warning says so.
        """
        passed = range(min(first, second), max(first, second) + 1)
        speeds = [speed for speed in map(self.speed, passed) if speed is not None]
        if len(speeds) != len(passed):
            return None
        times = [self.time(index) for index in passed]
        if None in times:
            _say_clock_is_missing(self._clock)
            times = [FRAME_SECONDS * index for index in passed]
        steps = np.diff(np.array(times, dtype=np.float64))
        return float(steps @ (np.array(speeds[1:]) + speeds[:-1]) / 2)  # the trapezoidal rule

    def time(self, index: int) -> float | None:
        """Return when the frame was taken, by ``timestamps.txt``; None where that is missing or shorter."""
        times = self._times
        return float(times[index]) if times is not None and 0 <= index < len(times) else None

    @property
    def fps(self) -> float:
        """Frames per second by the time stamps; the mean of all drives without them."""
        return super().fps or 1 / FRAME_SECONDS

    @property
    def _clock(self) -> Path:
        return self._folder / f"image_{self.number:02d}" / "timestamps.txt"

    @functools.cached_property
    def _times(self) -> NDArray[np.float64] | None:
        return read_timestamps(self._clock)

    def stereo(self) -> KittiDrive:
        """Return the other color camera's recording; it has no frames where its images are missing."""
        return self._stereo

    @functools.cached_property
    def _stereo(self) -> KittiDrive:
        other = "right" if self.number == CAMERAS["left"][0] else "left"
        return KittiDrive(self.folder, self.calibration, other, self.depth_kind)

    @functools.cached_property
    def T_stereo_cam(self) -> NDArray[np.float64]:  # noqa: N802 (frames in names)
        """Where the other color camera is, 4 x 4, meters, by the calibration of the date."""
        return self.calibration.T_cam_cam(self._stereo.number, self.number)

    def depth_file(self, index: int) -> Path:
        """Return the file that a frame's ground truth comes from, whether or not it exists."""
        if self.depth_kind == "improved":
            return self.folder / "proj_depth" / "groundtruth" / f"image_{self.number:02d}" / f"{index:010d}.png"
        return self.folder / "velodyne_points" / "data" / f"{index:010d}.bin"


class KittiRaw:
    """The KITTI raw recordings below a folder."""

    def __init__(self, root: str | Path) -> None:
        self.root = Path(root).expanduser()
        if not self.root.is_dir():
            raise DataError(
                f"no data root at {self.root.absolute()}; set data.root to the folder of the KITTI recordings"
            )
        self.drives = {f"{path.parent.name}/{path.name}": path for path in _find_drives(self.root)}
        if not self.drives:
            raise DataError(
                f"no KITTI drives found at {self.root.absolute()}; expected folders such as "
                "2011_09_26/2011_09_26_drive_0001_sync there, one level above, or up to two below"
            )
        self._dates = {path.parent.name: path.parent for path in self.drives.values()}
        self._calibrations: dict[str, KittiCalibration] = {}

    def drive(self, name: str, camera: str = "left", depth_kind: DepthKind = "camera_z") -> KittiDrive:
        """Return a drive by its name ``<date>/<drive>``; one that is not on disk has no frames."""
        date = name.partition("/")[0]
        folder = self.drives.get(name, self._dates.get(date, self.root / date) / name.rpartition("/")[2])
        if date not in self._dates:
            return KittiDrive(folder, _NO_CALIBRATION, camera, depth_kind)
        return KittiDrive(folder, self._calibration(date), camera, depth_kind)

    def _calibration(self, date: str) -> KittiCalibration:
        if date not in self._calibrations:
            self._calibrations[date] = read_calibration(self._dates[date])
        return self._calibrations[date]


_NO_CALIBRATION = KittiCalibration(Path(), {}, {}, np.eye(3), None)


@functools.cache
def _say_clock_is_missing(path: Path) -> None:
    warnings.warn(f"{path} is missing, so frames are taken to be {FRAME_SECONDS} s apart, KITTI's mean", stacklevel=3)


def _find_drives(root: Path) -> list[Path]:
    root = root.absolute()
    if _DRIVE.fullmatch(root.name):
        return [root]
    dates = [root] if _DATE.fullmatch(root.name) else _find_dates(root, depth=3)
    return [Path(entry) for date in dates for entry in _folders(date) if _DRIVE.fullmatch(Path(entry).name)]


def _find_dates(folder: Path, depth: int) -> list[Path]:
    found = []
    for entry in _folders(folder):
        if _DATE.fullmatch(Path(entry).name):
            found.append(Path(entry))
        elif depth > 1 and not Path(entry).name.startswith("."):
            found += _find_dates(Path(entry), depth - 1)
    return found


def _folders(folder: Path) -> list[str]:
    try:
        with os.scandir(folder) as entries:
            return sorted(entry.path for entry in entries if entry.is_dir())
    except PermissionError:
        return []


def frame_files(folder: Path) -> dict[int, str]:
    """Return frame number -> file name; PNG before JPEG where a frame has both."""
    try:
        names = sorted(os.listdir(folder), reverse=True)
    except (FileNotFoundError, NotADirectoryError):
        return {}
    matches = (_FRAME.fullmatch(name) for name in names)
    ordered = sorted((match for match in matches if match), key=lambda match: match[2].lower() == "png")
    return {int(match[1]): match[0] for match in ordered}
