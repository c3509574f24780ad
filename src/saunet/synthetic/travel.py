"""How the cameras move through the street: speed, lane keeping and the nodding of a car."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from saunet.synthetic.road import Road

F64 = NDArray[np.float64]

SLOWEST, FASTEST = 0.6, 1.2
"""Bounds of the motion along the road, meters a frame."""


@dataclass(frozen=True, slots=True)
class Travel:
    """Motion of the left camera relative to the road, one value a frame."""

    along: F64
    """Meters along the road."""
    wander: F64
    """Meters to the right of the lane's center."""
    yaw: F64
    """Radians beside the road's heading, positive to the right."""
    pitch: F64
    """Radians, positive upwards."""

    @property
    def speed(self) -> float:
        """Mean speed, meters a frame."""
        return float(self.along[-1] / max(1, self.along.size - 1)) or 0.9


def travel(seed: int, frames: int) -> Travel:
    """Draw the motion of a drive of 10 frames a second."""
    rng = np.random.default_rng([3, seed])
    base = rng.uniform(0.78, 1.08)
    steps = np.clip(base + 0.10 * _smooth(rng, frames, 12.0), SLOWEST, FASTEST)
    along = np.concatenate([[0.0], np.cumsum(steps[1:])])
    wander = 0.15 * _smooth(rng, frames, 15.0)
    slope = np.gradient(wander, along) if frames > 1 else np.zeros(frames)
    yaw = np.arctan(slope) + np.radians(0.25) * _smooth(rng, frames, 4.0)
    pitch = np.radians(0.2) * _smooth(rng, frames, 1.5)
    return Travel(along, wander, yaw, pitch)


def _smooth(rng: np.random.Generator, count: int, width: float) -> F64:
    """Noise of deviation about 1 that changes over ``width`` frames."""
    noise = gaussian_filter1d(rng.standard_normal(count + 100), width, mode="wrap")[50 : 50 + count]
    return np.asarray(noise * np.sqrt(2 * np.sqrt(np.pi) * width))


def pose(road: Road, along: float, across: float, yaw: float, pitch: float, height: float) -> F64:
    """Return T_world_cam, 4 x 4, of a camera over a point of the road."""
    heading = road.heading_at(along) + yaw
    x, z = road.point(along, across)
    c, s = np.cos(heading), np.sin(heading)
    cp, sp = np.cos(pitch), np.sin(pitch)
    turn = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    nod = np.array([[1.0, 0.0, 0.0], [0.0, cp, -sp], [0.0, sp, cp]])
    T_world_cam = np.eye(4)
    T_world_cam[:3, :3] = turn @ nod
    T_world_cam[:3, 3] = x, -height, z
    return T_world_cam
