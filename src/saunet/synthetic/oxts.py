"""KITTI's OXTS records: position, attitude and velocity of a car's inertial unit, 30 values a frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

_EARTH = 6378137.0  # meters
_LATITUDE, _LONGITUDE, _ALTITUDE = 49.015, 8.4343, 116.4
_ENU_WORLD = np.array(
    [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]
)  # x right, y down, z forward -> east, north, up
_GRAVITY = 9.81

DATAFORMAT = (
    "lat", "lon", "alt", "roll", "pitch", "yaw", "vn", "ve", "vf", "vl", "vu", "ax", "ay", "az", "af", "al", "au",
    "wx", "wy", "wz", "wf", "wl", "wu", "pos_accuracy", "vel_accuracy",
    "navstat", "numsats", "posmode", "velmode", "orimode",
)  # fmt: skip
"""Names of the values, in KITTI's order: degrees (lat, lon), meters, radians, m/s; f forward, l left, u up."""


def records(T_world_imu: Sequence[F64], seconds: float) -> F64:
    """Return one row of `DATAFORMAT` a frame."""
    poses = np.asarray(T_world_imu)
    turn = _ENU_WORLD @ poses[:, :3, :3]
    place = poses[:, :3, 3] @ _ENU_WORLD.T
    several = len(poses) > 1
    velocity = np.gradient(place, seconds, axis=0) if several else np.zeros_like(place)
    acceleration = np.gradient(velocity, seconds, axis=0) if several else np.zeros_like(place)
    roll = np.arctan2(turn[:, 2, 1], turn[:, 2, 2])
    pitch = np.arcsin(np.clip(-turn[:, 2, 0], -1, 1))
    yaw = np.arctan2(turn[:, 1, 0], turn[:, 0, 0])
    own_velocity = np.einsum("nji,nj->ni", turn, velocity)
    own_acceleration = np.einsum("nji,nj->ni", turn, acceleration + np.array([0.0, 0.0, _GRAVITY]))
    change = np.gradient(turn, seconds, axis=0) if several else np.zeros_like(turn)
    spin = np.einsum("nji,njk->nik", turn, change)
    rates = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
    scale = np.cos(np.radians(_LATITUDE))  # of the Mercator map that readers use
    longitude = _LONGITUDE + np.degrees(place[:, 0] / (scale * _EARTH))
    north = scale * _EARTH * np.log(np.tan(np.pi * (90 + _LATITUDE) / 360)) + place[:, 1]
    latitude = np.degrees(2 * np.arctan(np.exp(north / (scale * _EARTH)))) - 90
    columns = [latitude, longitude, _ALTITUDE + place[:, 2], roll, pitch, yaw, velocity[:, 1], velocity[:, 0]]
    fixed = np.tile([0.05, 0.02, 4.0, 10.0, 4.0, 4.0, 6.0], (len(poses), 1))
    moving = [own_velocity, own_acceleration, own_acceleration, rates, rates, fixed]
    return np.concatenate([np.stack(columns, axis=1), *moving], axis=1)


def write(folder: Path, indices: Sequence[int], T_world_imu: Sequence[F64], seconds: float) -> None:
    """Write dataformat.txt and one file a frame under ``folder/data``."""
    (folder / "dataformat.txt").write_text("\n".join(DATAFORMAT) + "\n")
    for index, row in zip(indices, records(T_world_imu, seconds), strict=True):
        words = [f"{value:.13g}" for value in row[:25]] + [str(int(value)) for value in row[25:]]
        (folder / "data" / f"{index:010d}.txt").write_text(" ".join(words) + "\n")
