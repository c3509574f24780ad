"""KITTI's calibration files: true intrinsics of each camera and date, and where the laser scanner sits.

The files count pixels from one, which is why the field's LiDAR maps lie one pixel up and left of u and v. Everywhere
else integer coordinates are pixel centers counted from zero, so the principal point of `zero_based` is one pixel less
than the number in the file.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from saunet.data.checks import check_intrinsics, check_rotation
from saunet.errors import DataError

Array = NDArray[np.float64]
_CAMERA_KEYS = {
    **{f"P_rect_{camera:02d}": (3, 4) for camera in range(4)},
    **{f"S_rect_{camera:02d}": (2,) for camera in range(4)},
    "R_rect_00": (3, 3),
}
_LIDAR_KEYS = {"R": (3, 3), "T": (3,)}


def read_matrices(path: Path, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Array]:
    """Read the matrices of a file of ``key: numbers`` lines."""
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except FileNotFoundError as reason:
        raise DataError(
            f"no calibration at {path}; KITTI's calibration files belong into the folder of the date"
        ) from reason
    except OSError as reason:
        raise DataError(f"cannot read calibration {path}: {reason.strerror or reason}") from reason
    found: dict[str, Array] = {}
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        key, colon, text = line.partition(":")
        if not colon:
            raise DataError(f"{path}, line {number}: expected 'key: numbers', got '{line.strip()[:60]}'")
        if key.strip() in shapes:
            where = f"{path}, line {number} ({key.strip()})"
            if key.strip() in found:
                raise DataError(f"{where}: this key is given twice; delete the wrong line")
            found[key.strip()] = _numbers(text, shapes[key.strip()], where)
            if shapes[key.strip()] == (3, 3):
                check_rotation(found[key.strip()], where)
    return found


def _numbers(text: str, shape: tuple[int, ...], where: str) -> Array:
    words, count = text.split(), math.prod(shape)
    if len(words) != count:
        raise DataError(f"{where}: expected {count} numbers, got {len(words)}")
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        wrong = next(word for word in words if not _is_number(word))
        raise DataError(f"{where}: expected {count} numbers, got '{wrong[:40]}' among them") from None
    if not np.isfinite(values).all():
        raise DataError(f"{where}: expected {count} finite numbers, got {text.strip()[:60]}")
    return values.reshape(shape)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


@dataclass(frozen=True, slots=True)
class KittiCalibration:
    """Calibration of one day of KITTI raw recordings."""

    path: Path
    """The ``calib_cam_to_cam.txt`` it comes from."""
    projections: Mapping[int, Array]
    """P_rect of each camera as printed, 3 x 4: rectified camera 0 to homogeneous pixels counted from one."""
    sizes: Mapping[int, tuple[int, int]]
    """(height, width) of the rectified images of each camera."""
    rectification: Array
    """R_rect_00, 3 x 3."""
    T_cam_velo: Array | None
    """Laser scanner to unrectified camera 0, 4 x 4; None without ``calib_velo_to_cam.txt``."""

    def T_cam_cam(self, to: int, source: int) -> Array:  # noqa: N802 (frames in names)
        """Return the motion between rectified cameras, 4 x 4, meters: maps points of ``source`` to points of ``to``."""
        T = np.eye(4)
        for camera, sign in ((to, 1), (source, -1)):
            self.intrinsics(camera)  # P = K [I | t] is solved for t: K must be one
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
    """Return K for pixels counted from zero, given one for pixels counted from one."""
    moved = K.copy()
    moved[:2, 2] -= 1
    return moved


def read_calibration(folder: Path) -> KittiCalibration:
    """Read the calibration of a date."""
    path = folder / "calib_cam_to_cam.txt"
    cameras = read_matrices(path, _CAMERA_KEYS)
    if "R_rect_00" not in cameras or not any(key.startswith("P_rect") for key in cameras):
        missing = "R_rect_00" if "R_rect_00" not in cameras else "P_rect_00 to P_rect_03"
        raise DataError(f"{path} lacks {missing}; expected KITTI's calib_cam_to_cam.txt")
    projections = {camera: cameras[f"P_rect_{camera:02d}"] for camera in range(4) if f"P_rect_{camera:02d}" in cameras}
    sizes = {}
    for camera in range(4):
        if f"S_rect_{camera:02d}" in cameras:
            width, height = cameras[f"S_rect_{camera:02d}"]
            if min(width, height) < 2:
                raise DataError(
                    f"{path}: S_rect_{camera:02d} is {width:g} {height:g}; expected width and height in pixels"
                )
            sizes[camera] = (int(height), int(width))
    return KittiCalibration(path, projections, sizes, cameras["R_rect_00"], _read_scanner(folder))


def _read_scanner(folder: Path) -> Array | None:
    path = folder / "calib_velo_to_cam.txt"
    if not path.exists():
        return None
    scanner = read_matrices(path, _LIDAR_KEYS)
    for key, shape in _LIDAR_KEYS.items():
        if key not in scanner:
            raise DataError(f"{path} lacks {key}; expected a line '{key}: ' with {math.prod(shape)} numbers")
    T_cam_velo = np.eye(4)
    T_cam_velo[:3, :3], T_cam_velo[:3, 3] = scanner["R"], scanner["T"]
    return T_cam_velo
