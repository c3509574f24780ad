"""A car's sensors as KITTI describes them: four cameras, a LiDAR scanner and an inertial unit, and where each is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from saunet.data.drive import Drive
from saunet.errors import ConfigError

F64 = NDArray[np.float64]

_BASELINE = 0.54  # meters, where only one camera is recorded
_CAMERA_2 = np.array([0.06, 0.0, 0.003])  # a point in camera 0 plus this is a point in camera 2


def _euler(x: float, y: float, z: float) -> F64:
    """Rotation about x, then y, then z, radians."""
    (cx, cy, cz), (sx, sy, sz) = np.cos([x, y, z]), np.sin([x, y, z])
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return np.asarray(about_z @ about_y @ about_x)


_R_RECT_00 = _euler(0.004, -0.007, -0.0098)
_AXES = np.array(
    [[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]
)  # x forward, y left, z up -> x right, y down, z forward
_T_CAM0_VELO = np.eye(4)  # of the unrectified camera 0
_T_CAM0_VELO[:3, :3] = _euler(0.0008, -0.0145, 0.0071) @ _AXES
_T_CAM0_VELO[:3, 3] = -0.004, -0.076, -0.272
_T_VELO_IMU = np.eye(4)
_T_VELO_IMU[:3, :3] = _euler(-0.0148, -0.002, -0.0008)
_T_VELO_IMU[:3, 3] = -0.81, 0.32, -0.80


@dataclass(frozen=True, slots=True)
class Rig:
    """Calibration of recordings in one size."""

    K: F64
    """Intrinsics of all cameras, pixels counted from 0."""
    size: tuple[int, int]
    """Height and width."""
    baseline: float
    """Meters from the left to the right camera of a pair."""

    @staticmethod
    def of(drives: Sequence[Drive], right: Sequence[Drive] | None = None) -> Rig:
        """Return the calibration that recordings share."""
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
    def T_velo_cam(self) -> F64:  # noqa: N802 (frames in names)
        """Scanner from camera 2 (rectified), 4 x 4."""
        rectified_from_cam2 = np.eye(4)
        rectified_from_cam2[:3, 3] = -_CAMERA_2
        unrectified = np.eye(4)
        unrectified[:3, :3] = _R_RECT_00.T
        return np.asarray(np.linalg.inv(_T_CAM0_VELO) @ unrectified @ rectified_from_cam2)

    @property
    def T_cam_imu(self) -> F64:  # noqa: N802
        """Camera 2 (rectified) from the inertial unit, 4 x 4."""
        return np.asarray(np.linalg.inv(self.T_velo_cam) @ _T_VELO_IMU)

    def projections(self) -> list[F64]:
        """Return P_rect of cameras 0 to 3, 3 x 4, pixels counted from 1 as in KITTI's files."""
        aside = np.array([self.baseline, 0.0, 0.0])
        return [self._projection(t) for t in (np.zeros(3), -aside, _CAMERA_2, _CAMERA_2 - aside)]

    def odometry_projections(self) -> list[F64]:
        """Return P0 to P3 of a rig whose cameras 0 and 2, and 1 and 3, are in one place."""
        aside = np.array([-self.baseline, 0.0, 0.0])
        return [self._projection(t) for t in (np.zeros(3), aside, np.zeros(3), aside)]

    def write_calibration(self, folder: Path) -> None:
        """Write calib_cam_to_cam.txt, calib_velo_to_cam.txt and calib_imu_to_velo.txt."""
        height, width = self.size
        one_based = self._one_based()
        cameras: dict[str, F64 | float] = {"corner_dist": 0.0995}
        for camera, P in enumerate(self.projections()):
            shift = np.linalg.solve(one_based, P[:, 3])
            cameras |= {
                f"S_{camera:02d}": np.array([width, height], np.float64),
                f"K_{camera:02d}": one_based,
                f"D_{camera:02d}": np.zeros(5),
                f"R_{camera:02d}": np.eye(3),
                f"T_{camera:02d}": _R_RECT_00.T @ shift,
                f"S_rect_{camera:02d}": np.array([width, height], np.float64),
                f"R_rect_{camera:02d}": _R_RECT_00,
                f"P_rect_{camera:02d}": P,
            }
        _write_calibration(folder / "calib_cam_to_cam.txt", cameras)
        velo = {"R": _T_CAM0_VELO[:3, :3], "T": _T_CAM0_VELO[:3, 3], "delta_f": np.zeros(2), "delta_c": np.zeros(2)}
        _write_calibration(folder / "calib_velo_to_cam.txt", velo)
        _write_calibration(folder / "calib_imu_to_velo.txt", {"R": _T_VELO_IMU[:3, :3], "T": _T_VELO_IMU[:3, 3]})

    def _one_based(self) -> F64:
        K = self.K.copy()
        K[:2, 2] += 1
        return K

    def _projection(self, translation: F64) -> F64:
        return np.asarray(self._one_based() @ np.concatenate([np.eye(3), translation[:, None]], axis=1))


def _view(drive: Drive) -> tuple[F64, tuple[int, int]]:
    first = drive.indices[0]
    height, width = drive.image(first).shape[:2]
    return np.asarray(drive.intrinsics(first), np.float64), (height, width)


def _write_calibration(path: Path, values: Mapping[str, F64 | float]) -> None:
    lines = ["calib_time: 09-Jan-2012 13:57:47"]
    lines += [f"{key}: " + " ".join(f"{v:.6e}" for v in np.ravel(value)) for key, value in values.items()]
    path.write_text("\n".join(lines) + "\n")
