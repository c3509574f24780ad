"""Render random streets with exact depth: pairs of frames with their motion, cached in one file per scene.

Run ``python render.py OUT --scenes 500 --seed 0``: a scene whose file exists is skipped, so a stopped run resumes.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import cv2
import meshes as m
import numpy as np
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from frames import HEIGHT, WIDTH, save
from meshes import Array, Soup
from world import SURFACES, Street


class Assets:
    """Textures and cars of the installed wheels (scikit-image, miniworld, metadrive-simulator), and noise.

    Args:
        root: Folder with the unpacked wheels; see README.md.
        seed: Seed of the noise textures.
    """

    def __init__(self, root: Path, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.pyramids: list[list[Array]] = []
        self.names: dict[str, list[int]] = {name: [] for name in SURFACES}
        places = {"m": "miniworld/textures", "d": "metadrive/assets/textures", "s": "skimage/data"}
        files = {
            "asphalt": ["m/asphalt_1.png", "d/sci/color.jpg"],
            "grass": ["s/grass.png", "m/grass_1.png", "m/grass_2.png", "d/grass2/color.jpg", "d/grass2/color_old.jpg"],
            "gravel": ["s/gravel.png", "m/rock_1.png"],
            "brick": ["s/brick.png", "m/brick_wall_1.png", "m/cinder_blocks_1.png"],
            "concrete": [f"m/concrete_{i}.png" for i in range(1, 5)] + ["d/ground.png"],
            "stucco": ["m/stucco_1.png", "m/drywall_1.png", "m/marble_2.png"],
            "wood": ["m/wood_1.png", "m/wood_2.png", "m/wood_planks_1.png"],
            "tiles": ["m/concrete_tiles_1.png", "d/sidewalk/color.png", "d/sidewalk/color_old.png"],
        }
        for name, paths in files.items():
            for path in paths:
                path = path.replace(path[0], places[path[0]], 1)
                image = cv2.imread(str(root / path), cv2.IMREAD_COLOR)
                if image is None:
                    raise FileNotFoundError(f"{root / path} cannot be read; unpack the wheels as README.md says")
                image = cv2.resize(image, (256, 256), interpolation=cv2.INTER_AREA)[..., ::-1].astype(np.float32)
                self.names[name].append(self._texture((image / 255) ** 2.2))
        for power in (0.8, 1.0, 1.3):
            self.names["noise_fine"].append(self._texture(noise(rng, power)))
        for power in (1.6, 2.0):
            self.names["noise_coarse"].append(self._texture(noise(rng, power)))
        self.names["noise_streak"].append(self._texture(noise(rng, 1.3, (1, 8))))
        self.names["noise_streak"].append(self._texture(noise(rng, 1.3, (8, 1))))
        self.clouds = noise(rng, 1.9)[..., 0]
        self.cars = [
            car_mesh(root / f"metadrive/assets/models/vehicle/{n}") for n in ("beetle", "ferra", "lada", "130", "truck")
        ]

    def _texture(self, image: Array) -> int:
        image = (image + 0.02) / (image.mean((0, 1)) + 0.02)
        levels = [image.clip(0, 4).astype(np.float32)]
        while levels[-1].shape[0] > 1:
            levels.append(cv2.resize(levels[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
        self.pyramids.append(levels)
        return len(self.pyramids) - 1

    def car(self, rng: np.random.Generator, street: Street) -> Soup:
        """Return one of the modelled cars, repainted."""
        triangles, color, body, glass = self.cars[rng.integers(len(self.cars))]
        soup, white = Soup(), street.materials.add((1, 1, 1), m.PLAIN, contrast=0)
        gloss = street.materials.add((1, 1, 1), m.GLOSS, contrast=0)
        paint = np.asarray(street.materials.color[street._paint()], np.float32)
        tint = color.copy()
        tint[body] = paint * (0.4 + 0.6 * color[body].mean(1, keepdims=True) / (color[body].mean() + 1e-6))
        material = np.where(glass, street.glass, np.where(body, gloss, white))
        soup.add(triangles, material, np.zeros((len(triangles), 3, 2), np.float32), tint)
        return soup


def noise(rng: np.random.Generator, power: float, stretch: tuple[float, float] = (1, 1)) -> Array:
    """Return a tileable 256 256 3 texture with spectrum 1/f^power, mean 1."""
    f = np.hypot(np.fft.fftfreq(256)[:, None] * stretch[0], np.fft.fftfreq(256)[None] * stretch[1])
    f[0, 0] = 1
    field = np.fft.ifft2(np.fft.fft2(rng.normal(size=(256, 256))) / f**power).real
    field = field / field.std()
    return np.repeat(np.exp(0.3 * field)[..., None], 3, 2).astype(np.float32)


def car_mesh(folder: Path) -> tuple[Array, Array, np.ndarray, np.ndarray]:
    """Load a car as triangles (front to +z, on the ground), colors, and masks of its paint and its glass."""
    parts: list[tuple[Array, Array, str]] = []
    for file in ("vehicle.gltf", "right_tire_front.gltf", "right_tire_back.gltf"):
        if not (folder / file).exists():
            continue
        for part in trimesh.load(folder / file, force="scene").dump():
            color = face_colors(part)
            v, faces, color = cluster(np.asarray(part.vertices), np.asarray(part.faces), color**2.2, 0.08)
            name = str(getattr(part.visual.material, "name", "")).lower()
            if file == "vehicle.gltf":
                parts.append((v[faces], color, name))
            else:
                z = 1.35 if "front" in file else -1.3
                for x in (0.78, -0.78):
                    parts.append((v[faces] + [x, 0.36, z], color, "tire"))
    triangles = np.concatenate([p[0] for p in parts]).astype(np.float32)
    triangles[..., 1] -= triangles[..., 1].min()
    triangles[..., 2] -= (triangles[..., 2].max() + triangles[..., 2].min()) / 2
    color = np.concatenate([p[1] for p in parts])
    glass = np.concatenate([np.full(len(p[0]), "glass" in p[2] or "window" in p[2]) for p in parts])
    tire = np.concatenate([np.full(len(p[0]), p[2] == "tire") for p in parts])
    # the paint: the most common color by area, and what is near it
    area = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
    key = (color * 5).astype(int) @ [36, 6, 1]
    weight = np.bincount(key[~glass & ~tire], area[~glass & ~tire], minlength=300)
    main = color[key == weight.argmax()].mean(0)
    body = (np.abs(color - main).max(1) < 0.25) & ~glass & ~tire
    return triangles, color.astype(np.float32), body, glass


def face_colors(part: trimesh.Trimesh) -> Array:
    """Return each face's color in [0, 1]: the material's factor times its texture at the face's center."""
    material = part.visual.material
    factor = getattr(material, "baseColorFactor", None)
    factor = np.ones(3) if factor is None else np.asarray(factor, np.float32)[:3] / 255
    color = np.broadcast_to(factor, (len(part.faces), 3)).astype(np.float32)
    texture = getattr(material, "baseColorTexture", None)
    if texture is not None and part.visual.uv is not None:
        image = np.asarray(texture.convert("RGB"), np.float32) / 255
        uv = np.asarray(part.visual.uv)[part.faces].mean(1) % 1
        rows = ((1 - uv[:, 1]) * (image.shape[0] - 1)).astype(int)
        color = color * image[rows, (uv[:, 0] * (image.shape[1] - 1)).astype(int)]
    return color


def cluster(vertices: Array, faces: np.ndarray, color: Array, cell: float) -> tuple[Array, np.ndarray, Array]:
    """Simplify a mesh: merge the vertices in each cell of a grid and drop the faces that collapse."""
    grid = np.round(vertices / cell).astype(np.int64)
    _, first, inverse = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    faces = inverse.reshape(-1)[faces]
    keep = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])
    _, unique = np.unique(np.sort(faces[keep], 1), axis=0, return_index=True)
    return vertices[first], faces[keep][unique], color[keep][unique]


class _Solid:
    """Triangles in an Embree scene, with their attributes."""

    def __init__(self, soup: Soup) -> None:
        triangles, self.material, self.uv, self.tint = soup.merged()
        normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        self.normal = normal / (np.linalg.norm(normal, axis=1, keepdims=True) + 1e-12)
        self.scene = EmbreeScene()
        n = len(triangles)
        TriangleMesh(self.scene, triangles.reshape(-1, 3), np.arange(3 * n, dtype=np.int32).reshape(-1, 3))


class Renderer:
    """A street ready to be seen from any camera; what moves is in a scene of its own, rebuilt by `move`."""

    def __init__(self, street: Street, assets: Assets | None) -> None:
        self.still = _Solid(street.soup)
        self.street, self.assets, self.light = street, assets, street.light
        self.table = {
            "kind": np.array(street.materials.kind),
            "color": np.array(street.materials.color, np.float32),
            "texture": np.array(street.materials.texture),
            "scale": np.array(street.materials.scale, np.float32),
            "contrast": np.array(street.materials.contrast, np.float32),
            "params": np.stack(street.materials.params),
        }
        self.move(0.0)

    def move(self, time_s: float) -> None:
        """Put the traffic where it is at a time in seconds."""
        moving = _Solid(self.street.traffic(time_s)) if self.street.vehicles else None
        self.solids = [self.still] if moving is None else [self.still, moving]
        self.offset = [0, len(self.still.normal)]
        join = [
            np.concatenate([getattr(s, name) for s in self.solids]) for name in ("normal", "material", "uv", "tint")
        ]
        self.normal, self.material, self.uv, self.tint = join

    def cast(self, origin: Array, direction: Array) -> tuple[np.ndarray, Array, Array, Array]:
        """Return the triangle hit by each ray (-1 for none), the distance in lengths of the direction, and u, v."""
        origin, direction = np.ascontiguousarray(origin, np.float32), np.ascontiguousarray(direction, np.float32)
        best: list[np.ndarray] | None = None
        for solid, offset in zip(self.solids, self.offset, strict=False):
            hit = solid.scene.run(origin, direction, query="INTERSECT", output=True)
            found = [
                np.where(hit["primID"] >= 0, hit["primID"] + offset, -1),
                np.where(hit["primID"] >= 0, hit["tfar"], np.inf),
                hit["u"],
                hit["v"],
            ]
            best = (
                found
                if best is None
                else [np.where(found[1] < best[1], f, b) for f, b in zip(found, best, strict=True)]
            )
        assert best is not None
        return best[0], best[1], best[2], best[3]

    def blocked(self, origin: Array, direction: Array, limit: float = 1e5) -> np.ndarray:
        """Return whether each ray hits anything within ``limit`` lengths of its direction."""
        origin, direction = np.ascontiguousarray(origin, np.float32), np.ascontiguousarray(direction, np.float32)
        out = np.zeros(len(origin), bool)
        for solid in self.solids:
            dists = np.full(len(origin), limit, np.float32)
            out |= np.asarray(solid.scene.run(origin, direction, dists=dists, query="OCCLUDED")) != -1
        return out

    def render(
        self, rng: np.random.Generator, T_world_cam: Array, K: Array, height: int, width: int
    ) -> tuple[Array, Array]:
        """Render one frame.

        Args:
            rng: Randomness of the ambient light's rays.
            T_world_cam: Camera to world, 4 4; the camera's x points right, y down, z forward.
            K: Intrinsics, 3 3, pixel centers at integers.
            height: Rows.
            width: Columns.

        Returns:
            Linear RGB, h w 3, and depth (camera z in meters, 0 in the sky), h w.
        """
        v, u = np.mgrid[:height, :width].astype(np.float32)
        ray = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1).reshape(-1, 3)
        direction = (ray @ T_world_cam[:3, :3].T).astype(np.float32)
        origin = np.broadcast_to(T_world_cam[:3, 3].astype(np.float32), direction.shape)
        primitive, t, bu, bv = self.cast(origin, direction)
        unit = direction / np.linalg.norm(direction, axis=1, keepdims=True)
        color = self._sky(unit)
        hit = np.flatnonzero((primitive >= 0) & (t < 1e4))
        depth = np.zeros(height * width, np.float32)
        depth[hit] = t[hit]  # the ray's z is 1, so its parameter is the depth
        if len(hit):
            color[hit] = self._shade(
                rng,
                hit,
                primitive[hit],
                t[hit],
                bu[hit],
                bv[hit],
                direction[hit],
                unit[hit],
                origin[hit],
                K,
                (height, width),
            )
        return color.reshape(height, width, 3), depth.reshape(height, width)

    def _sky(self, unit: Array) -> Array:
        light = self.light
        up = unit[:, 1].clip(0, 1)
        color = light.horizon_color + (light.sky_color - light.horizon_color) * (1 - (1 - up[:, None]) ** 3)
        if self.assets is not None:
            scale = 1 / (up + 0.15)
            a = (unit[:, 0] * scale * 40 + light.cloud_offset[0] * 9).astype(int) & 255
            b = (unit[:, 2] * scale * 40 + light.cloud_offset[1] * 9).astype(int) & 255
            cover = np.clip((self.assets.clouds[a, b] - 1.35 + light.clouds) * 2, 0, 1)[:, None]
            color = color * (1 - cover) + cover * (0.9 + 0.6 * light.sun_color.mean() / 3)
        glow = np.clip(unit @ light.sun, 0, 1)[:, None]
        return (color + light.sun_color * (0.25 * glow**8 + 2 * glow**200)).astype(np.float32)

    def _shade(self, rng, hit, primitive, t, bu, bv, direction, unit, origin, K, size) -> Array:  # type: ignore[no-untyped-def]
        light, table = self.light, self.table
        n = len(hit)
        point = origin + direction * t[:, None]
        normal = self.normal[primitive]
        normal = np.where((normal * unit).sum(1, keepdims=True) > 0, -normal, normal)
        material = self.material[primitive]
        kind = table["kind"][material]
        corner = self.uv[primitive]
        uv = corner[:, 0] * (1 - bu - bv)[:, None] + corner[:, 1] * bu[:, None] + corner[:, 2] * bv[:, None]
        facing = np.abs((normal * unit).sum(1)).clip(0.03, 1)
        footprint = t / K[0, 0] / np.sqrt(facing)
        albedo = table["color"][material] * self.tint[primitive]
        albedo = albedo * self._texture(
            table["texture"][material],
            uv / table["scale"][material][:, None],
            footprint / table["scale"][material],
            table["contrast"][material],
        )
        gloss = np.zeros(n, np.float32)
        emission = np.zeros((n, 3), np.float32)
        self._road(kind, uv, table["params"][material], albedo, footprint)
        self._facade(kind, uv, table["params"][material], albedo, gloss)
        gloss[kind == m.GLOSS] = 0.25
        gloss[kind == m.GLASS] = 0.75
        lit = kind == m.LIGHT
        emission[lit] = albedo[lit] * table["params"][material[lit], :1]
        # direct light
        lambert = normal @ light.sun
        leaf = kind == m.LEAF
        lambert = np.where(leaf, 0.25 + 0.6 * np.abs(lambert), lambert.clip(0))
        start = point + normal * (0.002 + 0.0005 * t[:, None])
        if light.sun_color.any():
            need = np.flatnonzero(lambert > 0)
            shadow = self.blocked(start[need], np.broadcast_to(light.sun, (len(need), 3)))
            lambert[need[shadow]] = 0
        ambient = self._ambient(rng, hit, start, normal, size)
        sky = (light.sky_color + light.horizon_color) / 2
        bounce = 0.22 * (light.sun_color * max(light.sun[1], 0) + sky * 0.5) * 0.5
        up = 0.5 + 0.5 * normal[:, 1:2]
        incoming = ambient[:, None] * (sky * up + bounce * (1 - up)) + bounce * 0.15
        color = albedo * (incoming + lambert[:, None] * light.sun_color) + emission
        shiny = np.flatnonzero(gloss > 0)
        if len(shiny):
            mirror = unit[shiny] - 2 * (unit[shiny] * normal[shiny]).sum(1, keepdims=True) * normal[shiny]
            fresnel = gloss[shiny] * (0.12 + 0.88 * (1 - facing[shiny]) ** 3)
            seen = self._sky(mirror)
            dark = (mirror[:, 1] < 0.03) | self.blocked(start[shiny], mirror)
            seen[dark] = 0.12 * sky + 0.02 * light.sun_color
            color[shiny] = color[shiny] * (1 - fresnel[:, None]) + seen.clip(0, 6) * fresnel[:, None]
        if light.fog:
            veil = 1 - np.exp(-light.fog * t)[:, None]
            color = color * (1 - veil) + light.horizon_color * veil
        return color.astype(np.float32)

    def _ambient(self, rng, hit, start, normal, size) -> Array:  # type: ignore[no-untyped-def]
        """Return the fraction of near surroundings that is open, smoothed over like neighbors."""
        n = len(hit)
        pick = np.flatnonzero(((hit // size[1]) % 2 == 0) & ((hit % size[1]) % 2 == 0))
        around = rng.normal(size=(len(pick), 3)).astype(np.float32)
        around /= np.linalg.norm(around, axis=1, keepdims=True)
        ray = normal[pick] * 1.02 + around
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        half = np.zeros(((size[0] + 1) // 2, (size[1] + 1) // 2, 2), np.float32)
        shut = self.blocked(start[pick], ray, limit=4.0)
        rows, cols = hit[pick] // size[1] // 2, hit[pick] % size[1] // 2
        half[rows, cols, 0] = ~shut
        half[rows, cols, 1] = 1
        total = cv2.blur(half, (5, 5)) + 1e-4
        open_ = cv2.resize(total[..., 0] / total[..., 1], (size[1], size[0]), interpolation=cv2.INTER_LINEAR)
        return open_.reshape(-1)[hit].clip(0.05, 1) if n else np.zeros(0, np.float32)

    def _texture(self, index: np.ndarray, uv: Array, footprint: Array, contrast: Array) -> Array:
        out = np.ones((len(index), 3), np.float32)
        if self.assets is None:
            return out
        level = np.log2((footprint * 256).clip(1, 255)).astype(int)
        for texture in np.unique(index):
            pyramid = self.assets.pyramids[texture]
            of_texture = index == texture
            for lod in np.unique(level[of_texture]):
                take = np.flatnonzero(of_texture & (level == lod))
                image = pyramid[lod]
                side = image.shape[0]
                a = np.floor(uv[take] * side).astype(np.int64) % side
                out[take] = image[side - 1 - a[:, 1], a[:, 0]]
        return (1 + (out - 1) * contrast[:, None]).clip(0.05, 4)

    @staticmethod
    def _road(kind: np.ndarray, uv: Array, params: Array, albedo: Array, footprint: Array) -> None:
        """Paint lane lines: params hold five offsets, five types (1 solid, 2 dashed), dash length and period."""
        take = np.flatnonzero(kind == m.ROAD)
        if not len(take):
            return
        d, s, p = uv[take, 0], uv[take, 1], params[take]
        for i in range(5):
            reach = 0.07 + 0.3 * footprint[take]
            near = np.abs(d - p[:, i]) < reach
            drawn = (p[:, 5 + i] == 1) | ((p[:, 5 + i] == 2) & (s % (p[:, 10] + p[:, 11]) < p[:, 10]))
            paint = take[near & drawn]
            cover = (0.07 / reach[near & drawn])[:, None] * (0.6 + 0.4 * (np.sin(s[near & drawn] * 9.1) > -0.6))[
                :, None
            ]
            albedo[paint] = albedo[paint] * (1 - cover) + 0.55 * cover

    @staticmethod
    def _facade(kind: np.ndarray, uv: Array, params: Array, albedo: Array, gloss: Array) -> None:
        """Draw windows, frames, sills and doors on walls; see ``Street._facade`` for the parameters."""
        take = np.flatnonzero(kind == m.FACADE)
        if not len(take):
            return
        p, u, v = params[take], uv[take, 0], uv[take, 1]
        floor, spacing, wide, tall, sill, frame = p[:, 0], p[:, 1], p[:, 2], p[:, 3], p[:, 4], p[:, 5]
        column, row = np.floor(u / spacing), np.floor(v / floor)
        x, y = u - (column + 0.5) * spacing, v - row * floor - sill
        seed = np.sin(column * 12.9898 + row * 78.233 + p[:, 8]) * 43758.5453
        chance = seed - np.floor(seed)
        door = (row == 0) & (chance < 0.25)
        y = np.where(door, y + sill - 0.05, y)
        tall = np.where(door, 2.1, tall)
        exists = (v > 0) & (chance > 0.06)
        inside = exists & (np.abs(x) < wide / 2) & (y > 0) & (y < tall)
        border = exists & (np.abs(x) < wide / 2 + frame) & (y > -frame) & (y < tall + frame) & ~inside
        bar = inside & (frame > 0.05) & ((np.abs(x) < frame * 0.3) | (np.abs(y - tall * 0.65) < frame * 0.3))
        blind = inside & (y > tall * (1 - p[:, 7] * ((chance * 7) % 1)))
        albedo[take[border]] = p[border, 9:10] * [1, 0.98, 0.94]
        albedo[take[inside]] = (0.015 + 0.05 * (chance[inside] * 13 % 1))[:, None] * [1, 1, 1.05]
        albedo[take[inside & door & (p[:, 10] < 0.5)]] = p[inside & door & (p[:, 10] < 0.5), 11:12] * [1, 0.8, 0.6]
        gloss[take[inside]] = 0.8
        for mask, value in ((blind, 0.5), (bar, 0.6)):
            albedo[take[mask]] = value * p[mask, 9:10].clip(0.3)
            gloss[take[mask]] = 0
        base = (v < 0.5) & (p[:, 10] > 0.6)
        albedo[take[base]] *= 0.5


def camera(rng: np.random.Generator, width: int, height: int) -> tuple[Array, Array]:
    """Return intrinsics 3 3 and the mounting: height, pitch, roll, lateral offset and yaw to the road."""
    fov = np.deg2rad(rng.uniform(70, 95) if rng.uniform() < 0.7 else rng.uniform(50, 110))
    f = width / 2 / np.tan(fov / 2)
    K = np.array(
        [
            [f, 0, (width - 1) / 2 + rng.normal(0, 0.01) * width],
            [0, f, (height - 1) / 2 + rng.normal(0, 0.08) * height],
            [0, 0, 1],
        ]
    )
    yaw = rng.normal(0, 0.05) if rng.uniform() < 0.75 else rng.normal(0, 0.4)
    mount = np.array(
        [
            rng.normal(1.6, 0.12) if rng.uniform() < 0.6 else rng.uniform(1.2, 2.2),
            rng.normal(0, 0.025),
            rng.normal(0, 0.012),
            rng.normal(0, 0.35),
            yaw,
        ]
    )
    return K, mount.clip([1.1, -0.1, -0.05, -1.2, -1.2], [2.3, 0.1, 0.05, 1.2, 1.2])


def pose(street: Street, s: float, mount: Array) -> Array:
    """Return T_world_cam, 4 4, of a camera mounted on a car at distance s along the road."""
    high, pitch, roll, lateral, yaw = mount
    heading = float(street.road.yaw(s)) + yaw
    rise = (street.road.at(s + 1.3, 0.0) - street.road.at(s - 1.3, 0.0))[1] / 2.6
    pitch = pitch - np.arctan(rise)  # positive looks down
    cp, sp, cr, sr = np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    flip = np.diag([1.0, -1.0, 1.0])  # camera y points down
    tilt = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    tip = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
    T = np.eye(4)
    T[:3, :3] = m.turn(heading) @ tilt @ tip @ flip
    T[:3, 3] = street.road.at(s, lateral, high)
    return T


def expose(rng: np.random.Generator, linear: list[Array], depth: list[Array]) -> list[np.ndarray]:
    """Turn linear light into 8-bit pictures as a camera does: exposure, clipping, tone curve, white balance, noise."""
    ground = np.concatenate([x[d > 0] for x, d in zip(linear, depth, strict=True)])
    level = np.exp(np.log(ground.mean(1) + 1e-3).mean())
    gain = np.exp(rng.uniform(np.log(0.035), np.log(0.22))) / level * rng.uniform(0.95, 1.05, 3)
    gamma, contrast = rng.uniform(1.7, 2.4), rng.uniform(0, 0.8)
    out = []
    for image in linear:
        x = (image * gain).clip(0, None)
        x = x + 0.08 * rng.uniform(0, 1) * cv2.GaussianBlur(x.clip(0, 2), (0, 0), 6)  # glare of the lens
        x = x.clip(0, 1) ** (1 / gamma)
        x = x * (1 - contrast) + contrast * x * x * (3 - 2 * x)
        x = x + rng.normal(0, rng.uniform(0, 0.012), x.shape)
        out.append((x.clip(0, 1) * 255).round().astype(np.uint8))
    return out


def _free_place(rng: np.random.Generator, renderer: Renderer, K: Array, mount: Array, view: int) -> tuple[float, Array]:
    """Return a distance along the road and a mounting whose view is not blocked by something within 3 m."""
    street = renderer.street
    lanes = [d for d, along in street.lanes if along > 0]
    for _ in range(8):
        s = rng.uniform(-5, 5) + 13.0 * view
        trial = mount + np.array([0, 0, 0, rng.choice(lanes) if rng.uniform() < 0.5 else 0.0, 0])
        T = pose(street, s, trial)
        u, v = np.meshgrid(np.linspace(0, 2 * K[0, 2], 24), np.linspace(0, 2 * K[1, 2], 8))
        ray = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1).reshape(-1, 3)
        _, z, _, _ = renderer.cast(np.broadcast_to(T[:3, 3], ray.shape), ray @ T[:3, :3].T)
        ahead = z.reshape(8, 24)[2:6, 8:16].min()
        if np.quantile(z, 0.04) > 2.2 and ahead > 4.5:
            break
    return s, trial


def scene(
    seed: int, assets: Assets | None, views: int, pairs: int, height: int = HEIGHT, width: int = WIDTH
) -> dict[str, Any]:
    """Render one scene from ``views`` places; at the first ``pairs`` of them, a second frame a moment later.

    Returns:
        ``images`` (JPEG bytes of each frame), ``depth`` (float16, n h w, 0 in the sky), ``K`` (n 3 3), ``T_world_cam``
        (n 4 4), ``second`` (whether a frame is the second of a pair, right after its first).
    """
    rng = np.random.default_rng(seed)
    street = Street(rng, assets, assets.names if assets else None)
    renderer = Renderer(street, assets)
    images, depths, Ks, Ts, second = [], [], [], [], []
    for view in range(views):
        K, mount = camera(rng, width, height)
        s, mount = _free_place(rng, renderer, K, mount, view)
        linear, depth = [], []
        dt = 1 / rng.uniform(5, 30)
        speed = 0.0 if rng.uniform() < 0.08 else rng.uniform(8, 30) if street.kind == "highway" else rng.uniform(1, 14)
        spin = np.deg2rad(rng.normal(0, 0.5) if rng.uniform() < 0.6 else rng.uniform(-3, 3)) * min(1.0, speed / 3)
        nod = np.deg2rad(rng.normal(0, 0.25)) * min(1.0, speed / 3)
        for k in range(2 if view < pairs else 1):
            if k or view == pairs:
                renderer.move(k * dt)
            shift = np.array([0, nod, nod * 0.3, np.sin(mount[4]) * speed * dt, spin])
            T = pose(street, s + k * dt * speed, mount + k * shift)
            frame, z = renderer.render(rng, T, K, height, width)
            linear.append(frame)
            depth.append(z)
            Ks.append(K)
            Ts.append(T)
            second.append(k == 1)
        for picture in expose(rng, linear, depth):
            images.append(cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 94])[1].tobytes())
        depths += depth
    return {
        "images": images,
        "depth": np.stack(depths).clip(0, 6e4).astype(np.float16),
        "K": np.stack(Ks).astype(np.float32),
        "T_world_cam": np.stack(Ts),
        "second": np.array(second),
        "kind": street.kind,
    }


def main() -> None:
    """Render scenes into a folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--assets", type=Path, required=True, help="folder with the unpacked wheels")
    parser.add_argument("--scenes", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0, help="seed of the first scene; each scene adds one")
    parser.add_argument("--views", type=int, default=8, help="places per scene")
    parser.add_argument("--pairs", type=int, default=2, help="places with a second frame a moment later")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    assets = Assets(options.assets)
    for seed in range(options.seed, options.seed + options.scenes):
        path = options.out / f"{seed:06d}.npz"
        if path.exists():
            continue
        begin = time.time()
        data = scene(seed, assets, options.views, options.pairs)
        save(path, data)
        print(f"{path.name} {data['kind']} {len(data['images']) / (time.time() - begin):.2f} frames/s", flush=True)


if __name__ == "__main__":
    main()
