"""Depth maps at another size: measurements move or are sampled, never mixed (colors, which are: `saunet.io.images`)."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


def resize_depth(depth: NDArray[np.float32], height: int, width: int) -> NDArray[np.float32]:
    """Resize a depth map without mixing values.

    A sparse map (less than half of it known) moves each measurement to the pixel where it now falls, the nearest wins;
    a dense map is sampled at the new pixel centers.
    """
    if depth.shape == (height, width):
        return np.ascontiguousarray(depth, dtype=np.float32)
    rows, columns = np.nonzero(depth)
    if 2 * rows.size > depth.size:
        return np.asarray(cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST_EXACT), dtype=np.float32)
    values = depth[rows, columns]
    rows = np.minimum(((rows + 0.5) * (height / depth.shape[0])).astype(np.int64), height - 1)
    columns = np.minimum(((columns + 0.5) * (width / depth.shape[1])).astype(np.int64), width - 1)
    return nearest_map(rows, columns, values, (height, width))


def nearest_map(
    rows: NDArray[np.int64], columns: NDArray[np.int64], values: NDArray[Any], size: tuple[int, int]
) -> NDArray[np.float32]:
    """Scatter values into a map of zeros, height x width; where several fall on one pixel the smallest stays."""
    order = np.argsort(-values, kind="stable")
    out = np.zeros(size, np.float32)
    out[rows[order], columns[order]] = values[order]
    return out
