"""What stands beside the road, down to the polygons, ellipsoids and cylinders that it is made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from saunet.synthetic.materials import FLOORS, INDEX, WINDOWS

F64 = NDArray[np.float64]
CORNERS = 8  # corners stored per polygon; polygons with fewer repeat their last one
Color = tuple[float, float, float]
Pair = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Surface:
    """A material and its two colors (the second is where the material's mask is 1)."""

    material: str
    color: Color
    second: Color
    grain: float = 0.10  # strength of the noise that makes equal surfaces differ


@dataclass(frozen=True, slots=True)
class Polygons:
    """Flat convex polygons, corners clockwise as seen from outside; q of them."""

    corners: F64  # q x 8 x 3, meters, world
    to_u: F64  # q x 4: texture coordinate u = to_u[:3] . point + to_u[3], in periods
    to_v: F64  # q x 4: the same downwards
    look: F64  # q x 11: material, color (3), second color (3), grain, meters per period in u and v, grain offset

    @property
    def count(self) -> int:
        return len(self.corners)

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
        return Polygons(*(np.concatenate([getattr(p, k) for p in parts]) for k in ("corners", "to_u", "to_v", "look")))


@dataclass(frozen=True, slots=True)
class Quadrics:
    """Upright ellipsoids (height > 0) and cylinders (height = 0); k of them."""

    center: F64  # k x 3, meters, world
    radius: F64  # k: horizontal radius, meters
    height: F64  # k: vertical radius of an ellipsoid, or 0 for a cylinder
    extent: F64  # k x 2: lowest and highest world y that belong to the surface (y is down: top first)
    look: F64  # k x 11: see `Polygons.look`


class Mesh:
    """Collects surfaces; `polygons` and `quadrics` return them as arrays."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._polygons: list[tuple[F64, F64, F64, list[float]]] = []
        self._quadrics: list[list[float]] = []

    def _look(self, surface: Surface, period: Pair) -> list[float]:
        material, offset = float(INDEX[surface.material]), self._rng.uniform()
        return [material, *surface.color, *surface.second, surface.grain, *period, offset]

    def polygon(
        self, corners: ArrayLike, surface: Surface, period: Pair, fit: bool = False, phase: float | None = None
    ) -> None:
        """Add a convex polygon: n x 3 corners clockwise from outside, starting top left.

        u runs along the first edge, v down from it; one period of the material spans ``period`` meters in both. The
        picture starts at a random place, with ``fit`` at the first corner, with ``phase`` so many periods beside it.
        """
        points = np.asarray(corners, np.float64)
        u_axis = (points[1] - points[0]) / np.linalg.norm(points[1] - points[0])
        normal = np.cross(points[1] - points[0], points[2] - points[0])
        v_axis = np.cross(normal / np.linalg.norm(normal), u_axis)
        start_u, start_v = (0.0, 0.0) if fit else self._rng.uniform(0, 1, 2)
        if phase is not None:
            start_u, start_v = phase, 0.0
        to_u = np.append(u_axis, -points[0] @ u_axis + start_u * period[0]) / period[0]
        to_v = np.append(v_axis, -points[0] @ v_axis + start_v * period[1]) / period[1]
        padded = np.concatenate([points, np.repeat(points[-1:], CORNERS - len(points), axis=0)])
        self._polygons.append((padded, to_u, to_v, self._look(surface, period)))

    def box(
        self, center: Pair, size: Pair, heading: float, bottom: float, top: float, surface: Surface, period: Pair,
        roof: Surface | None = None,
    ) -> None:  # fmt: skip
        """Add an upright box: four walls, and a flat roof where ``roof`` is given."""
        outline = footprint(center, size, heading)
        for i in range(4):
            self.wall(outline[i], outline[(i + 1) % 4], bottom, top, surface, period)
        if roof is not None:
            self.polygon([(x, -top, z) for x, z in reversed(outline)], roof, (4.0, 4.0))

    def wall(
        self, left: F64, right: F64, bottom: float, top: float, surface: Surface, period: Pair, fit: bool = False
    ) -> None:
        """Add an upright rectangle between two ground points, seen from the side on which ``left`` is left."""
        ends = [(left, top), (right, top), (right, bottom), (left, bottom)]
        phase = float(self._rng.integers(0, 4)) / 4
        self.polygon([(p[0], -y, p[1]) for p, y in ends], surface, period, fit, None if fit else phase)

    def ellipsoid(self, center: tuple[float, float, float], radius: float, height: float, surface: Surface) -> None:
        """Add an ellipsoid of horizontal and vertical radius, meters; y points down."""
        look = self._look(surface, (3.0, 3.0))
        self._quadrics.append([*center, radius, height, center[1] - height, center[1] + height, *look])

    def cylinder(self, x: float, z: float, radius: float, bottom: float, top: float, surface: Surface) -> None:
        """Add an upright cylinder without caps; meters, heights above the ground."""
        self._quadrics.append([x, 0.0, z, radius, 0.0, -top, -bottom, *self._look(surface, (1.5, 2.5))])

    def polygons(self) -> Polygons:
        shapes = [(-1, CORNERS, 3), (-1, 4), (-1, 4), (-1, 11)]
        columns = zip(*self._polygons, strict=True) if self._polygons else [()] * 4
        return Polygons(*(np.asarray(v, np.float64).reshape(s) for v, s in zip(columns, shapes, strict=True)))

    def quadrics(self) -> Quadrics:
        rows = np.asarray(self._quadrics, np.float64).reshape(-1, 18)
        return Quadrics(rows[:, :3], rows[:, 3], rows[:, 4], rows[:, 5:7], rows[:, 7:])


def footprint(center: Pair, size: Pair, heading: float) -> list[F64]:
    """Return the four ground corners (x, z) of a box; wall i has corner i on its left and corner i + 1 on its right.

    Order of the walls: rear, right, front, left.
    """
    right = np.array([np.cos(heading), -np.sin(heading)]) * size[0] / 2
    ahead = np.array([np.sin(heading), np.cos(heading)]) * size[1] / 2
    middle = np.asarray(center, np.float64)
    return [middle - right - ahead, middle + right - ahead, middle + right + ahead, middle - right + ahead]


_WALLS: tuple[Color, ...] = (
    (0.62, 0.30, 0.22), (0.72, 0.62, 0.48), (0.82, 0.78, 0.70), (0.55, 0.52, 0.50), (0.80, 0.66, 0.36),
    (0.66, 0.44, 0.34), (0.48, 0.56, 0.62), (0.74, 0.54, 0.50), (0.50, 0.54, 0.42), (0.88, 0.84, 0.76),
    (0.42, 0.34, 0.32),
)  # fmt: skip
_PAINTS: tuple[Color, ...] = (
    (0.75, 0.75, 0.77), (0.18, 0.19, 0.22), (0.55, 0.08, 0.08), (0.12, 0.22, 0.48), (0.86, 0.86, 0.84),
    (0.35, 0.37, 0.40), (0.20, 0.38, 0.26), (0.80, 0.62, 0.15), (0.42, 0.58, 0.70), (0.50, 0.36, 0.24),
)  # fmt: skip
_GLASS: Color = (0.20, 0.24, 0.30)


def _vary(rng: np.random.Generator, color: Color, amount: float = 0.12) -> Color:
    shade = (1 + amount * rng.standard_normal()) * (1 + 0.04 * rng.standard_normal(3))
    tint = np.clip(np.asarray(color) * shade, 0.02, 0.95)
    return float(tint[0]), float(tint[1]), float(tint[2])


def _pick(rng: np.random.Generator, colors: tuple[Color, ...]) -> Color:
    return _vary(rng, colors[int(rng.integers(len(colors)))])


def building(
    mesh: Mesh, rng: np.random.Generator, center: Pair, size: Pair, heading: float, floors: int, front: int
) -> None:
    """Add a house with windows on all sides and a flat or a gabled roof."""
    style = ("facade_sash", "facade_tall", "facade_ribbon", "facade_panel")[int(rng.integers(4))]
    wall = Surface(style, _pick(rng, _WALLS), _vary(rng, _GLASS, 0.3), grain=0.12)
    storey = rng.uniform(2.8, 3.6)
    period = (rng.uniform(2.2, 3.6) * WINDOWS, storey * FLOORS)
    top = floors * storey
    outline = footprint(center, size, heading)
    has_shop = floors > 1 and rng.uniform() < 0.4
    plinth = Surface("brick", _pick(rng, _WALLS), (0.7, 0.68, 0.64)) if rng.uniform() < 0.5 else None
    for i in range(4):
        left, right = outline[i], outline[(i + 1) % 4]
        bottom = 0.0
        if has_shop and i == front:
            bottom = storey
            board = Surface("shop", _pick(rng, _WALLS), _vary(rng, _GLASS, 0.3))
            mesh.wall(left, right, 0.0, bottom, board, (rng.uniform(7, 11), storey))
        elif plinth is not None:
            bottom = 0.9
            mesh.wall(left, right, 0.0, bottom, plinth, (1.8, 1.4))
        mesh.wall(left, right, bottom, top, wall, period)
    tiles = Surface("roof", _vary(rng, (0.45, 0.24, 0.18), 0.25), _vary(rng, (0.32, 0.26, 0.24), 0.2))
    if rng.uniform() < 0.55 and floors <= 4:
        _gable(mesh, outline, top, rng.uniform(1.5, 3.5), tiles, Surface("plaster", wall.color, wall.second))


def _gable(mesh: Mesh, outline: list[np.ndarray], top: float, rise: float, tiles: Surface, wall: Surface) -> None:
    rear_left, rear_right, front_right, front_left = ((x, -top, z) for x, z in outline)
    (rear_x, rear_z), (front_x, front_z) = (outline[0] + outline[1]) / 2, (outline[2] + outline[3]) / 2
    ridge_rear, ridge_front = (rear_x, -top - rise, rear_z), (front_x, -top - rise, front_z)
    mesh.polygon([ridge_rear, ridge_front, front_right, rear_right], tiles, (2.4, 2.8))
    mesh.polygon([ridge_front, ridge_rear, rear_left, front_left], tiles, (2.4, 2.8))
    for left, right, peak in ((rear_left, rear_right, ridge_rear), (front_right, front_left, ridge_front)):
        mesh.polygon([left, peak, right], wall, (5.0, 5.0))


def car(rng: np.random.Generator) -> Polygons:
    """Return a car or van standing on the origin, heading along z, with its contact shadow."""
    mesh = Mesh(rng)
    van = rng.uniform() < 0.12
    length, width = (5.0, 1.95) if van else (rng.uniform(3.7, 4.7), rng.uniform(1.68, 1.85))
    waist, top = (1.1, 2.2) if van else (rng.uniform(0.82, 0.95), rng.uniform(1.38, 1.62))
    paint, half, sill = _pick(rng, _PAINTS), width / 2, 0.22
    dark = (0.05, 0.05, 0.06)
    flank = Surface("car_side", paint, dark, grain=0.06)
    front = Surface("car_front", paint, (0.8, 0.8, 0.75), grain=0.03)
    rear = Surface("car_rear", paint, (0.6, 0.06, 0.05), grain=0.03)
    plain, glass = Surface("paint", paint, dark, grain=0.08), Surface("glass", (0.22, 0.26, 0.31), dark, grain=0.08)
    outline = footprint((0.0, 0.0), (width, length), 0.0)
    for wall, surface in enumerate((rear, flank, front, flank)):
        span = width if wall % 2 == 0 else length
        mesh.wall(outline[wall], outline[(wall + 1) % 4], sill, waist, surface, (span, waist - sill), fit=True)
    _level(mesh, half, length / 2, waist, plain)
    _cabin(mesh, half, waist, top, length, van, glass, plain)
    rubber = Surface("wheel", (0.22, 0.22, 0.23), (0.55, 0.56, 0.58), grain=0.0)
    for z in (-0.31 * length, 0.30 * length):
        for side in (-1.0, 1.0):
            _wheel(mesh, side * (half + 0.02), z, 0.32, side, rubber)
    shadow = Surface("asphalt", (0.07, 0.07, 0.08), (0.08, 0.08, 0.09))
    _level(mesh, half + 0.12, length / 2 + 0.15, 0.01, shadow)
    return mesh.polygons()


def _level(mesh: Mesh, half: float, ends: float, up: float, surface: Surface) -> None:
    """A horizontal rectangle around the origin, ``up`` meters above the road."""
    mesh.polygon([(-half, -up, ends), (half, -up, ends), (half, -up, -ends), (-half, -up, -ends)], surface, (4.0, 4.0))


def _cabin(
    mesh: Mesh, half: float, waist: float, top: float, length: float, van: bool, glass: Surface, plain: Surface
) -> None:
    """The part above the waist: four sloping windows and a roof."""
    back, ahead, roof_back, roof_ahead = (-0.48, 0.30, -0.47, 0.18) if van else (-0.44, 0.24, -0.32, 0.06)
    low, high = half - 0.03, half - 0.16
    foot = [(-low, -waist, back), (low, -waist, back), (low, -waist, ahead), (-low, -waist, ahead)]
    roof = [(-high, -top, roof_back), (high, -top, roof_back), (high, -top, roof_ahead), (-high, -top, roof_ahead)]
    foot, roof = ([(x, y, z * length) for x, y, z in corners] for corners in (foot, roof))
    for i in range(4):
        j = (i + 1) % 4
        mesh.polygon([roof[i], roof[j], foot[j], foot[i]], glass, (2.0, top - waist), fit=True)
    mesh.polygon(roof[::-1], plain, (4.0, 4.0))


def _wheel(mesh: Mesh, x: float, z: float, radius: float, side: float, surface: Surface) -> None:
    angles = np.radians(-112.5 + 45.0 * np.arange(8))
    corners = [(x, -radius + radius * np.sin(a), z + side * radius * np.cos(a)) for a in angles]
    mesh.polygon(corners, surface, (2 * radius, 2 * radius), phase=0.5 - 0.5 * float(np.sin(np.radians(22.5))))


def tree(mesh: Mesh, rng: np.random.Generator, x: float, z: float, height: float) -> None:
    """Add a tree of ``height`` meters: a trunk and a crown."""
    bark = Surface("bands", _vary(rng, (0.30, 0.23, 0.17), 0.2), (0.42, 0.36, 0.28))
    green = _vary(rng, (0.22, 0.36, 0.12), 0.25)
    if rng.uniform() < 0.15:
        green = _vary(rng, (0.50, 0.36, 0.12), 0.2)
    leaves = Surface("foliage", green, _vary(rng, (0.40, 0.48, 0.20), 0.2), grain=0.2)
    mesh.cylinder(x, z, 0.035 * height * rng.uniform(0.7, 1.2), 0.0, 0.6 * height, bark)
    spread = height * rng.uniform(0.20, 0.30)
    mesh.ellipsoid((x, -0.68 * height, z), spread, 0.32 * height, leaves)
    for _ in range(3):
        angle, out = rng.uniform(0, 2 * np.pi), spread * rng.uniform(0.4, 0.8)
        place = (x + out * np.cos(angle), -height * rng.uniform(0.5, 0.75), z + out * np.sin(angle))
        mesh.ellipsoid(place, spread * rng.uniform(0.5, 0.8), 0.17 * height, leaves)


def bush(mesh: Mesh, rng: np.random.Generator, x: float, z: float) -> None:
    leaves = Surface("foliage", _vary(rng, (0.22, 0.36, 0.14), 0.25), _vary(rng, (0.42, 0.46, 0.2), 0.2), grain=0.2)
    radius = rng.uniform(0.5, 1.2)
    mesh.ellipsoid((x, -0.5 * radius, z), radius, radius * rng.uniform(0.7, 1.1), leaves)


def lamp(mesh: Mesh, rng: np.random.Generator, x: float, z: float) -> None:
    """Add a street lamp."""
    gray = rng.uniform(0.25, 0.6)
    metal = Surface("bands", (gray, gray, gray * 1.03), (gray * 0.7, gray * 0.65, gray * 0.6))
    height = rng.uniform(4.5, 8.0)
    mesh.cylinder(x, z, rng.uniform(0.06, 0.12), 0.0, height, metal)
    mesh.ellipsoid((x, -height, z), 0.28, 0.16, Surface("paint", (0.85, 0.85, 0.8), (0.6, 0.6, 0.6)))
    if rng.uniform() < 0.4:
        board = Surface("poster", _pick(rng, _PAINTS), _pick(rng, _PAINTS), grain=0.05)
        low = rng.uniform(2.0, 2.6)
        mesh.box((x, z), (0.9, 0.08), rng.uniform(-0.2, 0.2), low, low + 0.8, board, (1.0, 1.0))


def barrier(mesh: Mesh, rng: np.random.Generator, start: np.ndarray, end: np.ndarray, kind: str) -> None:
    """Add a hedge, a wooden fence or a garden wall between two ground points (x, z)."""
    hedge = Surface("foliage", _vary(rng, (0.18, 0.30, 0.11), 0.2), (0.34, 0.42, 0.18), 0.2)
    fence = Surface("planks", _vary(rng, (0.48, 0.36, 0.24), 0.25), (0.40, 0.32, 0.26))
    bricks = Surface("brick", _pick(rng, _WALLS), (0.72, 0.70, 0.66))
    surface, period, height, thickness = {
        "hedge": (hedge, (2.0, 2.0), 1.5, 0.8),
        "fence": (fence, (2.4, 1.6), 1.6, 0.06),
        "wall": (bricks, (2.0, 1.5), 1.2, 0.3),
    }[kind]
    along = end - start
    length = float(np.hypot(*along))
    middle = (start + end) / 2
    heading = float(np.arctan2(along[0], along[1]))
    top = height * rng.uniform(0.75, 1.25)
    roof = Surface("plaster", (0.6, 0.58, 0.55), (0.5, 0.5, 0.5))
    if kind == "hedge":
        roof = Surface("foliage", surface.color, surface.second)
    mesh.box((float(middle[0]), float(middle[1])), (thickness, length), heading, 0.0, top, surface, period, roof)


def billboard(mesh: Mesh, rng: np.random.Generator, x: float, z: float, heading: float) -> None:
    """Add a billboard on posts, turned by ``heading`` radians."""
    legs = Surface("bands", (0.4, 0.4, 0.42), (0.3, 0.28, 0.26))
    for side in (-1.3, 1.3):
        mesh.cylinder(x + side * float(np.cos(heading)), z - side * float(np.sin(heading)), 0.08, 0.0, 1.6, legs)
    board = Surface("poster", _pick(rng, _PAINTS), _pick(rng, _WALLS), grain=0.05)
    mesh.box((x, z), (3.4, 0.15), heading, 1.5, 3.8, board, (rng.uniform(2.5, 4.5), 2.4))
