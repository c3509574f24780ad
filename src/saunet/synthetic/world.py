"""One street: the road's cross-section, what stands beside it, the light, and the cars that move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from saunet.synthetic import objects
from saunet.synthetic.mesh import Color, Mesh, Polygons, Quadrics
from saunet.synthetic.road import Road

F64 = NDArray[np.float64]

VERSION = 1
"""Raised whenever a seed's pictures change, so that pictures kept on disk are not mixed."""

KERB_HEIGHT = 0.12
"""Height of the pavement and everything beyond above the road, meters."""

BEHIND = 40.0
AHEAD = 220.0
"""Meters of street built before the first and beyond the last camera position."""


@dataclass(frozen=True, slots=True)
class Section:
    """The road's cross-section, half of it: meters from the centerline."""

    half_width: float
    pavement: float
    """Width of the pavement beyond the kerb."""
    lane: float
    """Center of the driving lane."""
    parking: bool
    """Cars stand along the kerb."""


@dataclass(frozen=True, slots=True)
class Light:
    """A sun at infinity and the colors of sky and haze; constant over a drive, so surfaces keep their brightness."""

    sun: F64
    """Unit vector towards the sun, world."""
    ambient: float
    direct: float
    haze: float
    """Meters after which 63 % of the light is haze."""
    zenith: Color
    horizon: Color
    cloud: Color


@dataclass(frozen=True, slots=True)
class MovingCar:
    """A car that follows the road: its position along the road is ``start + speed * frame``."""

    shape: Polygons
    start: float
    speed: float
    """Meters a frame along the road; negative for oncoming traffic."""
    across: float

    def along(self, frame: int) -> float:
        """Return the position along the road at a frame, meters."""
        return self.start + self.speed * frame

    def at(self, frame: int, road: Road) -> Polygons:
        """Return the car where it is at a frame."""
        along = self.along(frame)
        heading = road.heading_at(along) + (np.pi if self.speed < 0 else 0.0)
        return _placed(self.shape, road, along, self.across, heading)


class World:
    """A street generated from a seed."""

    def __init__(self, seed: int, length: float, moving_cars: int = 0, speed: float = 0.9) -> None:
        rng = np.random.default_rng([VERSION, seed])
        self.road = Road(rng, -BEHIND, length + AHEAD, float(rng.uniform(0.4, 1.0)))
        self.section = _section(rng)
        self.light = _light(rng)
        tone = float(rng.uniform(0.8, 1.2))
        self.ground = {
            "asphalt": ((0.30 * tone, 0.30 * tone, 0.31 * tone), (0.42 * tone, 0.41 * tone, 0.40 * tone)),
            "kerb": ((0.56, 0.55, 0.53), (0.44, 0.43, 0.42)),
            "paving": ((0.52 * tone, 0.49 * tone, 0.46 * tone), (0.58 * tone, 0.52 * tone, 0.46 * tone)),
            "grass": ((0.27 * tone, 0.38 * tone, 0.15), (0.46, 0.44 * tone, 0.24)),
        }
        self.dashes = (float(rng.uniform(2.0, 4.0)), float(rng.uniform(3.0, 7.0)))
        self.crossings = tuple(float(at) for at in rng.uniform(8, length + 60, int(1 + length // 50)))
        mesh = Mesh(rng)
        cars: list[Polygons] = []
        for side in (-1, 1):
            _side(mesh, cars, rng, self.road, self.section, side)
        self.polygons = Polygons.join([mesh.polygons(), *cars])
        self.quadrics: Quadrics = mesh.quadrics()
        self.moving = tuple(self._moving_car(rng, number, length, speed) for number in range(moving_cars))

    def polygons_at(self, frame: int) -> Polygons:
        """Return all polygons at a frame, the moving cars last."""
        if not self.moving:
            return self.polygons
        return Polygons.join([self.polygons, *(c.at(frame, self.road) for c in self.moving)])

    def _moving_car(self, rng: np.random.Generator, number: int, length: float, speed: float) -> MovingCar:
        shape = objects.car(rng)
        if number % 2 == 0:  # ahead, in the camera's lane and a little faster, so that it is never run into
            gap = 13.0 + 14.0 * (number // 2) + float(rng.uniform(0, 5))
            return MovingCar(shape, gap, speed * float(rng.uniform(1.04, 1.2)), self.section.lane)
        start = float(rng.uniform(0.3, 1.0)) * length + 25.0 * (number // 2)
        return MovingCar(shape, start + 15.0, -speed * float(rng.uniform(0.7, 1.2)), -self.section.lane)


def _section(rng: np.random.Generator) -> Section:
    parking = bool(rng.uniform() < 0.65)
    half = float(rng.uniform(5.4, 6.8)) if parking else float(rng.uniform(3.4, 6.0))
    drivable = half - 2.1 if parking else min(half, 4.4)
    return Section(half, float(rng.uniform(1.2, 4.0)), 0.45 * drivable, parking)


def _light(rng: np.random.Generator) -> Light:
    azimuth, height = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(25, 60))
    sun = np.array([np.cos(height) * np.sin(azimuth), -np.sin(height), np.cos(height) * np.cos(azimuth)])
    overcast = float(rng.uniform(0, 1))
    gray = np.array([0.72, 0.74, 0.77])
    zenith = (1 - overcast) * np.array([0.32, 0.52, 0.82]) + overcast * gray
    horizon = (1 - overcast) * np.array([0.74, 0.82, 0.90]) + overcast * (gray + 0.08)
    return Light(
        sun,
        ambient=0.62 + 0.18 * overcast,
        direct=0.75 - 0.5 * overcast,
        haze=float(rng.uniform(400, 900)),
        zenith=(float(zenith[0]), float(zenith[1]), float(zenith[2])),
        horizon=(float(horizon[0]), float(horizon[1]), float(horizon[2])),
        cloud=(0.95, 0.95, 0.96) if overcast < 0.6 else (0.60, 0.62, 0.66),
    )


def _placed(shape: Polygons, road: Road, along: float, across: float, heading: float, up: float = 0.0) -> Polygons:
    x, z = road.point(along, across)
    cosine, sine = np.cos(heading), np.sin(heading)
    return shape.moved(np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]]), np.array([x, -up, z]))


def _side(mesh: Mesh, cars: list[Polygons], rng: np.random.Generator, road: Road, section: Section, side: int) -> None:
    """Fill one side of the street with zones of 25 to 70 m, each of one character."""
    start, end = float(road.along[0]), float(road.along[-1])
    along = start
    while along < end - 10:
        length = min(float(rng.uniform(25, 70)), end - along)
        zone = ("town", "suburb", "park", "open")[int(rng.choice(4, p=(0.35, 0.3, 0.2, 0.15)))]
        _ZONES[zone](mesh, rng, road, section, side, along, along + length)
        if section.parking:
            _park_cars(cars, rng, road, section, side, along, along + length, float(rng.uniform(0.0, 0.55)))
        along += length
    inner = section.half_width
    for at in np.arange(start + rng.uniform(5, 20), end, float(rng.uniform(16, 32))):
        x, z = road.point(float(at), side * (inner + float(rng.uniform(0.4, 0.9))))
        objects.lamp(mesh, rng, x, z)
    for at in np.arange(start + 30, end, 45.0):  # something behind the first row, so that the horizon is not bare
        for _ in range(3):
            x, z = road.point(float(at + rng.uniform(-20, 20)), side * float(rng.uniform(38, 66)))
            objects.tree(mesh, rng, x, z, float(rng.uniform(8, 16)))


def _houses(
    mesh: Mesh, rng: np.random.Generator, road: Road, side: int, start: float, end: float,
    front: float, gap: tuple[float, float], floors: tuple[int, int], length: tuple[float, float],
) -> None:  # fmt: skip
    at = start
    while at < end - 4:
        long, deep = min(float(rng.uniform(*length)), max(end - at, 6.0)), float(rng.uniform(8, 13))
        middle = at + long / 2
        center = road.point(middle, side * (front + float(rng.uniform(0, 1.5)) + deep / 2))
        storeys = int(rng.integers(floors[0], floors[1] + 1))
        objects.building(mesh, rng, center, (deep, long), road.heading_at(middle), storeys, 3 if side > 0 else 1)
        at += long + float(rng.uniform(*gap))


def _town(
    mesh: Mesh, rng: np.random.Generator, road: Road, section: Section, side: int, start: float, end: float
) -> None:
    edge = section.half_width + section.pavement
    _houses(mesh, rng, road, side, start, end, edge + float(rng.uniform(0.0, 3.0)), (0.0, 2.5), (2, 6), (9.0, 22.0))
    if rng.uniform() < 0.4:
        for at in np.arange(start + 4, end, float(rng.uniform(8, 14))):
            objects.tree(mesh, rng, *road.point(float(at), side * (edge - 0.5)), float(rng.uniform(4.5, 7)))


def _suburb(
    mesh: Mesh, rng: np.random.Generator, road: Road, section: Section, side: int, start: float, end: float
) -> None:
    edge = section.half_width + section.pavement
    setback = float(rng.uniform(4, 12))
    _houses(mesh, rng, road, side, start, end, edge + setback, (4.0, 12.0), (1, 3), (8.0, 15.0))
    kind = ("hedge", "fence", "wall")[int(rng.integers(3))]
    at = start
    while at < end - 3:
        to = min(at + float(rng.uniform(6, 16)), end)
        left, right = road.point(at, side * (edge + 0.6)), road.point(to, side * (edge + 0.6))
        objects.barrier(mesh, rng, np.array(left), np.array(right), kind)
        at = to + float(rng.uniform(2, 6))
    for _ in range(int((end - start) / 9)):
        place = road.point(float(rng.uniform(start, end)), side * (edge + float(rng.uniform(1.8, setback))))
        if rng.uniform() < 0.5:
            objects.bush(mesh, rng, *place)
        else:
            objects.tree(mesh, rng, *place, float(rng.uniform(4, 8)))


def _park(
    mesh: Mesh, rng: np.random.Generator, road: Road, section: Section, side: int, start: float, end: float
) -> None:
    edge = section.half_width + section.pavement
    for _ in range(int((end - start) / 3.5)):
        place = road.point(float(rng.uniform(start, end)), side * (edge + float(rng.uniform(1.0, 26))))
        objects.tree(mesh, rng, *place, float(rng.uniform(5, 13)))
    for _ in range(int((end - start) / 8)):
        objects.bush(
            mesh, rng, *road.point(float(rng.uniform(start, end)), side * (edge + float(rng.uniform(0.8, 12))))
        )


def _open(
    mesh: Mesh, rng: np.random.Generator, road: Road, section: Section, side: int, start: float, end: float
) -> None:
    edge = section.half_width + section.pavement
    _houses(mesh, rng, road, side, start, end, edge + float(rng.uniform(18, 35)), (8.0, 25.0), (1, 4), (12.0, 30.0))
    if rng.uniform() < 0.7:
        middle = float(rng.uniform(start + 3, end - 3))
        objects.billboard(mesh, rng, *road.point(middle, side * (edge + 3.5)), road.heading_at(middle))
    for _ in range(int((end - start) / 12)):
        place = road.point(float(rng.uniform(start, end)), side * (edge + float(rng.uniform(1.5, 20))))
        objects.tree(mesh, rng, *place, float(rng.uniform(4, 10)))


_ZONES = {"town": _town, "suburb": _suburb, "park": _park, "open": _open}


def _park_cars(
    cars: list[Polygons], rng: np.random.Generator, road: Road, section: Section, side: int,
    start: float, end: float, density: float,
) -> None:  # fmt: skip
    at = start + 3.0
    while at < end - 3.0:
        if rng.uniform() < density:
            heading = road.heading_at(at) + (0.0 if side > 0 else np.pi) + float(rng.normal(0, 0.015))
            across = side * (section.half_width - 1.08 + float(rng.normal(0, 0.06)))
            cars.append(_placed(objects.car(rng), road, at, across, heading))
        at += float(rng.uniform(5.4, 6.6))
