"""KITTI's files: calibration, laser scans, OXTS records and time stamps.

The calibration counts pixels from one, so the field's LiDAR maps lie one pixel up and left of u and v. Everywhere else,
integer coordinates are pixel centers counted from zero; `zero_based` converts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from saunet.data.checks import check_intrinsics, check_rotation
from saunet.data.lidar import scatter
from saunet.errors import DataError, one_of

Array = NDArray[np.float64]

_CAMERA_KEYS: dict[str, tuple[int, ...]] = {"R_rect_00": (3, 3)}
_CAMERA_KEYS |= {f"P_rect_{camera:02d}": (3, 4) for camera in range(4)}
_CAMERA_KEYS |= {f"S_rect_{camera:02d}": (2,) for camera in range(4)}
_LIDAR_KEYS = {"R": (3, 3), "T": (3,)}


def read_matrices(path: Path, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Array]:
    """Read the lines ``KEY: numbers`` of a calibration file as matrices of the requested shapes."""
    try:
        lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    except FileNotFoundError as reason:
        raise DataError(f"no calibration at {path}; copy KITTI's calibration, a separate download, there") from reason
    except OSError as reason:
        raise DataError(f"cannot read calibration {path}: {reason.strerror or reason}") from reason
    found: dict[str, Array] = {}
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        key, colon, text = line.partition(":")
        key = key.strip()
        if not colon:
            raise DataError(f"{path}, line {number}: expected 'key: numbers', got '{line.strip()[:60]}'")
        if key in shapes:
            where = f"{path}, line {number} ({key})"
            if key in found:
                raise DataError(f"{where}: this key appears twice; delete the wrong line")
            found[key] = _numbers(text, shapes[key], where)
            if shapes[key] == (3, 3):
                check_rotation(found[key], where)
    return found


def _numbers(text: str, shape: tuple[int, ...], where: str) -> Array:
    words, count = text.split(), math.prod(shape)
    if len(words) != count:
        raise DataError(f"{where}: expected {count} numbers, got {len(words)}")
    values = [_number(word) for word in words]
    for word, value in zip(words, values, strict=True):
        if not math.isfinite(value):
            raise DataError(f"{where}: expected {count} finite numbers, got '{word[:40]}' among them")
    return np.array(values).reshape(shape)


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return math.nan


@dataclass(frozen=True, slots=True)
class KittiCalibration:
    """Calibration of one day of KITTI raw recordings."""

    path: Path  # the ``calib_cam_to_cam.txt`` it comes from
    projections: Mapping[int, Array]
    """P_rect of each camera as printed, 3 x 4: rectified camera 0 to homogeneous pixels counted from one."""
    sizes: Mapping[int, tuple[int, int]]  # (height, width) of the rectified images of each camera
    rectification: Array  # R_rect_00, 3 x 3
    T_cam_velo: Array | None  # laser scanner to unrectified camera 0, 4 x 4; None without ``calib_velo_to_cam.txt``

    def T_cam_cam(self, to: int, source: int) -> Array:  # noqa: N802 (frames in names)
        """Return the motion between rectified cameras, 4 x 4, meters: maps points of ``source`` to points of ``to``."""
        T = np.eye(4)
        for camera, sign in ((to, 1), (source, -1)):
            self.intrinsics(camera)  # P = K [I | t] is solved for t, so K must be valid
            P = self.projections[camera]
            T[:3, 3] += sign * np.linalg.solve(P[:, :3], P[:, 3])
        return T

    def intrinsics(self, camera: int) -> Array:
        """Return K of a camera, 3 x 3, in pixels of its rectified image counted from zero."""
        if camera not in self.projections:
            known = ", ".join(f"{each:02d}" for each in self.projections) or "none"
            raise DataError(f"{self.path} has no P_rect_{camera:02d}; cameras in it: {known}")
        K = self.projections[camera][:, :3]
        height, width = self.sizes.get(camera, (None, None))
        check_intrinsics(K, height, width, f"{self.path}: P_rect_{camera:02d}")
        return zero_based(K)


def zero_based(K: Array) -> Array:
    """Convert K for pixels counted from one to pixels counted from zero."""
    moved = K.copy()
    moved[:2, 2] -= 1
    return moved


def read_calibration(folder: Path) -> KittiCalibration:
    """Read the calibration in the folder of a recording date."""
    path = folder / "calib_cam_to_cam.txt"
    found = read_matrices(path, _CAMERA_KEYS)
    projections = {camera: found[key] for camera in range(4) if (key := f"P_rect_{camera:02d}") in found}
    if "R_rect_00" not in found or not projections:
        missing = "R_rect_00" if "R_rect_00" not in found else "P_rect_00 to P_rect_03"
        raise DataError(f"{path} lacks {missing}; expected KITTI's calib_cam_to_cam.txt")
    sizes = {}
    for camera in range(4):
        if (key := f"S_rect_{camera:02d}") in found:
            width, height = found[key]
            if min(width, height) < 2:
                raise DataError(f"{path}: {key} is {width:g} {height:g}; expected width and height in pixels")
            sizes[camera] = (int(height), int(width))
    return KittiCalibration(path, projections, sizes, found["R_rect_00"], _read_scanner(folder))


def _read_scanner(folder: Path) -> Array | None:
    path = folder / "calib_velo_to_cam.txt"
    if not path.exists():
        return None
    found = read_matrices(path, _LIDAR_KEYS)
    for key, shape in _LIDAR_KEYS.items():
        if key not in found:
            raise DataError(f"{path} lacks {key}; expected a line '{key}: ' with {math.prod(shape)} numbers")
    T_cam_velo = np.eye(4)
    T_cam_velo[:3, :3], T_cam_velo[:3, 3] = found["R"], found["T"]
    return T_cam_velo


def lidar_depth(
    points: NDArray[np.floating],
    projection: Array,
    rectification: Array,
    T_cam_velo: Array,
    size: tuple[int, int],
    kind: Literal["camera_z", "lidar_x"] = "camera_z",
) -> NDArray[np.float32]:
    """Project a scan into a camera as the Eigen evaluation does, h x w; the nearest of several points in a pixel wins.

    ``camera_z`` is depth along the camera's axis, ``lidar_x`` the scanner's own x (the classic numbers). Points behind
    the scanner (x < 0) or the camera (z <= 0) are dropped. The calibration counts pixels from one, so a point lands on
    column round(u) - 1 and row round(v) - 1.
    """
    one_of("depth kind", kind, ("camera_z", "lidar_x"))
    ahead = points[points[:, 0] >= 0].astype(np.float64)
    rectify = np.eye(4)
    rectify[:3, :3] = rectification
    P_pixel_velo = projection @ rectify @ T_cam_velo
    homogeneous = ahead @ P_pixel_velo[:, :3].T + P_pixel_velo[:, 3]
    visible = homogeneous[:, 2] > 0
    homogeneous, ahead = homogeneous[visible], ahead[visible]
    z = homogeneous[:, 2]
    columns, rows = np.round(homogeneous[:, :2].T / z) - 1
    return scatter(rows, columns, z if kind == "camera_z" else ahead[:, 0], size)


def oxts_speed(path: Path) -> float:
    """Return the speed in m/s of a record of KITTI's inertial unit: the length of (vf, vl, vu)."""
    try:
        words = path.read_text(encoding="utf-8-sig", errors="replace").split()
    except OSError as reason:
        raise DataError(f"cannot read {path}: {reason.strerror or reason}") from reason
    velocity = np.array([_number(word) for word in words[8:11]])
    if velocity.size != 3 or not np.isfinite(velocity).all():
        raise DataError(f"{path}: expected the 30 numbers of an OXTS record; values 9 to 11 are the speeds vf, vl, vu")
    return float(np.linalg.norm(velocity))


def read_timestamps(path: Path) -> Array | None:
    """Read the ``timestamps.txt`` of a KITTI raw camera: seconds, one per frame from frame 0; None if there is none."""
    if not path.is_file():
        return None
    try:
        lines = path.read_text(encoding="utf-8-sig", errors="replace").rstrip().split("\n")
    except OSError as reason:
        raise DataError(f"cannot read {path}: {reason.strerror or reason}") from reason
    times = np.empty(len(lines) if any(lines) else 0)
    for number in range(len(times)):
        line = lines[number].strip()
        try:
            times[number] = np.datetime64(line or "empty", "ns").astype(np.int64) / 1e9
        except ValueError:
            raise DataError(
                f"{path}, line {number + 1}: expected a time such as '2011-09-26 13:02:25.964389445', got '{line[:40]}'"
            ) from None
    return times


def read_times(path: Path) -> Array:
    """Read the ``times.txt`` of a KITTI odometry sequence: seconds, one per frame; empty if there is none."""
    if not path.is_file():
        return np.empty(0)
    words = path.read_text(encoding="utf-8-sig", errors="replace").split()
    times = np.array([_number(word) for word in words])
    for line in np.flatnonzero(~np.isfinite(times)).tolist():
        got = f"got the non-numeric value '{words[line][:40]}'"
        raise DataError(f"{path}, line {line + 1}: expected seconds, {got}; copy the file again")
    return times
