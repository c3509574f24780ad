"""Depth maps from laser scans, as the Eigen evaluation of KITTI makes them."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from saunet.data.loading.resize import nearest_map
from saunet.errors import DataError, one_of
from saunet.io.images import read_bytes

LidarDepth = Literal["camera_z", "lidar_x"]
KINDS = ("camera_z", "lidar_x")


def read_scan(path: Path) -> NDArray[np.float32]:
    """Return the points of a Velodyne scan, n x 3: x forward, y left, z up, in meters."""
    data = read_bytes(path)
    if data.size % 16:
        raise DataError(f"{path} has {data.size} bytes, not a multiple of the 16 bytes of a point; copy the file again")
    points = data.view(np.float32).reshape(-1, 4)[:, :3]
    known = np.isfinite(points).all(axis=1)
    if not known.any():
        raise DataError(f"{path} contains only points that are not finite numbers; copy the file again")
    if not known.all():
        lost = len(points) - int(known.sum())
        warnings.warn(f"{path}: {lost} of {len(points)} points are not finite numbers and are left out", stacklevel=2)
    return points[known]


def lidar_depth(
    points: NDArray[np.floating],
    projection: NDArray[np.float64],
    rectification: NDArray[np.float64],
    T_cam_velo: NDArray[np.float64],
    size: tuple[int, int],
    kind: LidarDepth = "camera_z",
) -> NDArray[np.float32]:
    """Project a scan into a camera, in float64; where several points fall on one pixel the nearest stays.

    The calibration counts pixels from one, so a point lands on column round(u) - 1 and row round(v) - 1.

    Args:
        points: n x 3, scanner frame, meters. Points behind the scanner (x < 0) or the camera (z <= 0) are dropped.
        projection: P_rect of the camera, 3 x 4.
        rectification: R_rect_00, 3 x 3.
        T_cam_velo: Scanner to unrectified camera 0, 4 x 4.
        size: (height, width) of the image.
        kind: ``camera_z``: depth along the camera's axis; ``lidar_x``: the scanner's own x (the classic numbers).

    Returns:
        Depth in meters, h x w, 0 where no point falls.

    Raises:
        ConfigError: for an unknown kind.
    """
    one_of("depth kind", kind, KINDS)
    ahead = points[points[:, 0] >= 0].astype(np.float64)
    rectify = np.eye(4)
    rectify[:3, :3] = rectification
    P_pixel_velo = projection @ rectify @ T_cam_velo
    homogeneous = ahead @ P_pixel_velo[:, :3].T + P_pixel_velo[:, 3]
    z = homogeneous[:, 2]
    visible = z > 0
    homogeneous, ahead, z = homogeneous[visible], ahead[visible], z[visible]
    columns = np.round(homogeneous[:, 0] / z) - 1
    rows = np.round(homogeneous[:, 1] / z) - 1
    inside = (columns >= 0) & (columns < size[1]) & (rows >= 0) & (rows < size[0])
    values = (z if kind == "camera_z" else ahead[:, 0])[inside]
    return nearest_map(rows[inside].astype(np.int64), columns[inside].astype(np.int64), values, size)
