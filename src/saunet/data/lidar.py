"""Depth maps from points of a laser scanner, whatever the data set."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray

from saunet.data.loading.windows import nearest_map

Array = Float[ndarray, "..."]


def points_to_depth(
    points: Float[ndarray, "n 3"],
    K: Float[ndarray, "3 3"],
    size: tuple[int, int],
    *,
    pixels: Callable[[Array], Array] | None = None,
) -> Float32[ndarray, "h w"]:
    """Project points in front of a camera; where several share a pixel the nearest stays.

    Args:
        points: In the camera's frame (x right, y down, z forward), meters.
        K: Intrinsics in pixels whose centers are integers.
        size: (height, width) of the map.
        pixels: Gives the pixels, n x 2, of points, n x 3, for a lens that is no pinhole; NaN where it shows none.

    Returns:
        Depth along the camera's z, meters, 0 where no point falls.
    """
    points = np.asarray(points, np.float64)
    points = points[points[:, 2] > 0]
    at = (points @ K.T)[:, :2] / points[:, 2:] if pixels is None else pixels(points)
    seen = np.isfinite(at).all(1)
    columns, rows = np.round(at[seen]).T
    return scatter(rows, columns, points[seen, 2], size)


def scatter(
    rows: Float[ndarray, " n"], columns: Float[ndarray, " n"], values: Float[ndarray, " n"], size: tuple[int, int]
) -> Float32[ndarray, "h w"]:
    """Put values at whole pixels of a map of zeros, without those outside; the smallest of a pixel stays."""
    inside = (columns >= 0) & (columns < size[1]) & (rows >= 0) & (rows < size[0])
    return nearest_map(rows[inside].astype(np.int64), columns[inside].astype(np.int64), values[inside], size)
