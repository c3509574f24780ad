"""The road: a smooth curve on flat ground, and the street coordinates (along, across) of any ground point.

World frame: x right, y down, z forward at the start, meters; the road surface is y = 0, so things that stand on it have
negative y.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]

_STEP = 0.5  # meters between centerline points
_CELL = 1.0  # meters between points of the street-coordinate grid; bilinear lookup is then good to a few millimeters
_REACH = 70.0  # meters to either side that have street coordinates
_MAX_HEADING = np.radians(65.0)  # the road never turns back, so it cannot cross itself
FAR_AWAY = 1e3
"""Distance across that stands for "outside the grid"."""


class Road:
    """A centerline of bounded curvature, from ``start`` to ``end`` meters along."""

    def __init__(self, rng: np.random.Generator, start: float, end: float, curviness: float) -> None:
        self.along = np.arange(start, end + _STEP, _STEP)
        count = self.along.size
        bends = np.repeat(
            rng.choice([-1.0, 0.0, 0.0, 1.0], count // 70 + 2) * rng.uniform(0.4, 1.0, count // 70 + 2), 70
        )
        bends = gaussian_filter1d(bends[:count], 20.0) * curviness / 45.0
        heading = np.zeros(count)
        origin = int(np.searchsorted(self.along, 0.0))
        for i in range(origin, count - 1):  # steer back when the heading nears its bound
            limit = np.clip((_MAX_HEADING - np.sign(bends[i]) * heading[i]) / 0.4, -1.0, 1.0)
            heading[i + 1] = heading[i] + bends[i] * limit * _STEP
        self.heading: F64 = gaussian_filter1d(heading, 8.0)
        self.heading -= self.heading[origin]
        self.x: F64 = np.cumsum(np.sin(self.heading)) * _STEP
        self.z: F64 = np.cumsum(np.cos(self.heading)) * _STEP
        self.x -= self.x[origin]
        self.z -= self.z[origin]
        self._corner, self._grid = self._street_grid()

    def heading_at(self, along: float) -> float:
        """Return the heading in radians, 0 along z, positive to the right."""
        return float(np.interp(along, self.along, self.heading))

    def point(self, along: float, across: float) -> tuple[float, float]:
        """Return world (x, z) of a point ``across`` meters to the right of the centerline."""
        heading = self.heading_at(along)
        x, z = np.interp(along, self.along, self.x), np.interp(along, self.along, self.z)
        return float(x + np.cos(heading) * across), float(z - np.sin(heading) * across)

    def locate(self, x: F32, z: F32) -> tuple[F32, F32, F32, F32]:
        """Return street coordinates of ground points."""
        if x.size == 0:
            return x, x, x, x
        row = 512
        padding = -x.size % row
        column = np.pad((x - self._corner[0]) / _CELL, (0, padding), mode="edge").astype(np.float32).reshape(-1, row)
        line = np.pad((z - self._corner[1]) / _CELL, (0, padding), mode="edge").astype(np.float32).reshape(-1, row)
        outside = (0.0, FAR_AWAY, 1.0, 0.0)
        found = cv2.remap(
            self._grid, column, line, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=outside
        )
        along, across, cosine, sine = found.reshape(-1, 4)[: x.size].T
        return along, across, cosine, sine

    def _street_grid(self) -> tuple[tuple[float, float], F32]:
        low_x, low_z = self.x.min() - _REACH, self.z.min() - _REACH
        columns = int((self.x.max() + _REACH - low_x) / _CELL) + 1
        lines = int((self.z.max() + _REACH - low_z) / _CELL) + 1
        x, z = np.meshgrid(low_x + np.arange(columns) * _CELL, low_z + np.arange(lines) * _CELL)
        points = np.stack([x, z], axis=-1)
        tree = cKDTree(np.stack([self.x, self.z], axis=-1))
        distance, nearest = tree.query(points, distance_upper_bound=_REACH)
        nearest = np.minimum(nearest, self.along.size - 1)
        heading = self.heading[nearest]
        offset_x, offset_z = x - self.x[nearest], z - self.z[nearest]
        along = self.along[nearest] + offset_x * np.sin(heading) + offset_z * np.cos(heading)
        across = offset_x * np.cos(heading) - offset_z * np.sin(heading)
        known = np.isfinite(distance)
        grid = np.stack(
            [
                np.where(known, along, 0.0),
                np.where(known, across, FAR_AWAY),
                np.where(known, np.cos(heading), 1.0),
                np.where(known, np.sin(heading), 0.0),
            ],
            axis=-1,
        )
        return (float(low_x), float(low_z)), grid.astype(np.float32)
