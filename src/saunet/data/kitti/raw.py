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
from numpy.typing import NDArray

from saunet.data.checks import check_intrinsics, common_size, scaled
from saunet.data.drive import Drive
from saunet.data.kitti.files import (
    KittiCalibration,
    lidar_depth,
    oxts_speed,
    read_calibration,
    read_timestamps,
)
from saunet.data.lidar import read_scan
from saunet.errors import DataError, one_of
from saunet.io.images import read_depth, read_image

DepthKind = Literal["camera_z", "lidar_x", "improved"]
DEPTH_KINDS = ("camera_z", "lidar_x", "improved")
CAMERAS = {"left": (2, "l"), "right": (3, "r")}  # camera name -> its number on disk and its letter in names
CAMERA_HEIGHT = 1.65  # meters from the road to the cameras
FRAME_SECONDS = 0.1037  # mean over KITTI's drives, whose own stamps are 0.1031 to 0.1042 s apart
PROJECTION = 1  # version of the LiDAR projection, in `KittiDrive.depth_key`; raise it when cached maps become wrong

_DATE = re.compile(r"\d{4}_\d{2}_\d{2}")
_DRIVE = re.compile(r"(\d{4}_\d{2}_\d{2})_drive_\d{4}_sync")
_FRAME = re.compile(r"(\d+)\.(png|jpg|jpeg)", re.IGNORECASE)


class KittiDrive(Drive):
    """One camera of one KITTI raw drive; ground truth has the size of the original images."""

    camera_height = CAMERA_HEIGHT

    def __init__(
        self,
        folder: Path,
        calibration: KittiCalibration,
        camera: str = "left",
        depth_kind: DepthKind = "camera_z",
        annotated: Path | None = None,
    ) -> None:
        self.number, side = CAMERAS[one_of("camera", camera, CAMERAS)]
        one_of("depth kind", depth_kind, DEPTH_KINDS)
        self.depth_kind: DepthKind = depth_kind
        self._folder, self._side, self.calibration = folder, side, calibration
        self._annotated = annotated  # the drive's folder in the archive of annotated depth maps, if that is elsewhere
        self._clock = folder / f"image_{self.number:02d}" / "timestamps.txt"
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
        return self._folder / f"image_{self.number:02d}" / "data" / self._files[index]

    def image(self, index: int) -> NDArray[np.uint8]:
        return read_image(self.path(index))

    def intrinsics(self, index: int) -> NDArray[np.float64]:
        return self._intrinsics.copy()

    @functools.cached_property
    def _intrinsics(self) -> NDArray[np.float64]:
        K = self.calibration.intrinsics(self.number)
        example, (height, width) = self._common_size
        if self.number not in self.calibration.sizes:  # otherwise it was checked against that size already
            where = f"{self.calibration.path}: P_rect_{self.number:02d} (without S_rect)"
            check_intrinsics(self.calibration.projections[self.number][:, :3], height, width, where)
        native = self.native_size
        return K if (height, width) == native else scaled(K, native, (height, width), example, self.calibration.path)

    @property
    def frame_size(self) -> tuple[int, int]:
        return self._common_size[1]

    @property
    def native_size(self) -> tuple[int, int]:
        return self.calibration.sizes.get(self.number) or self.frame_size

    @functools.cached_property
    def _common_size(self) -> tuple[Path, tuple[int, int]]:
        return common_size([self.path(index) for index in self._indices])

    def has_depth(self, index: int) -> bool:
        usable = self.depth_kind == "improved" or self.calibration.T_cam_velo is not None
        return usable and self.depth_file(index).is_file()

    def depth(self, index: int) -> NDArray[np.float32] | None:
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
        if self.depth_kind == "improved" or not self.has_depth(index):
            return None
        scan, calibration = self.depth_file(index), self.calibration
        state = scan.stat()
        facts = (PROJECTION, self.depth_kind, str(scan.absolute()), state.st_size, state.st_mtime_ns)
        digest = hashlib.sha256(f"{facts!r}{self.native_size!r}".encode())
        for matrix in (calibration.projections[self.number], calibration.rectification, calibration.T_cam_velo):
            digest.update(np.asarray(matrix, dtype=np.float64).tobytes())
        return digest.hexdigest()

    def speed(self, index: int) -> float | None:
        record = self.folder / "oxts" / "data" / f"{index:010d}.txt"
        return oxts_speed(record) if record.is_file() else None

    def distance(self, first: int, second: int) -> float | None:
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
        times = self._times
        return float(times[index]) if times is not None and 0 <= index < len(times) else None

    @property
    def fps(self) -> float:
        return super().fps or 1 / FRAME_SECONDS

    @functools.cached_property
    def _times(self) -> NDArray[np.float64] | None:
        return read_timestamps(self._clock)

    def stereo(self) -> KittiDrive:
        return self._stereo

    @functools.cached_property
    def _stereo(self) -> KittiDrive:
        other = "right" if self.number == CAMERAS["left"][0] else "left"
        return KittiDrive(self.folder, self.calibration, other, self.depth_kind, self._annotated)

    @functools.cached_property
    def T_stereo_cam(self) -> NDArray[np.float64]:  # noqa: N802 (frames in names)
        return self.calibration.T_cam_cam(self._stereo.number, self.number)

    def depth_file(self, index: int) -> Path:
        if self.depth_kind == "improved":
            home = self._annotated or self.folder
            return home / "proj_depth" / "groundtruth" / f"image_{self.number:02d}" / f"{index:010d}.png"
        return self.folder / "velodyne_points" / "data" / f"{index:010d}.bin"


class KittiRaw:
    """The KITTI raw recordings below a folder.

    ``annotated`` is the folder of the unpacked data_depth_annotated archive; by default it is looked for below the
    folder with the dates and the one above it.
    """

    def __init__(self, root: str | Path, annotated: str | Path | None = None) -> None:
        self.root = Path(root).expanduser()
        if not self.root.is_dir():
            raise DataError(f"no data root at {self.root.absolute()}; set data.root to the folder of KITTI recordings")
        self.drives = {f"{path.parent.name}/{path.name}": path for path in _find_drives(self.root)}
        if not self.drives:
            raise DataError(
                f"no KITTI drives found at {self.root.absolute()}; expected folders such as "
                "2011_09_26/2011_09_26_drive_0001_sync there, one level above, or up to two below"
            )
        self._dates = {path.parent.name: path.parent for path in self.drives.values()}
        self._calibrations: dict[str, KittiCalibration] = {}
        self._given_annotated = None if annotated is None else Path(annotated).expanduser()

    @functools.cached_property
    def annotated(self) -> dict[str, Path]:
        """Folders of annotated depth maps in the archive's own layout (``train`` and ``val``), by name of the drive."""
        given, home = self._given_annotated, next(iter(self._dates.values())).parent
        bases = (home, home.parent) if given is None else (given,)
        found = [
            path
            for base in bases
            for split in ("train", "val")
            for path in (*base.glob(f"{split}/*_sync"), *base.glob(f"*/{split}/*_sync"))
            if (path / "proj_depth").is_dir()
        ]
        if given is not None and not found:
            raise DataError(
                f"no annotated depth maps at {given.absolute()}; expected train/2011_09_26_drive_0001_sync/proj_depth "
                "there or one level below, as data_depth_annotated.zip unpacks"
            )
        return {path.name: path for path in reversed(found)}

    def drive(self, name: str, camera: str = "left", depth_kind: DepthKind = "camera_z") -> KittiDrive:
        """Return a drive by its name ``<date>/<drive>``; it has no frames if it is not on disk."""
        date, annotated = name.partition("/")[0], None
        folder = self.drives.get(name, self._dates.get(date, self.root / date) / name.rpartition("/")[2])
        if depth_kind == "improved" and not (folder / "proj_depth").is_dir():
            annotated = self.annotated.get(folder.name)
        if date not in self._dates:
            return KittiDrive(folder, KittiCalibration(Path(), {}, {}, np.eye(3), None), camera, depth_kind)
        if date not in self._calibrations:
            self._calibrations[date] = read_calibration(self._dates[date])
        return KittiDrive(folder, self._calibrations[date], camera, depth_kind, annotated)


@functools.cache
def _say_clock_is_missing(path: Path) -> None:
    warnings.warn(f"{path} is missing, so frames are taken to be {FRAME_SECONDS} s apart, KITTI's mean", stacklevel=3)


def _find_drives(root: Path) -> list[Path]:
    root = root.absolute()
    if _DRIVE.fullmatch(root.name):
        return [root]
    dates = [root] if _DATE.fullmatch(root.name) else _find_dates(root, depth=3)
    return [drive for date in dates for drive in _folders(date) if _DRIVE.fullmatch(drive.name)]


def _find_dates(folder: Path, depth: int) -> list[Path]:
    found = []
    for entry in _folders(folder):
        if _DATE.fullmatch(entry.name):
            found.append(entry)
        elif depth > 1 and not entry.name.startswith("."):
            found += _find_dates(entry, depth - 1)
    return found


def _folders(folder: Path) -> list[Path]:
    try:
        with os.scandir(folder) as entries:
            return [Path(path) for path in sorted(entry.path for entry in entries if entry.is_dir())]
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
