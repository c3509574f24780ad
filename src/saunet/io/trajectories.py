"""Trajectories in the formats that other tools read: KITTI's pose files, which are read too, and TUM's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from saunet.errors import DataError
from saunet.io.atomic import write_bytes


def write_kitti(path: Path, T_world_cam: Float64[ndarray, "n 4 4"]) -> None:
    """Write a trajectory in KITTI's format: per frame a line with the upper 3 x 4 of the camera-to-world matrix."""
    _write(path, T_world_cam[:, :3].reshape(-1, 12))


def write_tum(path: Path, T_world_cam: Float64[ndarray, "n 4 4"], times: Float64[ndarray, " t"]) -> None:
    """Write a trajectory as TUM does: ``time x y z qx qy qz qw`` a line."""
    if len(times) != len(T_world_cam):
        raise DataError(f"{len(T_world_cam)} poses come with {len(times)} times; give one for each")
    if not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        raise DataError(f"the times for {path} do not ascend; TUM files have the true time of each pose, in seconds")
    quaternions = Rotation.from_matrix(T_world_cam[:, :3, :3]).as_quat()
    _write(path, np.column_stack((times, T_world_cam[:, :3, 3], quaternions)))


def _write(path: Path, table: Float64[ndarray, "n k"]) -> None:
    lines = (" ".join(f"{value:.17g}" for value in row) for row in table)
    write_bytes(path, ("\n".join(lines) + "\n").encode())


def read_kitti(path: Path) -> Float64[ndarray, "n 4 4"]:
    """Read camera-to-world poses from a KITTI pose file."""
    expected = "12 finite numbers (a 3 x 4 pose, row by row)"
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"cannot read {path} as text ({error}); expected lines of {expected}") from error
    rows = []
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            row = [float(word) for word in line.split()]
        except ValueError:
            row = []
        if len(row) != 12 or not np.isfinite(row).all():
            raise DataError(f"{path}, line {number}: expected {expected}, got '{line.strip()[:60]}'")
        rows.append(row)
    if not rows:
        raise DataError(f"{path} has no pose; expected lines of {expected}; copy the file again")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = np.array(rows).reshape(-1, 3, 4)
    return poses
