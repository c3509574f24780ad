"""Random streets: suburbs, towns, avenues, highways and country roads, built as triangle soups around a curved road."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import meshes as m
import numpy as np
from meshes import Array, Materials, Soup

SURFACES = (
    "noise_fine",
    "noise_coarse",
    "noise_streak",
    "asphalt",
    "grass",
    "gravel",
    "brick",
    "concrete",
    "stucco",
    "wood",
    "tiles",
)


@dataclass
class Light:
    """Sun, sky and air of a scene; colors are linear RGB."""

    sun: Array
    """Direction toward the sun."""
    sun_color: Array
    """Irradiance; zeros under an overcast sky."""
    sky_color: Array
    horizon_color: Array
    clouds: float
    cloud_offset: Array
    fog: float
    """Extinction per meter."""


class Road:
    """A road in space: distance along it and sideways offset to world coordinates."""

    def __init__(self, rng: np.random.Generator, straight: bool) -> None:
        self.step, self.start, self.end = 2.0, -40.0, 320.0
        self.s = np.arange(self.start, self.end + 1, self.step)
        knots = np.arange(self.start - 60, self.end + 61, rng.uniform(40, 90))
        bend = 1 / 500 if straight else 1 / rng.choice([60.0, 90.0, 160.0, 300.0])
        k = rng.normal(0, 0.6, len(knots)) * bend * (rng.uniform(size=len(knots)) < 0.6)
        curvature = np.interp(self.s, knots, k).clip(-1 / 45, 1 / 45)
        heading = np.cumsum(curvature) * self.step
        self.heading = heading - np.interp(0, self.s, heading)
        x, z = np.cumsum(np.sin(self.heading)) * self.step, np.cumsum(np.cos(self.heading)) * self.step
        slope = rng.choice([0.002, 0.012, 0.04], p=[0.4, 0.4, 0.2])
        grade = np.interp(self.s, knots, rng.normal(0, slope, len(knots)))
        grade = np.convolve(np.pad(grade, 8, "edge"), np.ones(17) / 17, "valid")
        y = np.cumsum(grade) * self.step
        self.point = np.stack([a - np.interp(0, self.s, a) for a in (x, y, z)], 1)

    def at(self, s: object, d: object, h: object = 0.0) -> Array:
        """Return world points, n 3, at distance s along the road, d meters to its right, h above it."""
        s, d, h = np.broadcast_arrays(np.asarray(s, float), np.asarray(d, float), np.asarray(h, float))
        a = self.yaw(s)
        base = [np.interp(s, self.s, self.point[:, i]) for i in range(3)]
        return np.stack([base[0] + d * np.cos(a), base[1] + h, base[2] - d * np.sin(a)], -1).astype(np.float32)

    def yaw(self, s: object) -> NDArrayLike:
        """Return the road's heading in radians, clockwise seen from above."""
        return np.interp(s, self.s, self.heading)


NDArrayLike = np.ndarray


class Street:
    """One random scene: ``soup``, ``materials``, ``road``, ``light`` and where cameras may drive."""

    def __init__(
        self, rng: np.random.Generator, assets: object = None, textures: dict[str, list[int]] | None = None
    ) -> None:
        self.rng, self.soup, self.materials, self.assets = rng, Soup(), Materials(), assets
        self.textures = textures or {name: [0] for name in SURFACES}
        self.kind = str(
            rng.choice(["suburb", "town", "avenue", "highway", "country", "jam"], p=[0.3, 0.2, 0.18, 0.1, 0.1, 0.12])
        )
        self.road = Road(rng, straight=self.kind in ("highway", "jam") or rng.uniform() < 0.5)
        self.trees: dict[tuple[float, float, bool], list[Soup]] = {}
        self._palette()
        self._light()
        self._ground()
        for side in (-1, 1):
            self._side(side)
        self._traffic()
        self._background()
        if rng.uniform() < (0.35 if self.kind in ("highway", "jam") else 0.06):
            self._overpass()

    # ---- materials and light -------------------------------------------------------------------------------------

    def _texture(self, *names: str) -> int:
        return int(self.rng.choice(self.textures[str(self.rng.choice(names))]))

    def _material(
        self,
        color: object,
        *names: str,
        kind: int = m.PLAIN,
        scale: float | None = None,
        contrast: float | None = None,
        params: object = (),
    ) -> int:
        rng = self.rng
        c = np.asarray(color, float) * rng.uniform(0.75, 1.3) * rng.uniform(0.9, 1.1, 3)
        return self.materials.add(
            c.clip(0.004, 0.9),
            kind,
            self._texture(*(names or ("noise_fine", "noise_coarse"))),
            scale or rng.uniform(1.0, 5.0),
            contrast if contrast is not None else rng.uniform(0.5, 1.4),
            params,
        )

    def _wall_color(self) -> Array:
        rng = self.rng
        base = [
            (0.75, 0.72, 0.66),
            (0.7, 0.6, 0.42),
            (0.35, 0.15, 0.1),
            (0.5, 0.5, 0.48),
            (0.6, 0.42, 0.32),
            (0.25, 0.22, 0.2),
            (0.82, 0.82, 0.8),
            (0.4, 0.44, 0.5),
        ]
        return np.asarray(base[rng.integers(len(base))], np.float32) * rng.uniform(0.8, 1.15)

    def _paint(self) -> int:
        rng = self.rng
        colors = [
            (0.02, 0.02, 0.025),
            (0.05, 0.055, 0.06),
            (0.35, 0.36, 0.37),
            (0.2, 0.21, 0.22),
            (0.75, 0.75, 0.75),
            (0.3, 0.02, 0.02),
            (0.02, 0.05, 0.2),
            (0.03, 0.12, 0.06),
            (0.4, 0.3, 0.1),
            (0.1, 0.2, 0.35),
        ]
        p = np.array([3, 3, 3, 3, 2.5, 1.3, 1.5, 0.5, 0.5, 0.7])
        color = np.asarray(colors[rng.choice(len(colors), p=p / p.sum())])
        return self._material(color, "noise_coarse", kind=m.GLOSS, contrast=0.15)

    def _palette(self) -> None:
        rng, add = self.rng, self._material
        season = rng.choice(["summer", "autumn", "dry"], p=[0.7, 0.15, 0.15])
        green = {"summer": (0.045, 0.085, 0.02), "autumn": (0.11, 0.075, 0.02), "dry": (0.085, 0.085, 0.035)}[season]
        bright = np.exp(rng.uniform(np.log(0.7), np.log(2.5)))  # some cameras see leaves lighter than the sky
        self.leaf = [
            add(np.asarray(green) * bright * rng.uniform(0.6, 1.7) * rng.uniform(0.8, 1.2, 3), kind=m.LEAF)
            for _ in range(4)
        ]
        self.bark = [add((0.09, 0.07, 0.05), "wood", "noise_streak", "gravel", scale=1.0) for _ in range(2)] + [
            add((0.22, 0.2, 0.16), "noise_coarse", scale=0.8)
        ]
        self.grass = [
            add(
                np.asarray(
                    {"summer": (0.09, 0.13, 0.035), "autumn": (0.14, 0.13, 0.05), "dry": (0.2, 0.17, 0.08)}[season]
                ),
                "grass",
                "noise_fine",
                "grass",
            )
            for _ in range(3)
        ]
        self.soil = add((0.16, 0.12, 0.08), "gravel", "noise_coarse")
        self.pavement = [add((0.3, 0.29, 0.27), "concrete", "tiles", "gravel", "noise_fine") for _ in range(2)] + [
            add((0.24, 0.14, 0.11), "brick", "tiles", scale=1.6)
        ]
        self.curb = add((0.35, 0.34, 0.32), "concrete", "noise_fine", scale=1.2)
        self.asphalt = np.asarray((0.14, 0.14, 0.145)) * rng.uniform(0.5, 2.0)
        self.concrete = add((0.4, 0.39, 0.37), "concrete", "stucco", "noise_coarse")
        self.metal = add((0.3, 0.31, 0.32), "noise_streak", contrast=0.4, kind=m.GLOSS)
        self.dark_metal = add((0.03, 0.035, 0.03), "noise_fine", contrast=0.4)
        self.wood = [add((0.2, 0.12, 0.07), "wood", scale=1.2) for _ in range(2)]
        self.white = add((0.7, 0.7, 0.7), "noise_fine", contrast=0.3)
        self.glass = self.materials.add((0.02, 0.022, 0.025), m.GLASS)
        self.tire = add((0.015, 0.015, 0.016), "noise_fine", contrast=0.4)
        self.lamps = (
            self.materials.add((0.45, 0.02, 0.015), m.LIGHT, params=[rng.uniform(0, 0.5)]),
            self.materials.add((0.6, 0.6, 0.58), m.GLOSS),
            add((0.7, 0.7, 0.66), contrast=0.1),
        )
        self.cloth = [add(rng.uniform(0.02, 0.5, 3) ** 1.5, contrast=0.4) for _ in range(6)]
        self.skin = add((0.35, 0.22, 0.16), contrast=0.2)
        self.signs = [
            add(c, contrast=0.15)
            for c in ((0.7, 0.7, 0.7), (0.5, 0.03, 0.03), (0.03, 0.12, 0.45), (0.6, 0.45, 0.03), (0.03, 0.2, 0.1))
        ]

    def _light(self) -> None:
        rng = self.rng
        high, around = np.deg2rad(rng.uniform(12, 70)), rng.uniform(0, 2 * np.pi)
        sun = np.array([np.cos(high) * np.sin(around), np.sin(high), np.cos(high) * np.cos(around)], np.float32)
        overcast = rng.uniform() < 0.3
        strength = 0.0 if overcast else rng.uniform(1.5, 4.5)
        warm = np.array([1.0, 0.95 - 0.25 * np.exp(-high * 4), 0.88 - 0.45 * np.exp(-high * 4)])
        sky = np.array([0.45, 0.62, 1.0]) if not overcast else np.array([0.85, 0.92, 1.0]) * rng.uniform(0.7, 1.2)
        horizon = (sky * 0.5 + 0.7) * rng.uniform(0.8, 1.6)
        fog = 0.0 if rng.uniform() < 0.4 else rng.choice([0.0006, 0.0015, 0.004, 0.01], p=[0.4, 0.35, 0.2, 0.05])
        self.light = Light(
            sun,
            (warm * strength).astype(np.float32),
            (sky * rng.uniform(0.25, 1.2)).astype(np.float32),
            horizon.astype(np.float32),
            float(rng.uniform(0, 1)),
            rng.uniform(0, 50, 2).astype(np.float32),
            float(fog),
        )

    # ---- ground --------------------------------------------------------------------------------------------------

    def _ground(self) -> None:
        rng = self.rng
        highway = self.kind == "highway"
        self.lane = rng.uniform(3.4, 3.9) if highway else rng.uniform(2.7, 3.6)
        right_lanes = (
            int(rng.choice([0, 1, 2], p=[0.3, 0.4, 0.3]))
            if self.kind in ("highway", "jam")
            else int(rng.choice([0, 1], p=[0.85, 0.15]))
        )
        left_same = int(rng.choice([0, 1, 2], p=[0.4, 0.4, 0.2])) if self.kind in ("highway", "jam", "avenue") else 0
        divided = self.kind in ("highway", "avenue", "jam") and rng.uniform() < 0.7
        opposite = int(rng.choice([1, 2])) if self.kind in ("highway", "jam", "avenue") else 1
        if self.kind in ("suburb", "town") and rng.uniform() < 0.15:
            opposite = 0  # a one-way street
        lane = self.lane
        self.edges = {1: lane * (0.5 + right_lanes) + rng.uniform(0, 0.5)}
        own_left = -lane * (0.5 + left_same)
        median = rng.uniform(1.5, 6) if divided else 0.0
        self.edges[-1] = -(own_left - median - lane * opposite) + rng.uniform(0, 0.5)
        self.lanes = [(lane * i, 1) for i in range(-left_same, right_lanes + 1)]
        self.lanes += [(own_left - median - lane * (i + 0.5), -1) for i in range(opposite)]
        marked = rng.uniform() < (0.4 if self.kind == "suburb" else 0.9)
        lines: list[tuple[float, int]] = []
        if marked:
            lines += [(lane * (i + 0.5), 2) for i in range(-left_same, right_lanes)]
            lines += [(own_left, 1 if divided or rng.uniform() < 0.3 else 2)]
            if rng.uniform() < 0.6:
                lines += [(self.edges[1] - 0.3, 1)]
            if rng.uniform() < 0.5:
                lines += [(-self.edges[-1] + 0.3, 1)]
        lines = lines[:5] + [(0.0, 0)] * (5 - len(lines[:5]))
        params = [a for a, _ in lines] + [k for _, k in lines] + [rng.uniform(2, 6), rng.uniform(5, 12)]
        road = self._material(
            self.asphalt,
            "asphalt",
            "gravel",
            "noise_fine",
            kind=m.ROAD,
            scale=rng.uniform(1.5, 4),
            contrast=rng.uniform(0.05, 0.7),
            params=params,
        )
        self.plain_asphalt = self._material(self.asphalt, "asphalt", "noise_coarse", contrast=rng.uniform(0.3, 0.9))
        profile: list[tuple[float, float, int]] = []
        self.zones: dict[int, dict[str, tuple[float, float]]] = {}
        raised = self.kind not in ("highway", "country") and rng.uniform() < 0.85
        for side in (-1, 1):
            d, h = self.edges[side], 0.0
            strips: list[tuple[float, float, int]] = []
            zones: dict[str, tuple[float, float]] = {}

            def strip(width: float, rise: float, material: int, name: str = "") -> None:
                nonlocal d, h
                if name:
                    zones[name] = (d, d + width)  # noqa: B023
                    self.height[side, name] = h + rise  # noqa: B023
                d, h = d + width, h + rise
                strips.append((d, h, material))  # noqa: B023

            self.height = getattr(self, "height", {})
            if self.kind in ("suburb", "town") and rng.uniform() < 0.5:
                strip(
                    rng.uniform(1.9, 2.4),
                    0.0,
                    int(rng.choice([self.plain_asphalt, self.pavement[0], self.pavement[2]])),
                    "parking",
                )
            if raised:
                strip(0.02, rng.uniform(0.06, 0.16), self.curb)
                strip(rng.uniform(0.12, 0.3), 0.0, self.curb)
            if (
                rng.uniform()
                < {"suburb": 0.4, "town": 0.25, "avenue": 0.85, "highway": 1.0, "country": 1.0, "jam": 0.8}[self.kind]
            ):
                rise = rng.normal(0, 0.1) if self.kind not in ("highway", "country") else rng.normal(0, 0.8)
                strip(
                    rng.uniform(1.2, 12.0 if rng.uniform() < 0.3 else 8.0 if self.kind == "avenue" else 4.5),
                    rise,
                    int(rng.choice([*self.grass, self.soil], p=[0.3, 0.3, 0.3, 0.1])),
                    "verge",
                )
            if self.kind in ("suburb", "town", "avenue", "jam") and rng.uniform() < 0.9:
                strip(rng.uniform(1.3, 3.5), 0.0, int(rng.choice(self.pavement)), "sidewalk")
            setback = {
                "suburb": rng.uniform(0.5, 9),
                "town": rng.choice([0.0, rng.uniform(0, 4)]),
                "avenue": rng.uniform(1, 14),
                "highway": rng.uniform(6, 30),
                "country": rng.uniform(3, 40),
                "jam": rng.uniform(2, 15),
            }[self.kind]
            ground = int(
                rng.choice([*self.grass, self.plain_asphalt, self.pavement[0]], p=[0.27, 0.27, 0.26, 0.1, 0.1])
            )
            if setback > 0.3:
                strip(setback, rng.normal(0, 0.04) * setback, ground, "front")
            zones["back"] = (d, d + 60)
            self.height[side, "back"] = h
            strip(12, 0.0, ground)
            strip(60, rng.normal(0, 2.5), int(rng.choice(self.grass)))
            strip(500, rng.normal(0, 6), int(rng.choice([*self.grass, self.soil])))
            self.zones[side] = zones
            if side < 0:
                profile = [(-a, b, c) for a, b, c in reversed(strips)] + [(-self.edges[-1], 0.0, road)]
            else:
                profile += [(self.edges[1], 0.0, road), *strips]
        # materials of the left side belong to the strip on the outer side of each point, those of the right likewise
        left = [p for p in profile if p[0] <= -self.edges[-1]]
        right = [p for p in profile if p[0] >= self.edges[1]]
        s = self.road.s
        for points, side in ((left[::-1], -1), (right, 1)):
            for (d0, h0, _), (d1, h1, material) in pairwise(points):
                self._strip(s, d0, h0, d1, h1, material, side)
        self._strip(s, -self.edges[-1], 0.0, self.edges[1], 0.0, road, 1)
        if divided:
            material = int(rng.choice([*self.grass, self.concrete]))
            left_edge = own_left - median
            top = rng.uniform(0.08, 0.2)
            self._strip(s, left_edge + 0.2, top, own_left - 0.2, top, material, 1)
            for d0 in (left_edge + 0.2, own_left - 0.2):
                self._strip(s, d0, -0.1, d0 + 0.01, top, self.curb, 1)
            self.median: tuple[float, float] | None = (left_edge + 0.3, own_left - 0.3)
            if self.kind == "highway" and rng.uniform() < 0.7:
                self._rail((left_edge + own_left) / 2, top)
            elif rng.uniform() < 0.5:
                self._row((left_edge + own_left) / 2, top, rng.uniform(7, 20), "tree" if median > 2.5 else "bush")
            if rng.uniform() < 0.5:
                self._row((left_edge + own_left) / 2, top, rng.uniform(25, 45), "lamp")

    def _strip(self, s: Array, d0: float, h0: float, d1: float, h1: float, material: int, side: int) -> None:
        a, b = self.road.at(s, d0, h0), self.road.at(s, d1, h1)
        triangles = m.quads(a[:-1], b[:-1], b[1:], a[1:])
        ua = np.stack([np.full(len(s), d0 + h0), s], 1)
        ub = np.stack([np.full(len(s), d1 + h1), s], 1)
        uv = np.concatenate([np.stack([ua[:-1], ub[:-1], ub[1:]], 1), np.stack([ua[:-1], ub[1:], ua[1:]], 1)])
        self.soup.add(triangles, material, uv)

    # ---- what stands beside the road -------------------------------------------------------------------------------

    def _put(self, part: Soup, s: float, d: float, h: float, yaw: float = 0.0, size: object = 1.0) -> None:
        self.soup.place(part, self.road.at(s, d, h), float(self.road.yaw(s)) + yaw, size)

    def _car(self) -> Soup:
        rng = self.rng
        if self.assets is not None and rng.uniform() < 0.25:
            return self.assets.car(rng, self)  # type: ignore[attr-defined]
        shape = str(rng.choice(["hatch", "wagon", "sedan", "suv", "van"], p=[0.32, 0.24, 0.16, 0.16, 0.12]))
        return m.car(rng, self._paint(), self.glass, self.tire, self.lamps, shape)

    def _truck(self) -> Soup:
        cargo = self._material(
            self._wall_color(),
            "noise_streak",
            "noise_coarse",
            kind=m.GLOSS if self.rng.uniform() < 0.5 else m.PLAIN,
            contrast=0.5,
        )
        return m.truck(self.rng, self._paint(), cargo, self.glass, self.tire, self.lamps)

    def _tree(self, height: float, detail: float = 1.0, young: bool = False) -> Soup:
        """Return a tree; a scene has a few of each size and detail, which are turned and scaled."""
        rng = self.rng
        key = (round(np.log(height) * 2), detail, young)
        grown = self.trees.setdefault(key, [])
        if len(grown) < 3 or (detail >= 2 and len(grown) < 4):
            bark, leaf = int(rng.choice(self.bark)), int(rng.choice(self.leaf))
            if young:
                grown.append(m.young_tree(rng, bark, leaf, int(rng.choice(self.bark)), height, detail))
                return grown[-1]
            maker = m.conifer if rng.uniform() < 0.15 else m.tree
            grown.append(maker(rng, bark, leaf, height, detail))
        out = Soup()
        out.place(
            grown[rng.integers(len(grown))], np.zeros(3, np.float32), rng.uniform(0, 6.3), rng.uniform(0.8, 1.2, 3)
        )
        return out

    def _lamp(self, side: int) -> Soup:
        rng = self.rng
        soup, height = Soup(), rng.uniform(4, 11)
        material = int(rng.choice([self.metal, self.dark_metal, self.concrete]))
        arm = -side * rng.uniform(0, 2.5)
        soup.add(
            m.tube(
                [[0, 0, 0], [0, height * 0.6, 0], [0, height, 0], [arm, height + 0.2, 0]],
                [rng.uniform(0.06, 0.14), 0.07, 0.05, 0.045],
                6,
            ),
            material,
        )
        soup.add(m.box([arm - 0.35, height + 0.1, -0.15], [arm + 0.35, height + 0.3, 0.15]), material)
        return soup

    def _sign(self) -> Soup:
        rng = self.rng
        soup, height = Soup(), rng.uniform(1.8, 3.0)
        soup.add(m.tube([[0, 0, 0], [0, height, 0]], 0.035, 5), self.metal)
        front, size = int(rng.choice(self.signs)), rng.uniform(0.25, 0.5)
        y = height - size
        if rng.uniform() < 0.5:
            a = np.linspace(0, 2 * np.pi, int(rng.choice([4, 9, 13])))[:-1] + rng.choice([0, np.pi / 2])
            for scale, back, material in ((1.0, 0.0, front), (0.75, -0.012, self.signs[0])):
                rim = np.stack(
                    [scale * size * np.cos(a), y + scale * size * np.sin(a), np.full(len(a), -0.05 + back)], 1
                )
                soup.add(
                    np.stack([np.broadcast_to([0, y, -0.05 + back], rim.shape), rim, np.roll(rim, -1, 0)], 1), material
                )
        else:
            soup.add(m.box([-size * 1.2, y - size * 0.7, -0.06], [size * 1.2, y + size * 0.7, -0.03]), front)
        return soup

    def _billboard(self) -> Soup:
        rng, soup = self.rng, Soup()
        w, h, lift = rng.uniform(1, 3.5), rng.uniform(0.8, 2.6), rng.uniform(0.4, 3.5)
        for x in (-w * 0.4, w * 0.4):
            soup.add(m.tube([[x, 0, 0], [x, lift + h, 0]], 0.06, 5), self.dark_metal)
        soup.add(
            m.box([-w / 2, lift, -0.08], [w / 2, lift + h, 0.02]),
            self._material(rng.uniform(0.05, 0.7, 3), "noise_coarse", "tiles", "noise_streak", scale=w),
        )
        return soup

    def _clutter(self) -> Soup:
        """Return something small of any shape: bins, boxes, stones, pots, cones, bollards."""
        rng, soup = self.rng, Soup()
        material = self._material(rng.uniform(0.02, 0.6, 3), *SURFACES, scale=rng.uniform(0.3, 1.5))
        size = rng.uniform(0.15, 0.8, 3)
        kind = rng.integers(4)
        if kind == 0:
            soup.add(m.box([-size[0], 0, -size[2]], [size[0], size[1] * 1.8, size[2]]), material)
        elif kind == 1:
            soup.add(m.ellipsoid([0, size[1] * 0.7, 0], size), material)
        elif kind == 2:
            soup.add(
                m.tube([[0, 0, 0], [0, size[1] * 2, 0]], [size[0] * 0.5, size[0] * rng.uniform(0.05, 0.5)], 9), material
            )
        else:
            soup.add(m.tube([[0, 0, 0], [0, rng.uniform(0.5, 1.2), 0]], 0.07, 7), self.metal)
        return soup

    def _row(self, d: float, h: float, gap: float, what: str, side: int = 1, chance: float = 0.9) -> None:
        rng = self.rng
        young = what == "tree" and rng.uniform() < 0.5
        height, shared = rng.uniform(2.5, 7) if young else rng.uniform(4, 13), None
        for s in np.arange(self.road.start + 10 + rng.uniform(0, gap), 200, gap):
            if rng.uniform() > chance or self._blocked(s, 2.0, side):
                continue
            at = s + rng.normal(0, 0.05 * gap)
            detail = 2.5 if s < 40 else 1.0 if s < 90 else 0.4
            if what == "tree":
                self._put(
                    self._tree(height * rng.uniform(0.8, 1.25), detail, young),
                    at,
                    d + rng.normal(0, 0.2),
                    h,
                    rng.uniform(0, 6.3),
                )
            elif what == "bush":
                self._put(
                    m.bush(
                        rng,
                        int(rng.choice(self.leaf)),
                        rng.uniform(0.8, 3),
                        rng.uniform(0.4, 1.6),
                        rng.uniform(0.5, 1.5),
                        False,
                    ),
                    at,
                    d,
                    h,
                )
            elif what == "lamp":
                shared = shared or self._lamp(side)
                self._put(shared, at, d, h)

    def _blocked(self, s: float, margin: float, side: int) -> bool:
        return (
            any(a - margin < s < b + margin for a, b in self.openings.get(side, ()))
            if hasattr(self, "openings")
            else False
        )

    def _rail(self, d: float, h: float) -> None:
        s = np.arange(self.road.start, 240, 4.0)
        for up0, up1, back in ((0.45, 0.62, 0.0), (0.62, 0.78, 0.05)):
            a, b = self.road.at(s, d + back, h + up0), self.road.at(s, d - back, h + up1)
            self.soup.add(m.quads(a[:-1], a[1:], b[1:], b[:-1]), self.metal)
        for at in s[::1]:
            p = self.road.at(at, d, h)
            self.soup.add(m.box(p - [0.05, 0.1, 0.05], np.add(p, [0.05, 0.7, 0.05])), self.metal)

    def _side(self, side: int) -> None:
        rng, zones = self.rng, self.zones[side]
        if not hasattr(self, "openings"):
            self.openings: dict[int, list[tuple[float, float]]] = {}
        self.openings[side] = []
        if self.kind not in ("highway",):
            s = rng.uniform(-20, 60)
            while s < 220:
                width = rng.uniform(3, 11)
                self.openings[side].append((s, s + width))
                a = np.array([s, s + width])
                d0, d1, h = self.edges[side], self.edges[side] + 80, self.height[side, "back"]
                d = np.linspace(d0, d1, 12)
                up = np.interp(d, [d0, zones["back"][0], d1], [0.01, h + 0.04, h + 0.1])
                left, right = self.road.at(a[0], side * d, up), self.road.at(a[1], side * d, up)
                material = (
                    self.plain_asphalt
                    if width > 5
                    else int(rng.choice([self.pavement[0], self.plain_asphalt, self.soil]))
                )
                self.soup.add(m.quads(left[:-1], right[:-1], right[1:], left[1:]), material)
                s += width + rng.uniform(15, 90)

        def span(name: str) -> tuple[float, float, float] | None:
            if name not in zones:
                return None
            a, b = zones[name]
            return side * a, side * b, self.height[side, name]

        def middle(z: tuple[float, float, float], f: float = 0.5) -> float:
            return z[0] + f * (z[1] - z[0])

        parking, verge, walk, front = (span(n) for n in ("parking", "verge", "sidewalk", "front"))
        # parked cars: in the lane for them, or half on the curb, or at right angles on the front yards
        row = parking or (walk if walk and self.kind in ("suburb", "town") and rng.uniform() < 0.25 else None)
        if row:
            full = rng.uniform(0.15, 0.95)
            d = middle(row) if parking else side * (self.edges[side] + rng.uniform(0.2, 1.0))
            s = rng.uniform(-15, 0)
            while s < 130:
                if rng.uniform() < full and not self._blocked(s, 3, side):
                    facing = 0 if (side > 0) == (rng.uniform() < 0.92) else np.pi
                    part = self._car() if rng.uniform() < 0.95 else self._truck()
                    self._put(
                        part, s, d + rng.normal(0, 0.1), row[2] if parking else 0.05, facing + rng.normal(0, 0.02)
                    )
                s += rng.uniform(5.2, 7.0)
        if front and abs(front[1] - front[0]) > 5.5 and rng.uniform() < 0.3:
            for s in np.arange(rng.uniform(-10, 5), 110, rng.uniform(2.6, 5)):
                if rng.uniform() < 0.45 and not self._blocked(s, 2, side):
                    self._put(
                        self._car(),
                        s,
                        middle(front, rng.uniform(0.45, 0.6)),
                        front[2],
                        np.pi / 2 * rng.choice([-1, 1]) + rng.normal(0, 0.04),
                    )
        if verge and abs(verge[1] - verge[0]) > 1.0:
            tall = (
                rng.uniform()
                < {"suburb": 0.5, "town": 0.7, "avenue": 0.9, "highway": 0.3, "country": 0.45, "jam": 0.7}[self.kind]
            )
            if tall:
                self._row(middle(verge, rng.uniform(0.3, 0.7)), verge[2], rng.uniform(5, 16), "tree", side)
                if rng.uniform() < 0.3:
                    self._row(middle(verge, rng.uniform(0.1, 0.9)), verge[2], rng.uniform(8, 30), "tree", side)
            if rng.uniform() < 0.25:
                self._row(middle(verge), verge[2], rng.uniform(2, 9), "bush", side)
        strip = verge or walk or front
        if strip:
            if rng.uniform() < (0.75 if self.kind != "country" else 0.3):
                self._row(middle(strip, 0.15), strip[2], rng.uniform(18, 45), "lamp", side)
            for _ in range(int(rng.integers(0, 9))):
                part = self._sign() if rng.uniform() < 0.75 else self._billboard()
                self._put(
                    part,
                    rng.uniform(0, 110),
                    middle(strip, rng.uniform(0.05, 0.9)),
                    strip[2],
                    rng.normal(0, 0.25) + (np.pi if rng.uniform() < 0.25 else 0),
                )
            for _ in range(int(rng.integers(0, 12))):
                self._put(
                    self._clutter(),
                    rng.uniform(-2, 70),
                    middle(strip, rng.uniform(0.1, 0.95)),
                    strip[2],
                    rng.uniform(0, 6.3),
                )
        if walk:
            for _ in range(int(rng.integers(0, 8)) if self.kind != "highway" else 0):
                bike = int(self.dark_metal) if rng.uniform() < 0.3 else None
                part = m.person(rng, (int(rng.choice(self.cloth)), int(rng.choice(self.cloth))), self.skin, bike)
                self._put(
                    part,
                    rng.uniform(4, 80),
                    middle(walk, rng.uniform(0.2, 0.8)),
                    walk[2],
                    rng.choice([0, np.pi]) + rng.normal(0, 0.3),
                )
        if self.kind in ("highway", "country") and rng.uniform() < 0.5:
            self._rail(side * (self.edges[side] + 0.6), 0.0)
        if rng.uniform() < 0.2:
            self._wires(side)
        if front:
            self._fence(side, middle(front, rng.choice([0.02, 0.1, 0.4])), front[2])
            for _ in range(int(rng.integers(0, 14))):
                d = middle(front, rng.uniform(0.1, 0.95))
                s = rng.uniform(-5, 110)
                if self._blocked(s, 2, side):
                    continue
                roll = rng.uniform()
                part = (
                    self._tree(rng.uniform(2, 9), 2.5 if s < 40 else 1.0, rng.uniform() < 0.4)
                    if roll < 0.5 and abs(front[1] - front[0]) > 2
                    else m.bush(
                        rng,
                        int(rng.choice(self.leaf)),
                        rng.uniform(0.8, 4),
                        rng.uniform(0.5, 2.2),
                        rng.uniform(0.6, 2),
                        False,
                    )
                )
                self._put(part, s, d, front[2])
        self._frontage(side)

    def _wires(self, side: int) -> None:
        rng = self.rng
        d, h, gap = side * (self.edges[side] + rng.uniform(0.8, 3)), rng.uniform(6, 9), rng.uniform(28, 45)
        at = np.arange(self.road.start, 240, gap) + rng.uniform(0, 10)
        material = int(rng.choice([self.wood[0], self.concrete, self.metal]))
        for s in at:
            p = self.road.at(s, d, 0)
            self.soup.add(m.tube([p - [0, 0.3, 0], np.add(p, [0, h, 0])], [0.15, 0.1], 6), material)
            arm = (self.road.at(s, d + 1, 0) - p) * [1, 0, 1]
            self.soup.add(m.tube([p - arm * 0.9 + [0, h - 0.4, 0], p + arm * 0.9 + [0, h - 0.4, 0]], 0.06, 4), material)
        for off in (-0.8, 0, 0.8):
            points = []
            for a, b in pairwise(at):
                t = np.linspace(0, 1, 6)[:-1]
                points.append(self.road.at(a + (b - a) * t, d + off, h - 0.3 - 4 * 0.6 * t * (1 - t)))
            self.soup.add(m.tube(np.concatenate(points), 0.025, 3), self.dark_metal)

    def _fence(self, side: int, d: float, h: float) -> None:
        rng = self.rng
        if rng.uniform() < 0.3 and self.kind not in ("suburb",):
            return
        s, kind = -15.0, None
        while s < 140:
            length = rng.uniform(6, 25)
            if kind is None or rng.uniform() < 0.4:
                kind = rng.choice(["hedge", "wall", "picket", "wire", "none"], p=[0.35, 0.2, 0.2, 0.1, 0.15])
                height = rng.uniform(0.5, 2.2)
                wall = self._material(
                    self._wall_color(), "brick", "stucco", "concrete", "gravel", scale=rng.uniform(1, 3)
                )
                leaf = int(rng.choice(self.leaf))
            e = s + length
            if not any(a < e and b > s for a, b in self.openings[side]):
                if kind == "hedge":
                    for a in np.arange(s, e - 1, 5.0):
                        self._put(m.bush(rng, leaf, 5.0, height, rng.uniform(0.6, 1.0), rng.uniform() < 0.7), a, d, h)
                elif kind == "wall":
                    self._wall(s, e, d, h, height, wall)
                elif kind in ("picket", "wire"):
                    material = int(rng.choice([self.wood[0], self.white, self.metal, self.dark_metal]))
                    gap, wide = (0.16, 0.05) if kind == "picket" else (1.5, 0.03)
                    at = np.arange(s, min(e, 70.0) if kind == "picket" else e, gap)
                    if len(at) > 1:
                        a, b = self.road.at(at - wide, d, h), self.road.at(at + wide, d, h)
                        up = np.array([0, height * 0.7, 0], np.float32)
                        self.soup.add(m.quads(a, b, b + up, a + up), material)
                    ends = np.arange(s, e + 0.1, (e - s) / 4)
                    for y in (0.25, 0.6) if kind == "picket" else (0.2, 0.4, 0.65):
                        p = self.road.at(ends, d + 0.03, h + y * height)
                        self.soup.add(
                            m.quads(p[:-1], p[1:], np.add(p[1:], [0, 0.06, 0]), np.add(p[:-1], [0, 0.06, 0])), material
                        )
            s = e + rng.choice([0.0, rng.uniform(1, 6)])

    def _wall(self, s0: float, s1: float, d: float, h: float, height: float, material: int) -> None:
        s = np.linspace(s0, s1, max(2, int((s1 - s0) / 4)))
        for e in (-0.12, 0.12):
            a, b = self.road.at(s, d + e, h - 0.3), self.road.at(s, d + e, h + height)
            ua, ub = np.stack([s, np.zeros_like(s)], 1), np.stack([s, np.full_like(s, height)], 1)
            uv = np.concatenate([np.stack([ua[:-1], ua[1:], ub[1:]], 1), np.stack([ua[:-1], ub[1:], ub[:-1]], 1)])
            self.soup.add(m.quads(a[:-1], a[1:], b[1:], b[:-1]), material, uv)
        a, b = self.road.at(s, d - 0.15, h + height), self.road.at(s, d + 0.15, h + height)
        self.soup.add(m.quads(a[:-1], b[:-1], b[1:], a[1:]), self.concrete)

    def _facade(self) -> int:
        rng = self.rng
        floor, spacing = rng.uniform(2.6, 3.6), rng.uniform(1.4, 4.5)
        wide = spacing * rng.uniform(0.25, 0.6 if rng.uniform() < 0.8 else 0.95)
        tall = floor * rng.uniform(0.35, 0.6)
        params = [
            floor,
            spacing,
            wide,
            tall,
            rng.uniform(0.7, 1.0),
            rng.choice([0.0, rng.uniform(0.04, 0.12)]),
            rng.uniform(0, 1),
            rng.uniform(0, 0.6),
            rng.uniform(0, 1000),
            rng.uniform(0.02, 0.8),
            rng.uniform(0, 1),
            rng.uniform(0, 0.5),
        ]
        return self._material(
            self._wall_color(),
            "brick",
            "stucco",
            "concrete",
            "noise_coarse",
            "noise_streak",
            kind=m.FACADE,
            scale=rng.uniform(1, 4),
            contrast=rng.uniform(0.1, 0.9),
            params=params,
        )

    def _building(self, width: float, depth: float, height: float, roof: str) -> Soup:
        """Return a building; its front is the plane x = 0, it extends to +x; z along the street."""
        rng, soup = self.rng, Soup()
        wall = self._facade()
        tile = self._material(
            rng.choice([[0.28, 0.1, 0.06], [0.1, 0.09, 0.09], [0.22, 0.16, 0.12], [0.33, 0.33, 0.33]]),
            "tiles",
            "brick",
            "noise_streak",
            scale=rng.uniform(1, 3),
        )
        w, e = width / 2, 1e-3
        for a, b in (((0, -w), (0, w)), ((0, w), (depth, w)), ((depth, -w), (0, -w))):
            length = float(np.hypot(a[0] - b[0], a[1] - b[1]))
            p = np.array(
                [[a[0], -1.0, a[1]], [b[0], -1.0, b[1]], [b[0], height, b[1]], [a[0], height, a[1]]], np.float32
            )
            off = rng.uniform(0, 0.3)
            u = np.array([[off, -1.0], [length + off, -1.0], [length + off, height], [off, height]], np.float32)
            soup.add(np.stack([p[[0, 1, 2]], p[[0, 2, 3]]]), wall, np.stack([u[[0, 1, 2]], u[[0, 2, 3]]]))
        if roof == "flat":
            soup.add(
                m.box([0, height - e, -w], [depth, height + rng.uniform(0.1, 0.9), w]),
                int(rng.choice([self.concrete, tile])),
            )
            if rng.uniform() < 0.5:
                soup.add(m.box([depth * 0.3, height, -w * 0.3], [depth * 0.6, height + 2.5, w * 0.4]), self.concrete)
        else:
            rise, over = rng.uniform(0.3, 0.65) * min(depth, width) * 0.6, rng.uniform(0.2, 0.7)
            if rng.uniform() < 0.6:  # the ridge runs along the street
                ridge = [[depth / 2, height + rise, -w - over], [depth / 2, height + rise, w + over]]
                eaves = [
                    [-over, height - 0.2, -w - over],
                    [-over, height - 0.2, w + over],
                    [depth + over, height - 0.2, w + over],
                    [depth + over, height - 0.2, -w - over],
                ]
                soup.add(m.quads(eaves[0], eaves[1], ridge[1], ridge[0]), tile)
                soup.add(m.quads(eaves[2], eaves[3], ridge[0], ridge[1]), tile)
                for z in (-w, w):
                    soup.add(
                        np.array([[[0, height, z], [depth, height, z], [depth / 2, height + rise, z]]], np.float32),
                        wall,
                    )
            else:  # the gable faces the street
                ridge = [[-over, height + rise, 0], [depth + over, height + rise, 0]]
                for z in (-w - over, w + over):
                    soup.add(
                        m.quads([-over, height - 0.2, z], [depth + over, height - 0.2, z], ridge[1], ridge[0]), tile
                    )
                soup.add(np.array([[[0, height, -w], [0, height, w], [0, height + rise, 0]]], np.float32), wall)
            for _ in range(int(rng.integers(0, 3))):
                z = rng.uniform(-w * 0.8, w * 0.8)
                soup.add(
                    m.box(
                        [depth * 0.45, height, z], [depth * 0.45 + 0.6, height + rise + rng.uniform(0.3, 1), z + 0.6]
                    ),
                    self.concrete,
                )
        trim = int(rng.choice([self.concrete, self.white, *self.wood]))
        for _ in range(int(rng.integers(0, 5))):  # balconies, bays, porches, awnings
            z, y = rng.uniform(-w, w * 0.6), rng.integers(0, max(1, int(height / 3))) * 2.9
            deep = rng.uniform(0.3, 1.6)
            tall = rng.choice([1.0, 2.6, 0.15])
            soup.add(
                m.box(
                    [-deep, y + (2.4 if tall < 0.5 else 0), z],
                    [0.1, y + tall + (2.4 if tall < 0.5 else 0), z + rng.uniform(1, 3.5)],
                ),
                trim if rng.uniform() < 0.6 else wall,
            )
        return soup

    def _frontage(self, side: int) -> None:
        rng = self.rng
        d, h = side * self.zones[side]["back"][0], self.height[side, "back"]
        choices = {
            "suburb": [0.72, 0.0, 0.18, 0.1],
            "town": [0.25, 0.65, 0.05, 0.05],
            "avenue": [0.3, 0.25, 0.35, 0.1],
            "highway": [0.1, 0.0, 0.4, 0.5],
            "country": [0.12, 0.0, 0.38, 0.5],
            "jam": [0.3, 0.2, 0.3, 0.2],
        }[self.kind]
        style = str(rng.choice(["detached", "row", "wood", "open"], p=choices))
        s = rng.uniform(-35, -15)
        storeys = rng.integers(1, 4) if self.kind != "town" else rng.integers(2, 6)
        big = rng.uniform() < 0.2
        while s < 240 and style in ("detached", "row"):
            if rng.uniform() < 0.06 and s > 40:
                style = str(rng.choice(["detached", "row", "wood"]))
                if style == "wood":
                    break
            width = rng.uniform(18, 45) if big else rng.uniform(8, 18)
            if not any(a < s + width and b > s for a, b in self.openings[side]):
                height = (storeys + rng.integers(0, 2)) * rng.uniform(2.7, 3.3)
                roof = "flat" if rng.uniform() < (0.8 if big else 0.3) else "gable"
                part = self._building(width, rng.uniform(8, 14), height, roof)
                back = rng.uniform(0, 4) if style == "detached" else rng.choice([0, 0, 0.4])
                flip = Soup()
                flip.place(part, np.zeros(3, np.float32), size=(side, 1, 1))
                self._put(flip, s + width / 2, d + side * back, h, rng.normal(0, 0.03) if style == "detached" else 0)
            s += width + (rng.choice([0.0, 0.0, rng.uniform(0, 4)]) if style == "row" else rng.uniform(2, 14))
            if rng.uniform() < 0.05:
                big = not big
        if style == "wood":
            gap = rng.uniform(2.5, 6)
            for at in np.arange(max(s, -25), 200, gap):
                for layer in range(3):
                    if rng.uniform() < 0.7 and not self._blocked(at, 1, side):
                        self._put(
                            self._tree(rng.uniform(6, 16), 1.0 if at < 60 else 0.3),
                            at + rng.normal(0, 1),
                            d + side * (1 + 4.5 * layer + rng.uniform(0, 3)),
                            h - 0.2,
                            rng.uniform(0, 6.3),
                        )
                if rng.uniform() < 0.5:
                    self._put(m.bush(rng, int(rng.choice(self.leaf)), gap, rng.uniform(0.6, 2.5), 1.5, False), at, d, h)
        if style == "open":
            for _ in range(int(rng.integers(0, 14))):
                self._put(
                    self._tree(rng.uniform(3, 14), 0.5), rng.uniform(0, 220), d + side * rng.uniform(0, 50), h, 0.0
                )
            if rng.uniform() < 0.3:
                self._wall(
                    -30,
                    200,
                    d,
                    h - 0.2,
                    rng.uniform(1.5, 5),
                    self._material(self._wall_color(), "concrete", "stucco", "wood"),
                )
        # a second row far behind
        for _ in range(int(rng.integers(2, 12))):
            far = rng.uniform(18, 58)
            s = rng.uniform(10, 250)
            if rng.uniform() < 0.4:
                part = Soup()
                part.place(
                    self._building(rng.uniform(8, 30), 10, rng.uniform(4, 22), str(rng.choice(["flat", "gable"]))),
                    np.zeros(3, np.float32),
                    size=(side, 1, 1),
                )
                self._put(part, s, d + side * far, h, rng.uniform(-0.5, 0.5))
            else:
                for k in range(5):
                    self._put(
                        self._tree(rng.uniform(6, 15), 0.35),
                        s + 4 * k,
                        d + side * (far + rng.uniform(-3, 3)),
                        h - 0.3,
                        0.0,
                    )

    # ---- traffic, overpass, horizon ----------------------------------------------------------------------------------

    def _traffic(self) -> None:
        """Collect the vehicles on the lanes: (part, s, d, along); the camera's own place stays free."""
        rng = self.rng
        self.vehicles: list[tuple[Soup, float, float, int, float]] = []
        dense = self.kind == "jam"
        flow = rng.uniform(4, 14) if not dense else 0.0
        for d, along in self.lanes:
            gap = (
                rng.uniform(1.5, 8)
                if dense
                else rng.choice([rng.uniform(6, 20), rng.uniform(15, 60), rng.uniform(60, 200)])
            )
            s = rng.uniform(7, 30) if abs(d) < 1 else rng.uniform(-12, 12)
            speed = flow * rng.uniform(0.7, 1.3) * along
            while s < 160:
                long = rng.uniform() < (0.25 if self.kind in ("highway", "jam") else 0.08)
                part = self._truck() if long else self._car()
                half = 7.5 if long else 2.4
                if not (abs(d) < 1.5 and s - half < 5.5):
                    offset = rng.normal(0, 0.25)
                    self.vehicles.append((part, s + half, d + offset, along, speed))
                s += 2 * half + gap * rng.uniform(0.6, 1.8)
        if self.kind in ("town", "avenue", "jam", "suburb") and rng.uniform() < 0.25:  # someone crosses
            for _ in range(int(rng.integers(1, 3))):
                part = (
                    self._car()
                    if rng.uniform() < 0.5
                    else m.person(rng, (int(rng.choice(self.cloth)), int(rng.choice(self.cloth))), self.skin)
                )
                turned = Soup()
                turned.place(part, np.zeros(3, np.float32), np.pi / 2)
                self.vehicles.append((turned, rng.uniform(9, 50), rng.uniform(-self.edges[-1], self.edges[1]), 1, 0.0))

    def traffic(self, time: float) -> Soup:
        """Return the vehicles at a time in seconds."""
        soup = Soup()
        for part, s, d, along, speed in self.vehicles:
            at = s + speed * time
            soup.place(part, self.road.at(at, d, 0.0), float(self.road.yaw(at)) + (0.0 if along > 0 else np.pi))
        return soup

    def _overpass(self) -> None:
        rng = self.rng
        s, width, h, thick = rng.uniform(14, 120), rng.uniform(5, 14), rng.uniform(4.8, 6.5), rng.uniform(0.6, 1.6)
        soup = Soup()
        a = rng.normal(0, 0.25)
        soup.add(m.box([-90, h, -width / 2], [90, h + thick, width / 2]), self.concrete)
        soup.add(
            m.box([-90, h + thick, -width / 2], [90, h + thick + 0.9, -width / 2 + 0.15]),
            int(rng.choice([self.concrete, self.metal])),
        )
        for x in (-self.edges[-1] - 1.5, self.edges[1] + 1.5, -40.0, 40.0):
            for z in (-width / 4, width / 4):
                soup.add(m.tube([[x, -1, z], [x, h, z]], rng.uniform(0.3, 0.6), 9), self.concrete)
        self._put(soup, s, 0.0, 0.0, a)

    def _background(self) -> None:
        rng = self.rng
        for _ in range(int(rng.integers(1, 4))):
            distance, height = rng.uniform(130, 600), rng.uniform(4, 60)
            a = np.linspace(-2.2, 2.2, 60)
            ridge = height * (
                0.55 + 0.25 * np.sin(a * rng.uniform(1, 6) + rng.uniform(0, 6)) + 0.12 * rng.normal(size=60)
            )
            x, z = distance * np.sin(a), distance * np.cos(a)
            low, high = np.stack([x, np.full(60, -20.0), z], 1), np.stack([x * 1.05, ridge, z * 1.05], 1)
            material = self._material(
                np.asarray(self.materials.color[self.leaf[0]]) * rng.uniform(0.8, 2),
                "noise_coarse",
                "noise_fine",
                "grass",
                scale=distance / 12,
                contrast=1.0,
            )
            self.soup.add(m.quads(low[:-1], low[1:], high[1:], high[:-1]), material)
