"""What the world is made of: flat convex polygons and upright ellipsoids and cylinders, each with a material."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from saunet.synthetic.materials import INDEX

F64 = NDArray[np.float64]
CORNERS = 8
"""Corners stored per polygon; polygons with fewer repeat their last one."""

Color = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Surface:
    """A material and its two colors (the second is where the material's mask is 1)."""

    material: str
    color: Color
    second: Color
    grain: float = 0.10
    """Strength of the noise that makes equal surfaces differ."""


@dataclass(frozen=True, slots=True)
class Polygons:
    """Flat convex polygons, corners clockwise as seen from outside; q of them."""

    corners: F64
    """q x 8 x 3, meters, world."""
    to_u: F64
    """q x 4: texture coordinate u = to_u[:3] . point + to_u[3], in periods."""
    to_v: F64
    """q x 4: the same downwards."""
    look: F64
    """q x 11: material, color (3), second color (3), grain, meters a period in u and v, grain offset."""

    @property
    def count(self) -> int:
        """Number of polygons."""
        return int(self.corners.shape[0])

    def moved(self, rotation: F64, translation: F64) -> Polygons:
        """Return the polygons after ``point -> rotation @ point + translation``; the texture moves along."""
        corners = self.corners @ rotation.T + translation
        axes = []
        for to in (self.to_u, self.to_v):
            turned = to[:, :3] @ rotation.T
            axes.append(np.concatenate([turned, to[:, 3:] - (turned @ translation)[:, None]], axis=1))
        return Polygons(corners, axes[0], axes[1], self.look)

    @staticmethod
    def join(parts: Sequence[Polygons]) -> Polygons:
        """Concatenate."""
        return Polygons(*(np.concatenate([getattr(p, k) for p in parts]) for k in ("corners", "to_u", "to_v", "look")))


@dataclass(frozen=True, slots=True)
class Quadrics:
    """Upright ellipsoids (height > 0) and cylinders (height = 0); k of them."""

    center: F64
    """k x 3, meters, world."""
    radius: F64
    """k: horizontal radius, meters."""
    height: F64
    """k: vertical radius of an ellipsoid, or 0 for a cylinder."""
    extent: F64
    """k x 2: lowest and highest world y that belong to the surface (y is down: top first)."""
    look: F64
    """k x 11: see `Polygons.look`."""

    @property
    def count(self) -> int:
        """Number of quadrics."""
        return int(self.center.shape[0])


def look(surface: Surface, period: tuple[float, float], offset: float) -> list[float]:
    """Return one row of `Polygons.look`."""
    return [float(INDEX[surface.material]), *surface.color, *surface.second, surface.grain, *period, offset]


class Mesh:
    """Collects surfaces; `polygons` and `quadrics` return them as arrays."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._corners: list[F64] = []
        self._to_u: list[F64] = []
        self._to_v: list[F64] = []
        self._look: list[list[float]] = []
        self._quadrics: list[list[float]] = []
        self._quadric_look: list[list[float]] = []

    def polygon(
        self,
        corners: ArrayLike,
        surface: Surface,
        period: tuple[float, float],
        fit: bool = False,
        phase: float | None = None,
    ) -> None:
        """Add a convex polygon.

        Args:
            corners: n x 3, clockwise from outside, starting top left; u runs along the first edge, v down from it.
            surface: Material and colors.
            period: Meters that one period of the material spans in u and v.
            fit: Start the picture at the first corner instead of at a random place.
            phase: Horizontal start of the picture in periods, with the vertical one at the first corner.
        """
        points = np.asarray(corners, np.float64)
        u_axis = (points[1] - points[0]) / np.linalg.norm(points[1] - points[0])
        normal = np.cross(points[1] - points[0], points[2] - points[0])
        v_axis = np.cross(normal / np.linalg.norm(normal), u_axis)
        start_u, start_v = (0.0, 0.0) if fit else self._rng.uniform(0, 1, 2)
        if phase is not None:
            start_u, start_v = phase, 0.0
        self._to_u.append(np.append(u_axis, -points[0] @ u_axis + start_u * period[0]) / period[0])
        self._to_v.append(np.append(v_axis, -points[0] @ v_axis + start_v * period[1]) / period[1])
        self._corners.append(np.concatenate([points, np.repeat(points[-1:], CORNERS - len(points), axis=0)]))
        self._look.append(look(surface, period, float(self._rng.uniform())))

    def box(
        self,
        center: tuple[float, float],
        size: tuple[float, float],
        heading: float,
        bottom: float,
        top: float,
        surface: Surface,
        period: tuple[float, float],
        roof: Surface | None = None,
    ) -> None:
        """Add an upright box: four walls, and a flat roof where ``roof`` is given."""
        outline = footprint(center, size, heading)
        for i in range(4):
            self.wall(outline[i], outline[(i + 1) % 4], bottom, top, surface, period)
        if roof is not None:
            corners = [(x, -top, z) for x, z in (outline[3], outline[2], outline[1], outline[0])]
            self.polygon(corners, roof, (4.0, 4.0))

    def wall(
        self,
        left: F64,
        right: F64,
        bottom: float,
        top: float,
        surface: Surface,
        period: tuple[float, float],
        fit: bool = False,
    ) -> None:
        """Add an upright rectangle between two ground points, seen from the side on which ``left`` is left."""
        ends = [(left, top), (right, top), (right, bottom), (left, bottom)]
        phase = float(self._rng.integers(0, 4)) / 4
        self.polygon([(p[0], -y, p[1]) for p, y in ends], surface, period, fit, None if fit else phase)

    def ellipsoid(self, center: tuple[float, float, float], radius: float, height: float, surface: Surface) -> None:
        """Add an ellipsoid of horizontal and vertical radius, meters; y points down."""
        self._quadrics.append([*center, radius, height, center[1] - height, center[1] + height])
        self._quadric_look.append(look(surface, (3.0, 3.0), float(self._rng.uniform())))

    def cylinder(self, x: float, z: float, radius: float, bottom: float, top: float, surface: Surface) -> None:
        """Add an upright cylinder without caps; meters, heights above the ground."""
        self._quadrics.append([x, 0.0, z, radius, 0.0, -top, -bottom])
        self._quadric_look.append(look(surface, (1.5, 2.5), float(self._rng.uniform())))

    def polygons(self) -> Polygons:
        """Return the polygons collected so far."""
        shapes = [(-1, CORNERS, 3), (-1, 4), (-1, 4), (-1, 11)]
        lists = [self._corners, self._to_u, self._to_v, self._look]
        return Polygons(*(np.asarray(v, np.float64).reshape(s) for v, s in zip(lists, shapes, strict=True)))

    def quadrics(self) -> Quadrics:
        """Return the ellipsoids and cylinders collected so far."""
        rows = np.asarray(self._quadrics, np.float64).reshape(-1, 7)
        looks = np.asarray(self._quadric_look, np.float64).reshape(-1, 11)
        return Quadrics(rows[:, :3], rows[:, 3], rows[:, 4], rows[:, 5:7], looks)


def footprint(center: tuple[float, float], size: tuple[float, float], heading: float) -> list[F64]:
    """Return the four ground corners (x, z) of a box; wall i has corner i on its left and corner i + 1 on its right.

    Order of the walls: rear, right, front, left.
    """
    right = np.array([np.cos(heading), -np.sin(heading)]) * size[0] / 2
    ahead = np.array([np.sin(heading), np.cos(heading)]) * size[1] / 2
    middle = np.asarray(center, np.float64)
    return [middle - right - ahead, middle + right - ahead, middle + right + ahead, middle - right + ahead]
