"""Points of a laser scanner and depth maps from them, for any data set."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray

from saunet.data.loading.windows import nearest_map
from saunet.errors import DataError
from saunet.io.images import read_bytes


def read_scan(path: Path, columns: int = 4) -> Float32[ndarray, "n 3"]:
    """Return the x, y, z of a scan's points, meters, from a file with ``columns`` 32-bit numbers per point."""
    data = read_bytes(path)
    if data.size % (4 * columns):
        raise DataError(
            f"{path} has {data.size} bytes, not a multiple of {4 * columns}, the bytes per point; copy the file again"
        )
    points: Float32[ndarray, "n 3"] = data.view(np.float32).reshape(-1, columns)[:, :3]
    known = np.isfinite(points).all(axis=1)
    if not known.any():
        raise DataError(f"{path} contains only points that are not finite numbers; copy the file again")
    if not known.all():
        lost = len(points) - int(known.sum())
        warnings.warn(f"{path}: {lost} of {len(points)} points are not finite numbers and are left out", stacklevel=2)
    kept: Float32[ndarray, "n 3"] = points[known]
    return kept


def points_to_depth(
    points: Float[ndarray, "n 3"],
    K: Float[ndarray, "3 3"],
    size: tuple[int, int],
) -> Float32[ndarray, "h w"]:
    """Project points in front of a camera; the nearest of several in a pixel wins.

    Args:
        points: In the camera's frame (x right, y down, z forward), meters.
        K: Intrinsics in pixels whose centers are integers.
        size: (height, width) of the map.

    Returns:
        Depth along the camera's z, meters, 0 where no point falls.
    """
    points = np.asarray(points, np.float64)
    points = points[points[:, 2] > 0]
    columns, rows = np.round((points @ K.T)[:, :2] / points[:, 2:]).T
    return scatter(rows, columns, points[:, 2], size)


def scatter(
    rows: Float[ndarray, " n"], columns: Float[ndarray, " n"], values: Float[ndarray, " n"], size: tuple[int, int]
) -> Float32[ndarray, "h w"]:
    """Put values at whole pixels of a map of zeros, dropping those outside; the smallest in a pixel wins."""
    inside = (columns >= 0) & (columns < size[1]) & (rows >= 0) & (rows < size[0])
    return nearest_map(rows[inside].astype(np.int64), columns[inside].astype(np.int64), values[inside], size)
