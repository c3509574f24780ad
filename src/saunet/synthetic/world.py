"""One street: the road and how the cameras move along it, what stands beside it, the light, and the cars that move.

World frame: x right, y down, z forward at the start, meters; the road surface is y = 0, so things that stand on it have
negative y. Street coordinates (along, across) follow the road's centerline.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from saunet.synthetic import objects
from saunet.synthetic.objects import Mesh, Pair, Polygons

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]

_STEP = 0.5  # meters between centerline points
_CELL = 1.0  # meters between points of the street-coordinate grid; bilinear lookup is then good to a few millimeters
_REACH = 70.0  # meters to either side that have street coordinates
_MAX_HEADING = np.radians(65.0)  # the road never turns back, so it cannot cross itself
_OUTSIDE = (0.0, 1e3, 1.0, 0.0)  # street coordinates of everything outside the grid
SLOWEST, FASTEST = 0.6, 1.2
"""Bounds of the motion along the road, meters a frame."""


class Road:
    """A centerline of bounded curvature, from ``start`` to ``end`` meters along."""

    def __init__(self, rng: np.random.Generator, start: float, end: float, curviness: float) -> None:
        self.along = np.arange(start, end + _STEP, _STEP)
        count = self.along.size
        signs, strengths = rng.choice([-1.0, 0.0, 0.0, 1.0], count // 70 + 2), rng.uniform(0.4, 1.0, count // 70 + 2)
        bends = np.repeat(signs * strengths, 70)
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
        """Return street coordinates of ground points: along, across, and cosine and sine of the heading."""
        if x.size == 0:
            return x, x, x, x
        row = 512
        padding = -x.size % row
        column = np.pad((x - self._corner[0]) / _CELL, (0, padding), mode="edge").astype(np.float32).reshape(-1, row)
        line = np.pad((z - self._corner[1]) / _CELL, (0, padding), mode="edge").astype(np.float32).reshape(-1, row)
        border = cv2.BORDER_CONSTANT
        found = cv2.remap(self._grid, column, line, cv2.INTER_LINEAR, borderMode=border, borderValue=_OUTSIDE)
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
        found = np.stack([along, across, np.cos(heading), np.sin(heading)], axis=-1)
        grid = np.where(known[..., None], found, _OUTSIDE)
        return (float(low_x), float(low_z)), grid.astype(np.float32)


def turn(heading: float) -> F64:
    cosine, sine = np.cos(heading), np.sin(heading)
    return np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])


@dataclass(frozen=True, slots=True)
class Travel:
    """Motion of the left camera relative to the road, one value a frame."""

    along: F64  # meters along the road
    wander: F64  # meters to the right of the lane's center
    yaw: F64  # radians relative to the road's heading, positive to the right
    pitch: F64  # radians, positive upwards

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


def pose(road: Road, move: Travel, frame: int, lane: float, height: float) -> F64:
    """Return T_world_cam, 4 4, of a frame on a lane, ``height`` meters above the road."""
    along, pitch = float(move.along[frame]), float(move.pitch[frame])
    x, z = road.point(along, lane + float(move.wander[frame]))
    cosine, sine = np.cos(pitch), np.sin(pitch)
    nod = np.array([[1.0, 0.0, 0.0], [0.0, cosine, -sine], [0.0, sine, cosine]])
    T_world_cam = np.eye(4)
    T_world_cam[:3, :3] = turn(road.heading_at(along) + float(move.yaw[frame])) @ nod
    T_world_cam[:3, 3] = x, -height, z
    return T_world_cam


VERSION = 1  # raised whenever a seed's pictures change, so that pictures kept on disk are not mixed
KERB_HEIGHT = 0.12  # height of the pavement and everything beyond above the road, meters
BEHIND, AHEAD = 40.0, 220.0
"""Meters of street built before the first and beyond the last camera position."""


@dataclass(frozen=True, slots=True)
class Section:
    """The road's cross-section, half of it: meters from the centerline."""

    half_width: float
    pavement: float  # width of the pavement beyond the kerb
    lane: float  # center of the driving lane
    parking: bool  # cars stand along the kerb


@dataclass(frozen=True, slots=True)
class Light:
    """A sun at infinity and the colors of sky and haze; constant over a drive, so surfaces keep their brightness."""

    sun: F64  # unit vector towards the sun, world
    ambient: float
    direct: float
    haze: float  # meters after which 63 % of the light is haze
    zenith: F64
    horizon: F64
    cloud: F64


@dataclass(frozen=True, slots=True)
class MovingCar:
    """A car that follows the road: its position along the road is ``start + speed * frame``."""

    shape: Polygons
    start: float
    speed: float  # meters per frame along the road; negative for oncoming traffic
    across: float

    def at(self, frame: int, road: Road) -> Polygons:
        along = self.start + self.speed * frame
        heading = road.heading_at(along) + (np.pi if self.speed < 0 else 0.0)
        return _placed(self.shape, road, along, self.across, heading)


class World:
    """A street generated from a seed."""

    def __init__(self, seed: int, length: float, moving_cars: int = 0, speed: float = 0.9) -> None:
        rng = np.random.default_rng([VERSION, seed])
        self.road = Road(rng, -BEHIND, length + AHEAD, rng.uniform(0.4, 1.0))
        self.section = _section(rng)
        self.light = _light(rng)
        tone = rng.uniform(0.8, 1.2)
        self.ground = {
            "asphalt": ((0.30 * tone, 0.30 * tone, 0.31 * tone), (0.42 * tone, 0.41 * tone, 0.40 * tone)),
            "kerb": ((0.56, 0.55, 0.53), (0.44, 0.43, 0.42)),
            "paving": ((0.52 * tone, 0.49 * tone, 0.46 * tone), (0.58 * tone, 0.52 * tone, 0.46 * tone)),
            "grass": ((0.27 * tone, 0.38 * tone, 0.15), (0.46, 0.44 * tone, 0.24)),
        }
        self.dashes = (rng.uniform(2.0, 4.0), rng.uniform(3.0, 7.0))
        self.crossings = tuple(float(at) for at in rng.uniform(8, length + 60, int(1 + length // 50)))
        mesh = Mesh(rng)
        cars: list[Polygons] = []
        for side in (-1, 1):
            _Side(mesh, cars, rng, self.road, self.section, side).fill()
        self.polygons = Polygons.join([mesh.polygons(), *cars])
        self.quadrics = mesh.quadrics()
        self.moving = tuple(self._moving_car(rng, number, length, speed) for number in range(moving_cars))

    def polygons_at(self, frame: int) -> Polygons:
        """Return all polygons at a frame, the moving cars last."""
        if not self.moving:
            return self.polygons
        return Polygons.join([self.polygons, *(c.at(frame, self.road) for c in self.moving)])

    def _moving_car(self, rng: np.random.Generator, number: int, length: float, speed: float) -> MovingCar:
        shape = objects.car(rng)
        if number % 2 == 0:  # ahead, in the camera's lane and a little faster, so that the camera never runs into it
            gap = 13.0 + 14.0 * (number // 2) + rng.uniform(0, 5)
            return MovingCar(shape, gap, speed * rng.uniform(1.04, 1.2), self.section.lane)
        start = rng.uniform(0.3, 1.0) * length + 25.0 * (number // 2)
        return MovingCar(shape, start + 15.0, -speed * rng.uniform(0.7, 1.2), -self.section.lane)


def _section(rng: np.random.Generator) -> Section:
    parking = bool(rng.uniform() < 0.65)
    half = rng.uniform(5.4, 6.8) if parking else rng.uniform(3.4, 6.0)
    drivable = half - 2.1 if parking else min(half, 4.4)
    return Section(half, rng.uniform(1.2, 4.0), 0.45 * drivable, parking)


def _light(rng: np.random.Generator) -> Light:
    azimuth, height = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(25, 60))
    sun = np.array([np.cos(height) * np.sin(azimuth), -np.sin(height), np.cos(height) * np.cos(azimuth)])
    overcast = rng.uniform(0, 1)
    gray = np.array([0.72, 0.74, 0.77])
    zenith = (1 - overcast) * np.array([0.32, 0.52, 0.82]) + overcast * gray
    horizon = (1 - overcast) * np.array([0.74, 0.82, 0.90]) + overcast * (gray + 0.08)
    cloud = np.array([0.95, 0.95, 0.96] if overcast < 0.6 else [0.60, 0.62, 0.66])
    return Light(sun, 0.62 + 0.18 * overcast, 0.75 - 0.5 * overcast, rng.uniform(400, 900), zenith, horizon, cloud)


def _placed(shape: Polygons, road: Road, along: float, across: float, heading: float) -> Polygons:
    x, z = road.point(along, across)
    return shape.moved(turn(heading), np.array([x, 0.0, z]))


@dataclass(frozen=True, slots=True)
class _Side:
    """One side of the street (-1 left, 1 right), filled with zones of 25 to 70 m, each of one character."""

    mesh: Mesh
    cars: list[Polygons]
    rng: np.random.Generator
    road: Road
    section: Section
    side: int

    def fill(self) -> None:
        rng, inner = self.rng, self.section.half_width
        start, end = float(self.road.along[0]), float(self.road.along[-1])
        zones = (self._town, self._suburb, self._park, self._open)
        along = start
        while along < end - 10:
            length = min(rng.uniform(25, 70), end - along)
            zones[int(rng.choice(4, p=(0.35, 0.3, 0.2, 0.15)))](along, along + length)
            if self.section.parking:
                self._park_cars(along, along + length, rng.uniform(0.0, 0.55))
            along += length
        for at in np.arange(start + rng.uniform(5, 20), end, rng.uniform(16, 32)):
            objects.lamp(self.mesh, rng, *self._at(at, inner + rng.uniform(0.4, 0.9)))
        for at in np.arange(start + 30, end, 45.0):  # something behind the first row, so that the horizon is not bare
            for _ in range(3):
                place = self._at(at + rng.uniform(-20, 20), rng.uniform(38, 66))
                objects.tree(self.mesh, rng, *place, rng.uniform(8, 16))

    def _at(self, along: float, across: float) -> Pair:
        """Return (x, z) of a point that many meters from the centerline on this side."""
        return self.road.point(along, self.side * across)

    @property
    def _edge(self) -> float:
        return self.section.half_width + self.section.pavement

    def _scattered(self, start: float, end: float, near: float, far: float) -> Pair:
        """Return (x, z) of a random point between two distances from the edge."""
        return self._at(self.rng.uniform(start, end), self._edge + self.rng.uniform(near, far))

    def _houses(self, start: float, end: float, front: float, gap: Pair, floors: tuple[int, int], length: Pair) -> None:
        rng, at = self.rng, start
        while at < end - 4:
            long, deep = min(rng.uniform(*length), max(end - at, 6.0)), rng.uniform(8, 13)
            middle = at + long / 2
            center = self._at(middle, front + rng.uniform(0, 1.5) + deep / 2)
            storeys = int(rng.integers(floors[0], floors[1] + 1))
            heading, entrance = self.road.heading_at(middle), 3 if self.side > 0 else 1
            objects.building(self.mesh, rng, center, (deep, long), heading, storeys, entrance)
            at += long + rng.uniform(*gap)

    def _town(self, start: float, end: float) -> None:
        rng = self.rng
        self._houses(start, end, self._edge + rng.uniform(0.0, 3.0), (0.0, 2.5), (2, 6), (9.0, 22.0))
        if rng.uniform() < 0.4:
            for at in np.arange(start + 4, end, rng.uniform(8, 14)):
                objects.tree(self.mesh, rng, *self._at(at, self._edge - 0.5), rng.uniform(4.5, 7))

    def _suburb(self, start: float, end: float) -> None:
        rng, setback = self.rng, self.rng.uniform(4, 12)
        self._houses(start, end, self._edge + setback, (4.0, 12.0), (1, 3), (8.0, 15.0))
        kind = ("hedge", "fence", "wall")[int(rng.integers(3))]
        at = start
        while at < end - 3:
            to = min(at + rng.uniform(6, 16), end)
            left, right = (np.array(self._at(along, self._edge + 0.6)) for along in (at, to))
            objects.barrier(self.mesh, rng, left, right, kind)
            at = to + rng.uniform(2, 6)
        for _ in range(int((end - start) / 9)):
            place = self._scattered(start, end, 1.8, setback)
            if rng.uniform() < 0.5:
                objects.bush(self.mesh, rng, *place)
            else:
                objects.tree(self.mesh, rng, *place, rng.uniform(4, 8))

    def _park(self, start: float, end: float) -> None:
        for _ in range(int((end - start) / 3.5)):
            objects.tree(self.mesh, self.rng, *self._scattered(start, end, 1.0, 26.0), self.rng.uniform(5, 13))
        for _ in range(int((end - start) / 8)):
            objects.bush(self.mesh, self.rng, *self._scattered(start, end, 0.8, 12.0))

    def _open(self, start: float, end: float) -> None:
        rng = self.rng
        self._houses(start, end, self._edge + rng.uniform(18, 35), (8.0, 25.0), (1, 4), (12.0, 30.0))
        if rng.uniform() < 0.7:
            middle = rng.uniform(start + 3, end - 3)
            objects.billboard(self.mesh, rng, *self._at(middle, self._edge + 3.5), self.road.heading_at(middle))
        for _ in range(int((end - start) / 12)):
            objects.tree(self.mesh, rng, *self._scattered(start, end, 1.5, 20.0), rng.uniform(4, 10))

    def _park_cars(self, start: float, end: float, density: float) -> None:
        rng, at = self.rng, start + 3.0
        while at < end - 3.0:
            if rng.uniform() < density:
                heading = self.road.heading_at(at) + (0.0 if self.side > 0 else np.pi) + rng.normal(0, 0.015)
                across = self.side * (self.section.half_width - 1.08 + rng.normal(0, 0.06))
                self.cars.append(_placed(objects.car(rng), self.road, at, across, heading))
            at += rng.uniform(5.4, 6.6)
