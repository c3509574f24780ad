"""Triangle meshes of what stands in a street, and the materials that they are made of.

World axes: x right, y up, z forward, in meters. A mesh is a triangle soup; each triangle has a material, texture
coordinates in meters, and a tint (a factor on the material's color).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

PLAIN, ROAD, FACADE, LEAF, GLOSS, GLASS, LIGHT = range(7)


@dataclass
class Materials:
    """A table of materials: how to shade a triangle."""

    kind: list[int] = field(default_factory=list)
    color: list[tuple[float, float, float]] = field(default_factory=list)
    texture: list[int] = field(default_factory=list)
    scale: list[float] = field(default_factory=list)
    contrast: list[float] = field(default_factory=list)
    params: list[NDArray[np.float32]] = field(default_factory=list)

    def add(
        self,
        color: object,
        kind: int = PLAIN,
        texture: int = 0,
        scale: float = 2.0,
        contrast: float = 1.0,
        params: object = (),
    ) -> int:
        """Add a material and return its index.

        Args:
            color: Linear RGB albedo.
            kind: How it is shaded.
            texture: Index of the texture whose values multiply the color.
            scale: Meters that the texture covers before it repeats.
            contrast: Factor on the texture's deviation from 1.
            params: Up to 12 numbers that the kind needs.
        """
        self.kind.append(kind)
        self.color.append(tuple(float(c) for c in np.asarray(color, float)))  # type: ignore[arg-type]
        self.texture.append(texture)
        self.scale.append(scale)
        self.contrast.append(contrast)
        row = np.zeros(12, np.float32)
        values = np.asarray(params, np.float32)
        row[: len(values)] = values
        self.params.append(row)
        return len(self.kind) - 1


class Soup:
    """Triangles, collected part by part."""

    def __init__(self) -> None:
        self.triangles: list[Array] = []
        self.uv: list[Array] = []
        self.material: list[NDArray[np.int32]] = []
        self.tint: list[Array] = []

    def add(self, triangles: Array, material: object, uv: Array | None = None, tint: object = 1.0) -> None:
        """Add n triangles, n 3 3, with one material or n of them, texture coordinates n 3 2 and a tint."""
        n = len(triangles)
        self.triangles.append(np.asarray(triangles, np.float32))
        self.material.append(np.broadcast_to(np.asarray(material, np.int32), (n,)))
        self.uv.append(box_uv(self.triangles[-1]) if uv is None else np.asarray(uv, np.float32))
        t = np.asarray(tint, np.float32)
        self.tint.append(np.broadcast_to(t if t.ndim == 2 else t.reshape(-1), (n, 3)))

    def merged(self) -> tuple[Array, NDArray[np.int32], Array, Array]:
        """Return triangles n 3 3, material n, texture coordinates n 3 2 and tints n 3."""
        return (
            np.concatenate(self.triangles),
            np.concatenate(self.material),
            np.concatenate(self.uv),
            np.concatenate(self.tint),
        )

    def place(self, other: Soup, position: Array, yaw: float = 0.0, size: object = 1.0) -> None:
        """Add another soup, scaled, turned about y (positive turns z toward x) and moved."""
        triangles, material, uv, tint = other.merged()
        self.add((triangles * np.asarray(size, np.float32)) @ turn(yaw).T + position, material, uv, tint)


def turn(yaw: float) -> Array:
    """Return the rotation about y that turns z toward x by ``yaw`` radians."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]], np.float32)


def box_uv(triangles: Array) -> Array:
    """Return texture coordinates in meters along each triangle's dominant plane; v points up on walls."""
    normal = np.abs(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]))
    axis = normal.argmax(1)
    first = np.where(axis == 0, 2, 0)
    second = np.where(axis == 1, 2, 1)
    take = np.arange(len(triangles))[:, None]
    corner = np.arange(3)[None]
    return np.stack([triangles[take, corner, first[:, None]], triangles[take, corner, second[:, None]]], -1)


def quads(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Return two triangles for each quadrilateral; corners n 3 in order around it."""
    a, b, c, d = (np.asarray(x, np.float32).reshape(-1, 3) for x in (a, b, c, d))
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def box(low: object, high: object) -> Array:
    """Return the 12 triangles of an axis-aligned box."""
    x0, y0, z0 = np.asarray(low, float)
    x1, y1, z1 = np.asarray(high, float)
    v = np.array([[x, y, z] for x in (x0, x1) for y in (y0, y1) for z in (z0, z1)], np.float32)
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    f = np.array(faces)
    return quads(v[f[:, 0]], v[f[:, 1]], v[f[:, 2]], v[f[:, 3]])


def tube(path: object, radii: object, sides: int = 7) -> Array:
    """Return the triangles of a tube along a path, n 3, with a radius at each point."""
    p = np.asarray(path, np.float32)
    r = np.broadcast_to(np.asarray(radii, np.float32), (len(p),))
    along = np.gradient(p, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True) + 1e-9
    helper = np.where(np.abs(along[:, :1]) < 0.9, [[1, 0, 0]], [[0, 0, 1]]).astype(np.float32)
    n1 = np.cross(along, helper)
    n1 /= np.linalg.norm(n1, axis=1, keepdims=True) + 1e-9
    n2 = np.cross(along, n1)
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    ring = p[:, None] + r[:, None, None] * (
        np.cos(angle)[None, :, None] * n1[:, None] + np.sin(angle)[None, :, None] * n2[:, None]
    )
    nxt = np.roll(ring, -1, 1)
    return quads(ring[:-1], nxt[:-1], nxt[1:], ring[1:])


def ellipsoid(center: object, radii: object, rings: int = 6, sides: int = 10) -> Array:
    """Return the triangles of an ellipsoid."""
    t = np.linspace(0, np.pi, rings + 1)
    y, r = np.cos(t), np.sin(t)
    radii3 = np.asarray(radii, np.float32)
    a = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    ring = np.stack(
        [r[:, None] * np.cos(a), np.broadcast_to(y[:, None], (rings + 1, sides)), r[:, None] * np.sin(a)], -1
    )
    ring = ring * radii3 + np.asarray(center, np.float32)
    nxt = np.roll(ring, -1, 1)
    return quads(ring[:-1], nxt[:-1], nxt[1:], ring[1:])


def leaves(rng: np.random.Generator, centers: Array, radii: Array, count: int, size: float) -> tuple[Array, Array]:
    """Scatter leaf clusters (single triangles) through ellipsoids, denser toward their surface.

    Args:
        rng: Randomness.
        centers: Centers of the ellipsoids, k 3.
        radii: Their radii, k 3.
        count: Triangles in all.
        size: Typical side of a triangle in meters.

    Returns:
        Triangles n 3 3 and tints n 3.
    """
    volume = radii.prod(1) ** (2 / 3)
    which = rng.choice(len(centers), count, p=volume / volume.sum())
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    reach = rng.uniform(0, 1, (count, 1)) ** 0.22 * (1 + 0.12 * rng.normal(size=(count, 1)))
    middle = centers[which] + direction * reach * radii[which]
    normal = direction * 0.8 + rng.normal(size=(count, 3)) * 0.6 + [0, 0.4, 0]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    first = np.cross(normal, rng.normal(size=(count, 3)))
    first /= np.linalg.norm(first, axis=1, keepdims=True) + 1e-9
    second = np.cross(normal, first)
    s = size * rng.uniform(0.5, 1.5, (count, 1))
    angle = rng.uniform(0.7, 1.4, (count, 1)) * 2.0944
    triangles = np.stack(
        [
            middle + s * first,
            middle + s * (np.cos(angle) * first + np.sin(angle) * second),
            middle + s * (np.cos(2 * angle) * first + np.sin(2 * angle) * second),
        ],
        1,
    )
    tint = rng.uniform(0.55, 1.35, (count, 1)) * rng.uniform(0.85, 1.15, (count, 3))
    tint = tint * (0.45 + 0.55 * np.clip(reach, 0, 1) ** 3)  # less light gets to the inner leaves
    return triangles.astype(np.float32), tint.astype(np.float32)


def tree(rng: np.random.Generator, bark: int, leaf: int, height: float, detail: float = 1.0) -> Soup:
    """Return a deciduous tree: a trunk that forks, and a crown of leaf clusters around the branches."""
    soup = Soup()
    stem = height * rng.uniform(0.18, 0.4)
    radius = max(0.05, height * rng.uniform(0.012, 0.028))
    lean = rng.normal(0, 0.03, 2) * height
    top = np.array([lean[0], stem, lean[1]])
    middle = np.array([lean[0] * 0.4 + rng.normal(0, 0.05), stem / 2, lean[1] * 0.4])
    soup.add(tube([[0, -0.3, 0], middle, top], [radius * 1.3, radius, radius * 0.85], 8), bark)
    spread = height * rng.uniform(0.16, 0.34)
    centers, radii = [], []
    branches = int(rng.integers(5, 10))
    for i in range(branches):
        a = 2 * np.pi * i / branches + rng.normal(0, 0.4)
        up = rng.uniform(0.1, 0.95)
        out = spread * rng.uniform(0.3, 1.0) * np.sin(np.pi * (0.25 + 0.65 * up))
        tip = np.array([top[0] + out * np.cos(a), stem + (height - stem) * up * 0.85, top[2] + out * np.sin(a)])
        bend = (top + tip) / 2 + rng.normal(0, 0.1, 3) * spread
        soup.add(tube([top - [0, stem * 0.1, 0], bend, tip], [radius * 0.6, radius * 0.4, radius * 0.15], 5), bark)
        size = spread * rng.uniform(0.45, 0.8)
        centers.append(tip)
        radii.append([size, size * rng.uniform(0.6, 1.0), size])
    centers.append(np.array([top[0], stem + (height - stem) * 0.6, top[2]]))
    radii.append([spread * 0.8, (height - stem) * 0.4, spread * 0.8])
    count = int(detail * rng.uniform(900, 2600))
    triangles, tint = leaves(rng, np.array(centers), np.array(radii), count, 0.055 * height**0.6 / detail**0.5)
    soup.add(triangles, leaf, tint=tint)
    return soup


def young_tree(rng: np.random.Generator, bark: int, leaf: int, stake: int, height: float, detail: float = 1.0) -> Soup:
    """Return a newly planted tree, as along streets: a thin bare stem, a small open crown, and often stakes around."""
    soup = Soup()
    stem, radius = height * rng.uniform(0.3, 0.5), rng.uniform(0.03, 0.08)
    soup.add(
        tube([[0, -0.3, 0], [0, stem, 0], [rng.normal(0, 0.05), height * 0.9, 0]], [radius, radius * 0.8, 0.01], 6),
        bark,
    )
    width = height * rng.uniform(0.12, 0.26)
    up = rng.uniform(0.05, 0.95, 7)
    around = rng.uniform(0, 2 * np.pi, 7)
    out = width * rng.uniform(0.2, 0.8, 7) * np.sin(np.pi * (0.2 + 0.7 * up))
    centers = np.stack([out * np.cos(around), stem + (height - stem) * up * 0.92, out * np.sin(around)], 1)
    radii = np.stack(
        [
            width * rng.uniform(0.35, 0.7, 7),
            (height - stem) * rng.uniform(0.12, 0.25, 7),
            width * rng.uniform(0.35, 0.7, 7),
        ],
        1,
    )
    for tip in centers:
        soup.add(tube([[0, stem * rng.uniform(0.9, 1.3), 0], tip], [radius * 0.4, 0.01], 4), bark)
    count = detail * np.exp(rng.uniform(np.log(250), np.log(3000)))  # from see-through to dense
    triangles, tint = leaves(rng, centers, radii, int(count), 0.055 * height**0.6 / detail**0.5)
    soup.add(triangles, leaf, tint=tint)
    if rng.uniform() < 0.5:
        count, away, tall = int(rng.integers(2, 5)), rng.uniform(0.25, 0.6), stem * rng.uniform(0.7, 1.1)
        feet = [(np.cos(a), np.sin(a)) for a in 2 * np.pi * (np.arange(count) / count + rng.uniform())]
        lean = rng.uniform(0.3, 1.0)
        for x, z in feet:
            soup.add(
                tube([[away * x, -0.2, away * z], [away * x * lean, tall, away * z * lean]], [0.04, 0.04], 5), stake
            )
        for (x0, z0), (x1, z1) in zip(feet, feet[1:] + feet[:1], strict=True):
            a = away * lean
            soup.add(tube([[a * x0, tall * 0.95, a * z0], [a * x1, tall * 0.95, a * z1]], [0.03, 0.03], 4), stake)
    return soup


def conifer(rng: np.random.Generator, bark: int, leaf: int, height: float, detail: float = 1.0) -> Soup:
    """Return a conifer: layers of drooping leaf clusters on a straight trunk."""
    soup = Soup()
    soup.add(tube([[0, -0.3, 0], [0, height * 0.95, 0]], [height * 0.02, 0.03], 6), bark)
    layers = np.linspace(0.08, 0.97, 9)
    width = height * rng.uniform(0.14, 0.25)
    centers = np.stack([np.zeros(9), layers * height, np.zeros(9)], 1)
    radii = np.stack([width * (1.03 - layers), np.full(9, height * 0.09), width * (1.03 - layers)], 1)
    triangles, tint = leaves(rng, centers, radii, int(1500 * detail), 0.05 * height**0.6 / detail**0.5)
    soup.add(triangles, leaf, tint=tint)
    return soup


def bush(rng: np.random.Generator, leaf: int, length: float, height: float, depth: float, clipped: bool) -> Soup:
    """Return a hedge or bushes along z, from 0 to ``length``."""
    soup = Soup()
    step = 0.9 * max(height, depth) if not clipped else 0.6
    k = max(1, int(length / step))
    z = (np.arange(k) + 0.5) * length / k
    wobble = 0.05 if clipped else 0.3
    h = height * (1 + wobble * rng.normal(size=k)).clip(0.4, 1.6)
    centers = np.stack([rng.normal(0, wobble * depth * 0.5, k), h * 0.5, z], 1)
    radii = np.stack([np.full(k, depth * 0.5), h * 0.55, np.full(k, step * 0.75)], 1)
    if clipped:
        soup.add(box([-depth * 0.4, 0, 0], [depth * 0.4, height * 0.9, length]), leaf, tint=0.35)
    count = int(np.clip(500 * length * height / (0.3 + 0.5 * height), 100, 5000))
    triangles, tint = leaves(rng, centers, radii, count, 0.055 + 0.035 * height)
    triangles[..., 1] = np.maximum(triangles[..., 1], -0.1)
    soup.add(triangles, leaf, tint=tint)
    return soup


def _extrude(profile: Array, half: Array, material: object) -> tuple[Array, NDArray[np.int32]]:
    """Join a closed side profile (n 2: z, y) with half widths n into a body; material of each profile edge."""
    p = np.asarray(profile, np.float32)
    w = np.asarray(half, np.float32)
    left = np.stack([-w, p[:, 1], p[:, 0]], 1)
    right = np.stack([w, p[:, 1], p[:, 0]], 1)
    skin = quads(left, right, np.roll(right, -1, 0), np.roll(left, -1, 0))
    return skin, np.tile(np.asarray(material, np.int32), 2)


def car(rng: np.random.Generator, paint: int, glass: int, dark: int, lamps: tuple[int, int, int], shape: str) -> Soup:
    """Return a passenger car or van, front toward +z, standing on y = 0, its center at the origin.

    Args:
        rng: Randomness: proportions.
        paint: Material of the body.
        glass: Material of the windows.
        dark: Material of tires and trims.
        lamps: Materials of tail lights, head lights and the license plate.
        shape: ``hatch``, ``wagon``, ``sedan``, ``suv`` or ``van``.
    """
    length, height, width = {
        "hatch": (3.9, 1.48, 1.7),
        "wagon": (4.5, 1.48, 1.78),
        "sedan": (4.5, 1.43, 1.78),
        "suv": (4.5, 1.72, 1.85),
        "van": (5.2, 2.1, 1.95),
    }[shape]
    length *= rng.uniform(0.92, 1.08)
    height *= rng.uniform(0.95, 1.06)
    w = width * rng.uniform(0.95, 1.04) / 2
    h = length / 2
    low, belt = 0.24 * rng.uniform(0.8, 1.2), height * rng.uniform(0.58, 0.66)
    hood = belt * rng.uniform(0.9, 1.0)
    screen = {"hatch": 0.22, "wagon": 0.2, "sedan": 0.18, "suv": 0.2, "van": 0.34}[shape] * length
    roof0 = screen - rng.uniform(0.14, 0.2) * length * (0.6 if shape == "van" else 1)
    roof1 = {"hatch": -0.36, "wagon": -0.44, "sedan": -0.22, "suv": -0.42, "van": -0.485}[shape] * length
    back = {"hatch": -0.46, "wagon": -0.485, "sedan": -0.38, "suv": -0.48, "van": -0.495}[shape] * length
    trunk = belt * (0.97 if shape == "sedan" else 1.0)
    points = [
        (h - 0.1, low, w * 0.9, paint),
        (h, low + 0.2, w * 0.95, paint),
        (h - 0.03, hood * 0.78, w * 0.95, paint),
        (h - 0.25, hood * 0.93, w * 0.96, paint),
        (screen, belt, w * 0.98, glass),
        (roof0, height * 0.98, w * 0.76, paint),
        ((roof0 + roof1) / 2, height, w * 0.76, paint),
        (roof1, height * 0.97, w * 0.76, glass),
        (back, belt, w * 0.96, paint),
        (-h + 0.04, trunk, w * 0.95, paint),
        (-h, trunk * 0.6, w * 0.97, paint),
        (-h + 0.02, low + 0.15, w * 0.95, paint),
        (-h + 0.1, low, w * 0.9, dark),
    ]
    profile = np.array([(p[0], p[1]) for p in points], np.float32)
    half = np.array([p[2] for p in points], np.float32)
    skin, material = _extrude(profile, half, [p[3] for p in points])
    soup = Soup()
    soup.add(skin, material)
    # sides: the lower body up to the belt line as a strip, the windows above it between the pillars
    for side in (-1.0, 1.0):
        outline = profile[[1, 2, 3, 4, 8, 9, 10, 11]]
        at = half[[1, 2, 3, 4, 8, 9, 10, 11]]
        top = np.stack([side * at, outline[:, 1], outline[:, 0]], 1)
        bottom = np.stack([side * at * 0.97, np.full(8, low), outline[:, 0]], 1)
        soup.add(quads(top[:-1], top[1:], bottom[1:], bottom[:-1]), paint)
        upper = [
            (screen, belt, w * 0.98),
            (roof0, height * 0.98, w * 0.76),
            (roof1, height * 0.97, w * 0.76),
            (back, belt, w * 0.96),
        ]
        u = np.array([[side * x, y, z] for z, y, x in upper], np.float32)
        soup.add(quads(u[0], u[1], u[2], u[3]), paint)
        center = np.add(u.mean(0), [0, -0.02, 0])
        pane = center + (u - center) * 0.86 + [side * 0.012, 0, 0]
        cuts = [0.0, 0.47, 0.53, 1.0] if shape != "van" else [0.55, 0.75, 0.8, 1.0]
        for a, b in ((cuts[0], cuts[1]), (cuts[2], cuts[3])):
            a, b = 1 - b, 1 - a
            lo0, lo1 = pane[0] * (1 - a) + pane[3] * a, pane[0] * (1 - b) + pane[3] * b
            hi0, hi1 = pane[1] * (1 - a) + pane[2] * a, pane[1] * (1 - b) + pane[2] * b
            soup.add(quads(lo0, hi0, hi1, lo1), glass)
        for z in (-0.31 * length, 0.31 * length):
            r = 0.31 * rng.uniform(0.95, 1.15) + (0.04 if shape in ("suv", "van") else 0)
            a = np.linspace(0, 2 * np.pi, 13)[:-1]
            rim = np.stack([np.full(12, side * (w + 0.01)), r + r * np.sin(a), z + r * np.cos(a)], 1)
            inner = rim - [side * 0.22, 0, 0]
            soup.add(quads(rim, np.roll(rim, -1, 0), np.roll(inner, -1, 0), inner), dark)
            hub = np.array([side * (w + 0.012), r, z])
            soup.add(np.stack([np.broadcast_to(hub, rim.shape), rim, np.roll(rim, -1, 0)], 1), dark)
            disc = hub + (rim - hub) * 0.62 + [side * 0.01, 0, 0]
            soup.add(
                np.stack(
                    [np.broadcast_to(np.add(hub, [side * 0.01, 0, 0]), disc.shape), disc, np.roll(disc, -1, 0)], 1
                ),
                lamps[2],
                tint=0.45,
            )
        y = belt * rng.uniform(0.72, 0.95)
        soup.add(
            box([side * w * 0.93 - 0.13, y - 0.16, -h - 0.02], [side * w * 0.93 + 0.04, y + 0.05, -h + 0.14]), lamps[0]
        )
        soup.add(
            box([side * w * 0.84 - 0.16, hood * 0.7, h - 0.12], [side * w * 0.84 + 0.1, hood * 0.85, h + 0.01]),
            lamps[1],
        )
    y = low + rng.uniform(0.15, 0.4)
    soup.add(box([-0.26, y, -h - 0.03], [0.26, y + 0.11, -h + 0.05]), lamps[2])
    soup.add(box([-0.26, low + 0.12, h - 0.05], [0.26, low + 0.23, h + 0.03]), lamps[2])
    soup.add(box([-w * 0.85, low - 0.02, -h - 0.01], [w * 0.85, low + 0.1, h + 0.01]), dark)
    soup.add(box([-w * 0.6, low + 0.2, h - 0.1], [w * 0.6, hood * 0.72, h + 0.005]), dark)
    return soup


def truck(rng: np.random.Generator, paint: int, cargo: int, glass: int, dark: int, lamps: tuple[int, int, int]) -> Soup:
    """Return a truck, bus or tanker, front toward +z, standing on y = 0, its center at the origin."""
    soup = Soup()
    length, height, w = rng.uniform(6, 14), rng.uniform(2.7, 3.9), rng.uniform(1.15, 1.28)
    h = length / 2
    kind = rng.choice(["box", "tank", "bus", "bed"])
    cab = 2.1 if kind != "bus" else length
    deck = rng.uniform(0.8, 1.15) if kind != "bus" else 0.35
    cab_height = height if kind == "bus" else rng.uniform(2.4, 3.3)
    soup.add(box([-w, 0.45, h - cab], [w, cab_height, h]), paint)
    soup.add(box([-w * 0.92, cab_height * 0.52, h - 0.1], [w * 0.92, cab_height * 0.87, h + 0.01]), glass)
    panes = 1 if kind != "bus" else int(length / 1.6)
    for i in range(panes):
        step = (cab - 0.3) / panes
        z1 = h - 0.2 - i * step
        soup.add(box([-w - 0.01, cab_height * 0.5, z1 - step * 0.85], [w + 0.01, cab_height * 0.85, z1]), glass)
    if kind == "bus":
        soup.add(box([-w * 0.8, height * 0.5, -h - 0.01], [w * 0.8, height * 0.85, -h + 0.1]), glass)
    else:
        soup.add(box([-w * 0.45, 0.55, -h], [w * 0.45, deck, h - cab]), dark)
        if kind == "box":
            soup.add(box([-w, deck, -h], [w, height, h - cab - 0.3]), cargo)
            soup.add(box([-0.02, deck, -h - 0.02], [0.02, height, -h]), dark)
        elif kind == "tank":
            r = (height - deck) / 2
            z = np.linspace(-h, h - cab - 0.4, 8)
            radius = r * np.array([0.75, 0.97, 1, 1, 1, 1, 0.97, 0.75])
            soup.add(tube(np.stack([np.zeros(8), np.full(8, deck + r), z], 1), radius, 18), cargo)
            for end in (z[0], z[-1]):
                soup.add(ellipsoid([0, deck + r, end], [r * 0.75, r * 0.75, 0.2], 6, 14), cargo)
        else:
            top = deck + rng.uniform(0.4, 1.0)
            soup.add(box([-w, deck, -h], [w, top, h - cab - 0.2]), cargo)
            soup.add(ellipsoid([0, top, (h - cab - h) / 2], [w * 0.9, rng.uniform(0.1, 0.8), h * 0.6]), dark)
    axles = [h - 1.2, -h + 1.2, -h + 2.4] if length > 9 else [h - 1.2, -h + 1.5]
    for z in axles:
        for side in (-1, 1):
            a = np.linspace(0, 2 * np.pi, 13)[:-1]
            r = 0.5
            rim = np.stack([np.full(12, side * (w + 0.01)), r + r * np.sin(a), z + r * np.cos(a)], 1)
            inner = rim - [side * 0.4, 0, 0]
            hub = np.array([side * (w + 0.01), r, z])
            soup.add(quads(rim, np.roll(rim, -1, 0), np.roll(inner, -1, 0), inner), dark)
            soup.add(np.stack([np.broadcast_to(hub, rim.shape), rim, np.roll(rim, -1, 0)], 1), dark)
            soup.add(
                np.stack(
                    [
                        np.broadcast_to(np.add(hub, [side * 0.01, 0, 0]), rim.shape),
                        hub + (rim - hub) * 0.5 + [side * 0.01, 0, 0],
                        np.roll(hub + (rim - hub) * 0.5 + [side * 0.01, 0, 0], -1, 0),
                    ],
                    1,
                ),
                cargo,
                tint=0.6,
            )
    for side in (-1, 1):
        soup.add(box([side * w * 0.8 - 0.2, 0.7, -h - 0.04], [side * w * 0.8 + 0.2, 0.86, -h]), lamps[0])
        soup.add(box([side * w * 0.8 - 0.2, 0.6, h], [side * w * 0.8 + 0.2, 0.85, h + 0.03]), lamps[1])
    soup.add(box([-0.26, 0.55, -h - 0.05], [0.26, 0.67, -h]), lamps[2])
    if rng.uniform() < 0.4:
        soup.add(box([-w, 0.95, -h - 0.03], [w, 1.2, -h - 0.01]), lamps[0])
    return soup


def person(rng: np.random.Generator, cloth: tuple[int, int], skin: int, bicycle: int | None = None) -> Soup:
    """Return a pedestrian, or a cyclist where a material for the bicycle is given."""
    soup = Soup()
    s = rng.uniform(0.9, 1.08)
    lift = 0.25 if bicycle is not None else 0.0
    step = rng.uniform(0.05, 0.3)
    soup.add(tube([[0.09, lift, step], [0.09, 0.5 + lift, 0.05], [0.08, 0.9 + lift, 0]], [0.06, 0.07, 0.09]), cloth[0])
    soup.add(
        tube([[-0.09, lift, -step], [-0.09, 0.5 + lift, 0.0], [-0.08, 0.9 + lift, 0]], [0.06, 0.07, 0.09]), cloth[0]
    )
    soup.add(ellipsoid([0, 1.15 + lift, 0], [0.21, 0.34, 0.14]), cloth[1])
    for side in (-1, 1):
        soup.add(
            tube(
                [[side * 0.22, 1.4 + lift, 0], [side * 0.27, 1.1 + lift, 0.05], [side * 0.25, 0.85 + lift, 0.15]], 0.045
            ),
            cloth[1],
        )
    soup.add(ellipsoid([0, 1.63 + lift, 0], [0.1, 0.13, 0.11]), skin)
    if bicycle is not None:
        a = np.linspace(0, 2 * np.pi, 15)
        for z in (-0.52, 0.52):
            soup.add(tube(np.stack([np.zeros(15), 0.34 + 0.33 * np.sin(a), z + 0.33 * np.cos(a)], 1), 0.02, 4), bicycle)
        soup.add(tube([[0, 0.34, -0.52], [0, 0.85, -0.2], [0, 0.8, 0.4], [0, 0.34, 0.52]], 0.022, 4), bicycle)
        soup.add(tube([[-0.28, 1.0, 0.38], [0.28, 1.0, 0.38]], 0.02, 4), bicycle)
    out = Soup()
    out.place(soup, np.zeros(3, np.float32), size=s)
    return out
