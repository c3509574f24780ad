"""Recordings written to disk in KITTI's layouts, so that everything which reads KITTI can be tried without it.

KITTI's calibration counts pixels from one: a reader projects with it and subtracts 1. The principal points written are
therefore those of the recording plus 1, and every LiDAR point is the point at a pixel's center, so that it falls back
on its pixel exactly. A rig has KITTI's four cameras, a LiDAR scanner and an inertial unit (OXTS).
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from saunet.data.drive import Drive
from saunet.errors import ConfigError, DataError, one_of

F64 = NDArray[np.float64]


def _rigid(R: F64, t: Sequence[float] | F64) -> F64:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def _euler(x: float, y: float, z: float) -> F64:
    """Rotation about x, then y, then z, radians."""
    (cx, cy, cz), (sx, sy, sz) = np.cos([x, y, z]), np.sin([x, y, z])
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return np.asarray(about_z @ about_y @ about_x)


_MAX_RANGE = 120.0  # range of the scanner, meters
_BEAMS = np.radians(np.linspace(2.0, -24.8, 64))
_AZIMUTHS = np.radians(np.arange(-60.0, 60.0, 0.18))
_SECONDS = 0.1
_BASELINE = 0.54  # meters between the cameras; used if the drive has only one
_CAMERA_2 = np.array([0.06, 0.0, 0.003])  # added to a point in camera 0's frame, gives it in camera 2's
_R_RECT_00 = _euler(0.004, -0.007, -0.0098)
_AXES = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # (x forward, y left, z up) to a camera's axes
_T_CAM0_VELO = _rigid(_euler(0.0008, -0.0145, 0.0071) @ _AXES, (-0.004, -0.076, -0.272))  # for the unrectified camera 0
_T_VELO_CAM0 = np.linalg.inv(_T_CAM0_VELO) @ _rigid(_R_RECT_00.T, np.zeros(3))  # for the rectified camera 0
_T_VELO_CAM = _T_VELO_CAM0 @ _rigid(np.eye(3), -_CAMERA_2)  # for camera 2
_T_VELO_IMU = _rigid(_euler(-0.0148, -0.002, -0.0008), (-0.81, 0.32, -0.80))
_T_CAM_IMU = np.linalg.inv(_T_VELO_CAM) @ _T_VELO_IMU
_EARTH = 6378137.0  # meters
_LATITUDE, _LONGITUDE, _ALTITUDE = 49.015, 8.4343, 116.4
_ENU_WORLD = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # a camera's axes -> east, north, up
_GRAVITY = 9.81

DATAFORMAT = (
    "lat", "lon", "alt", "roll", "pitch", "yaw", "vn", "ve", "vf", "vl", "vu", "ax", "ay", "az", "af", "al", "au",
    "wx", "wy", "wz", "wf", "wl", "wu", "pos_accuracy", "vel_accuracy",
    "navstat", "numsats", "posmode", "velmode", "orimode",
)  # fmt: skip
"""Names of the values, in KITTI's order: degrees (lat, lon), meters, radians, m/s; f forward, l left, u up."""


@dataclass(frozen=True, slots=True)
class Rig:
    """Calibration of recordings in one size."""

    K: F64  # intrinsics of all cameras, pixels counted from 0
    size: tuple[int, int]  # height and width
    baseline: float  # meters from the left to the right camera of a pair

    @staticmethod
    def of(drives: Sequence[Drive], right: Sequence[Drive] | None = None) -> Rig:
        if not drives:
            raise ConfigError("there are no drives to write; give at least one")
        if right is not None and len(right) != len(drives):
            raise ConfigError(f"{len(drives)} left and {len(right)} right recordings; give one right for each left")
        views = [*drives, *(right or [])]
        K, size = _view(views[0])
        for view in views[1:]:
            other, other_size = _view(view)
            if other_size != size or not np.allclose(other, K):
                raise ConfigError(
                    f"'{view.name}' and '{views[0].name}' differ in size or intrinsics; "
                    "write them under different dates, each with its calibration"
                )
        baseline = _BASELINE
        if right is not None:
            first = drives[0].indices[0]
            left_pose, right_pose = drives[0].pose(first), right[0].pose(first)
            if left_pose is not None and right_pose is not None:
                baseline = float((np.linalg.inv(left_pose) @ right_pose)[0, 3])
        return Rig(K, size, baseline)

    @property
    def K_one_based(self) -> F64:  # noqa: N802
        """K in pixels counted from 1, as in KITTI's files."""
        K = self.K.copy()
        K[:2, 2] += 1
        return K

    def projections(self, camera_2: F64) -> list[F64]:
        """Return P of cameras 0 to 3, 3 x 4, pixels counted from 1, for a point of camera 0 in camera 2."""
        aside = np.array([self.baseline, 0.0, 0.0])
        shifts = (np.zeros(3), -aside, camera_2, camera_2 - aside)
        return [np.asarray(self.K_one_based @ np.concatenate([np.eye(3), t[:, None]], axis=1)) for t in shifts]

    def write_calibration(self, folder: Path) -> None:
        size = np.array(self.size[::-1], np.float64)
        cameras: dict[str, F64 | float] = {"corner_dist": 0.0995}
        for camera, P in enumerate(self.projections(_CAMERA_2)):
            cameras |= {
                f"S_{camera:02d}": size,
                f"K_{camera:02d}": self.K_one_based,
                f"D_{camera:02d}": np.zeros(5),
                f"R_{camera:02d}": np.eye(3),
                f"T_{camera:02d}": _R_RECT_00.T @ np.linalg.solve(self.K_one_based, P[:, 3]),
                f"S_rect_{camera:02d}": size,
                f"R_rect_{camera:02d}": _R_RECT_00,
                f"P_rect_{camera:02d}": P,
            }
        _write_calibration(folder / "calib_cam_to_cam.txt", cameras)
        velo = {"R": _T_CAM0_VELO[:3, :3], "T": _T_CAM0_VELO[:3, 3], "delta_f": np.zeros(2), "delta_c": np.zeros(2)}
        _write_calibration(folder / "calib_velo_to_cam.txt", velo)
        _write_calibration(folder / "calib_imu_to_velo.txt", {"R": _T_VELO_IMU[:3, :3], "T": _T_VELO_IMU[:3, 3]})


def _view(drive: Drive) -> tuple[F64, tuple[int, int]]:
    first = drive.indices[0]
    height, width = drive.image(first).shape[:2]
    return np.asarray(drive.intrinsics(first), np.float64), (height, width)


def _write_calibration(path: Path, values: Mapping[str, F64 | float]) -> None:
    lines = ["calib_time: 09-Jan-2012 13:57:47"]
    lines += [f"{key}: {_numbers(value, 6)}" for key, value in values.items()]
    path.write_text("\n".join(lines) + "\n")


def records(T_world_imu: Sequence[F64], seconds: float) -> F64:
    """Return a drive's OXTS records, one row of numbers per frame."""
    poses = np.asarray(T_world_imu)
    turn = _ENU_WORLD @ poses[:, :3, :3]
    place = poses[:, :3, 3] @ _ENU_WORLD.T
    several = len(poses) > 1
    velocity = np.gradient(place, seconds, axis=0) if several else np.zeros_like(place)
    acceleration = np.gradient(velocity, seconds, axis=0) if several else np.zeros_like(place)
    roll = np.arctan2(turn[:, 2, 1], turn[:, 2, 2])
    pitch = np.arcsin(np.clip(-turn[:, 2, 0], -1, 1))
    yaw = np.arctan2(turn[:, 1, 0], turn[:, 0, 0])
    own_velocity = np.einsum("nji,nj->ni", turn, velocity)
    own_acceleration = np.einsum("nji,nj->ni", turn, acceleration + np.array([0.0, 0.0, _GRAVITY]))
    change = np.gradient(turn, seconds, axis=0) if several else np.zeros_like(turn)
    spin = np.einsum("nji,njk->nik", turn, change)
    rates = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
    scale = np.cos(np.radians(_LATITUDE))  # readers of KITTI project positions with Mercator at this scale
    longitude = _LONGITUDE + np.degrees(place[:, 0] / (scale * _EARTH))
    north = scale * _EARTH * np.log(np.tan(np.pi * (90 + _LATITUDE) / 360)) + place[:, 1]
    latitude = np.degrees(2 * np.arctan(np.exp(north / (scale * _EARTH)))) - 90
    columns = [latitude, longitude, _ALTITUDE + place[:, 2], roll, pitch, yaw, velocity[:, 1], velocity[:, 0]]
    fixed = np.tile([0.05, 0.02, 4.0, 10.0, 4.0, 4.0, 6.0], (len(poses), 1))
    moving = [own_velocity, own_acceleration, own_acceleration, rates, rates, fixed]
    return np.concatenate([np.stack(columns, axis=1), *moving], axis=1)


def write_raw(
    root: Path | str,
    drives: Sequence[Drive],
    *,
    right: Sequence[Drive] | None = None,
    date: str = "2011_09_26",
    first_number: int = 1,
    lidar: bool = True,
    motion: bool = True,
    ground_truth: bool = False,
    image_format: Literal["png", "jpg"] = "png",
) -> list[str]:
    """Write recordings as one date of KITTI's raw data: images, calibration, LiDAR scans, OXTS.

    ``drives`` are recordings of the left color camera (image_02), all of one size and calibration, ``right`` the same
    seen by the right one (image_03). ``lidar`` and ``ground_truth`` (16-bit PNG of 256 x meters) need depth, ``motion``
    (OXTS) poses. Returns the drive folders relative to ``root``, the folder of the dates. If a recording lacks what is
    asked for, or the date's folder exists or cannot be written, nothing is left behind.
    """
    one_of("image_format", image_format, ("png", "jpg"))
    rig = Rig.of(drives, right)
    names = [f"{date}/{date}_drive_{first_number + n:04d}_sync" for n in range(len(drives))]
    with _whole_folder(Path(root) / date) as folder:
        rig.write_calibration(folder)
        for number, drive in enumerate(drives):
            target = folder / Path(names[number]).name
            for camera, view in [(2, drive)] if right is None else [(2, drive), (3, right[number])]:
                name, image = f"image_{camera:02d}", partial(_image, view, image_format)
                _write_frames(target / name, view, f"%010d.{image_format}", image, stamps=True)
                if ground_truth:
                    _write_frames(target / f"proj_depth/groundtruth/{name}", view, "%010d.png", partial(_truth, view))
            if lidar:
                _write_frames(target / "velodyne_points", drive, "%010d.bin", partial(_scan, drive), stamps=True)
            if motion:
                _write_frames(target / "oxts", drive, "%010d.txt", _oxts(drive).__getitem__, stamps=True)
                (target / "oxts" / "dataformat.txt").write_text("\n".join(DATAFORMAT) + "\n")
    return names


def write_odometry(
    root: Path | str, drives: Sequence[Drive], *, right: Sequence[Drive] | None = None, first_sequence: int = 0
) -> list[str]:
    """Write recordings as KITTI's odometry data: sequences/NN (image_2, calib.txt, times.txt) and poses/NN.txt.

    The left camera is camera 0 and camera 2 at once, so that the poses, which are camera 0's, are those of the images.

    Returns the names of the sequences. ``root`` must not exist; nothing is left behind if it cannot be written.
    """
    names = [f"{first_sequence + n:02d}" for n in range(len(drives))]
    with _whole_folder(Path(root)) as folder:
        (folder / "poses").mkdir()
        for number, (name, drive) in enumerate(zip(names, drives, strict=True)):
            other = None if right is None else [right[number]]
            rig = Rig.of([drive], other)
            target = folder / "sequences" / name
            for camera, view in [(2, drive), *((3, d) for d in other or [])]:
                _write_frames(target / f"image_{camera}", view, "%06d.png", partial(_image, view, "png"))
            lines = [f"P{camera}: {_numbers(P, 12)}" for camera, P in enumerate(rig.projections(np.zeros(3)))]
            (target / "calib.txt").write_text("\n".join(lines) + "\n")
            times = [f"{_SECONDS * (i - drive.indices[0]):e}" for i in drive.indices]
            (target / "times.txt").write_text("\n".join(times) + "\n")
            from_start = np.linalg.inv(_pose(drive, drive.indices[0]))
            poses = [_numbers((from_start @ _pose(drive, i))[:3], 9) for i in drive.indices]
            (folder / "poses" / f"{name}.txt").write_text("\n".join(poses) + "\n")
    return names


@contextmanager
def _whole_folder(target: Path) -> Iterator[Path]:
    """Yield a folder beside ``target`` that becomes ``target`` when all went well and disappears otherwise."""
    if target.exists():
        raise DataError(f"{target} exists and is not overwritten; remove it or choose another folder")
    temporary: Path | None = None
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{target.name}.", suffix=".partial", dir=target.parent))
        temporary.chmod(0o755)
        yield temporary
        temporary.rename(target)
        temporary = None
    except OSError as reason:
        fix = "check the folder, its permissions and free space"
        raise DataError(f"cannot write {target}: {reason.strerror or reason}; {fix}") from reason
    finally:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)


def _scan(drive: Drive, index: int) -> bytes:
    """Sample a frame's depth like a scanner with 64 beams on the car's roof."""
    depth, image = _depth(drive, index), drive.image(index)
    elevation, azimuth = np.meshgrid(_BEAMS, _AZIMUTHS, indexing="ij")
    level = np.cos(elevation)
    beams = np.stack([level * np.cos(azimuth), -level * np.sin(azimuth), np.sin(elevation)], axis=-1).reshape(-1, 3)
    K = np.asarray(drive.intrinsics(index), np.float64)
    # The rays start at the camera, half a meter from the scanner: this changes only which points are hit.
    rays = beams @ np.linalg.inv(_T_VELO_CAM)[:3, :3].T
    rays = rays[rays[:, 2] > 0.1]
    pixels = np.rint(rays / rays[:, 2:] @ K.T)[:, :2].astype(np.int64)
    height, width = depth.shape
    inside = (pixels >= 0).all(axis=1) & (pixels < (width, height)).all(axis=1)
    u, v = np.unique(pixels[inside], axis=0).T
    z = depth[v, u].astype(np.float64)
    measured = (z > 0) & (z < _MAX_RANGE)
    u, v, z = u[measured], v[measured], z[measured]
    points = np.stack([u, v, np.ones_like(u)], axis=1) @ np.linalg.inv(K).T * z[:, None]
    points = points @ _T_VELO_CAM[:3, :3].T + _T_VELO_CAM[:3, 3]
    reflectance = image[v, u].mean(axis=1, keepdims=True) / 255
    return np.concatenate([points, reflectance], axis=1).astype(np.float32).tobytes()


def _oxts(drive: Drive) -> dict[int, bytes]:
    rows = records([_pose(drive, index) @ _T_CAM_IMU for index in drive.indices], _SECONDS)
    words = [[f"{value:.13g}" for value in row[:25]] + [str(int(value)) for value in row[25:]] for row in rows]
    return {index: f"{' '.join(each)}\n".encode() for index, each in zip(drive.indices, words, strict=True)}


def _image(drive: Drive, suffix: str, index: int) -> bytes:
    return _encoded(drive.image(index)[..., ::-1], suffix)


def _truth(drive: Drive, index: int) -> bytes:
    scaled = np.rint(_depth(drive, index) * 256.0)
    return _encoded(np.where(scaled < 2**16, scaled, 0).astype(np.uint16), "png")


def _encoded(picture: NDArray[np.uint8] | NDArray[np.uint16], suffix: str) -> bytes:
    done, data = cv2.imencode(f".{suffix}", np.ascontiguousarray(picture))
    if not done:
        raise DataError(f"cannot encode a frame as {suffix}; the picture is {picture.shape} {picture.dtype}")
    return data.tobytes()


def _write_frames(
    folder: Path, drive: Drive, pattern: str, content: Callable[[int], bytes], stamps: bool = False
) -> None:
    """Write a file per frame; with ``stamps`` into ``data``, beside the list of time stamps of KITTI's raw data."""
    place = folder / "data" if stamps else folder
    place.mkdir(parents=True)
    if stamps:
        lines = []
        for index in drive.indices:
            minutes, seconds = divmod(_SECONDS * index, 60.0)
            lines.append(f"2011-09-26 {13 + int(minutes) // 60:02d}:{int(minutes) % 60:02d}:{seconds:012.9f}")
        (folder / "timestamps.txt").write_text("\n".join(lines) + "\n")
    for index in drive.indices:
        (place / (pattern % index)).write_bytes(content(index))


def _numbers(values: F64 | float, digits: int) -> str:
    return " ".join(f"{value:.{digits}e}" for value in np.ravel(values))


def _depth(drive: Drive, index: int) -> NDArray[np.float32]:
    depth = drive.depth(index)
    if depth is None:
        raise DataError(f"frame {index} of '{drive.name}' has no depth; write it without lidar and ground_truth")
    return depth


def _pose(drive: Drive, index: int) -> F64:
    T_world_cam = drive.pose(index)
    if T_world_cam is None:
        raise DataError(f"frame {index} of '{drive.name}' has no pose; write it as raw data without motion")
    return T_world_cam
