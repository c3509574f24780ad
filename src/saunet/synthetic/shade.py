"""Color of what the rays hit: material, grain, Lambertian light and a little haze, averaged over a pixel's footprint.

Surfaces keep their brightness from frame to frame: the light is fixed in the world and nothing depends on the viewing
direction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from saunet.synthetic import materials
from saunet.synthetic.materials import INDEX
from saunet.synthetic.objects import Polygons
from saunet.synthetic.render import GRASS, KERB_FACE, KERB_TOP, PAVEMENT, ROAD, SKY, Camera, Hits, ground_point
from saunet.synthetic.world import World

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
I64 = NDArray[np.int64]

_GRAIN_PERIOD = 13.0  # meters
_GROUND = {  # material, meters per period, grain
    ROAD: ("asphalt", 3.1, 0.20),
    KERB_FACE: ("kerb", 4.0, 0.08),
    KERB_TOP: ("kerb", 4.0, 0.08),
    PAVEMENT: ("paving", 3.2, 0.12),
    GRASS: ("grass", 4.3, 0.22),
}


@dataclass(frozen=True, slots=True)
class Rays:
    """A flat list of samples."""

    x: F32
    y: F32
    inverse_depth: F32
    identity: NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class Scene:
    """A world at one moment, seen by a camera."""

    world: World
    polygons: Polygons
    camera: Camera
    hits: Hits


def shade(world: World, polygons: Polygons, camera: Camera, hits: Hits) -> NDArray[np.uint8]:
    """Return the picture, h x w x 3 RGB.

    Each pixel is shaded once, at its center, since materials are filtered; pixels where the samples see different
    things are shaded at every sample and averaged.
    """
    scene, identity = Scene(world, polygons, camera, hits), hits.identity
    edge = (identity[1:] != identity[:1]).any(axis=0)
    color = np.empty((camera.height, camera.width, 3), np.float32)
    row, column = np.nonzero(~edge)
    color[row, column] = _color(scene, np.zeros_like(row), row, column)
    row, column = np.nonzero(edge)
    if row.size:
        around = np.arange(1, identity.shape[0])
        sample = np.repeat(around, row.size)
        parts = _color(scene, sample, np.tile(row, around.size), np.tile(column, around.size))
        color[row, column] = parts.reshape(around.size, row.size, 3).mean(axis=0)
    return np.rint(np.clip(color, 0, 1) * 255).astype(np.uint8)


def _color(scene: Scene, sample: I64, row: I64, column: I64) -> F32:
    hits = scene.hits
    rays = Rays(
        hits.x[sample, 0, column],
        hits.y[sample, row, 0],
        hits.inverse_depth[sample, row, column],
        hits.identity[sample, row, column],
    )
    color = np.empty((sample.size, 3), np.float32)
    thing, count = rays.identity, scene.polygons.count
    polygon, quadric = (thing >= 0) & (thing < count), thing >= count
    for where, paint in ((thing == SKY, _sky), (thing < SKY, _ground), (polygon, _polygon), (quadric, _quadric)):
        index = np.flatnonzero(where)
        if index.size:
            part = Rays(rays.x[index], rays.y[index], rays.inverse_depth[index], thing[index])
            color[index] = paint(scene, part)
    light = scene.world.light
    seen = np.flatnonzero(rays.identity != SKY)
    clear = np.exp(-1 / (light.haze * rays.inverse_depth[seen]))[:, None]
    color[seen] = color[seen] * clear + np.asarray(light.horizon, np.float32) * (1 - clear)
    return color


def _brightness(world: World, normal: F64) -> F64:
    """Lambertian light on surfaces with outward unit normals (n x 3)."""
    light = world.light
    upward = 0.5 - 0.5 * normal[:, 1]  # the sky lights what faces up more than what faces down
    return light.ambient * (0.72 + 0.28 * upward) + light.direct * np.maximum(normal @ light.sun, 0)


def _blend(luminance: F32, mask: F32, first: F32, second: F32) -> F32:
    """Color of a surface from its material's luminance and mask (n) and its two colors (n x 3 or 3)."""
    return np.asarray(luminance[:, None] * (first + mask[:, None] * (second - first)), np.float32)


def _directions(turn: F32, rays: Rays) -> list[F32]:
    return [turn[i, 0] * rays.x + turn[i, 1] * rays.y + turn[i, 2] for i in range(3)]


def _sky(scene: Scene, rays: Rays) -> F32:
    """A gradient with clouds on a plane far above."""
    world, camera = scene.world, scene.camera
    turn = camera.rotation.astype(np.float32)
    direction = _directions(turn, rays)
    length = np.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
    rise = np.clip(-direction[1] / length, 0, 1)
    low, high, cloud = (np.asarray(c, np.float32) for c in (world.light.horizon, world.light.zenith, world.light.cloud))
    base = low + np.sqrt(rise)[:, None] * (high - low)
    reach = 0.35 / (rise + 0.12)
    pixel = reach / camera.K[0, 0]
    u, v = direction[0] / length * reach, direction[2] / length * reach
    kind, pixel = np.full(u.size, INDEX["clouds"], np.float32), pixel.astype(np.float32)
    _, mask = materials.sample(kind, u, v, pixel, pixel * 4)
    return np.asarray(base + (0.75 * mask * np.clip(rise * 6, 0, 1))[:, None] * (cloud - base), np.float32)


def _ground(scene: Scene, rays: Rays) -> F32:
    world, camera = scene.world, scene.camera
    x, z = ground_point(camera, rays.x, rays.y, rays.inverse_depth)
    along, across, cosine, sine = world.road.locate(x, z)
    outside = np.abs(across) > 500
    along, across = np.where(outside, z, along), np.where(outside, x, across)
    depth = 1 / rays.inverse_depth
    height = np.float32(-camera.position[1])
    side = depth / np.float32(camera.K[0, 0])  # meters that a pixel's width and height cover on the ground
    ahead = depth * depth / (height * np.float32(camera.K[1, 1]))
    turn = camera.rotation.astype(np.float32)
    view_x, view_z = turn[0, 0] * rays.x + turn[0, 2], turn[2, 0] * rays.x + turn[2, 2]
    step_along = np.hypot(side * (turn[0, 0] * sine + turn[2, 0] * cosine), ahead * (view_x * sine + view_z * cosine))
    step_across = np.hypot(side * (turn[0, 0] * cosine - turn[2, 0] * sine), ahead * (view_x * cosine - view_z * sine))
    kinds = np.array(sorted(_GROUND))
    place = np.searchsorted(kinds, rays.identity)
    names, periods, strengths = zip(*(_GROUND[int(kind)] for kind in kinds), strict=True)
    material = np.array([INDEX[n] for n in names], np.float32)[place]
    period, strength = (np.array(each, np.float32)[place] for each in (periods, strengths))
    periods = (along / period, across / period, step_along / period, step_across / period)
    luminance, mask = materials.sample(material, *periods)
    step = np.maximum(step_along, step_across)
    fine = materials.grain(along / _GRAIN_PERIOD, across / _GRAIN_PERIOD, step / _GRAIN_PERIOD)
    colors = np.array([world.ground[n] for n in names], np.float32)[place]
    color = _blend(luminance, mask, colors[:, 0], colors[:, 1])
    paint = np.where(rays.identity == ROAD, _markings(world, along, across, step_along, step_across), 0)
    worn = (0.8 + 0.12 * fine) * paint
    color += worn[:, None] * (np.float32(0.82) - color)
    level = float(_brightness(world, np.array([[0.0, -1.0, 0.0]]))[0])
    face = np.where(rays.identity == KERB_FACE, np.float32(0.7), np.float32(1))
    return np.asarray(color * ((1 + strength * fine) * face * np.float32(level))[:, None], np.float32)


def _polygon(scene: Scene, rays: Rays) -> F32:
    world, polygons, camera = scene.world, scene.polygons, scene.camera
    used, place = np.unique(rays.identity, return_inverse=True)
    plane, look = scene.hits.planes[used], polygons.look[used]
    forms = []  # texture coordinate over depth, linear in the ray
    for to in (polygons.to_u[used], polygons.to_v[used]):
        forms.append(to[:, :3] @ camera.rotation + (to[:, :3] @ camera.position + to[:, 3])[:, None] * plane)
    outward = -(plane @ camera.rotation.T)
    bright = _brightness(world, outward / np.linalg.norm(outward, axis=1, keepdims=True))[:, None]
    table = np.concatenate([plane, *forms, look[:, :1], look[:, 1:7] * bright, look[:, 7:]], axis=1).astype(np.float32)
    row = np.ascontiguousarray(table.T)[:, place]
    depth = 1 / rays.inverse_depth
    coordinates, steps = [], []
    for first in (3, 6):
        value = (row[first] * rays.x + row[first + 1] * rays.y + row[first + 2]) * depth
        right = (row[first] - value * row[0]) * depth / np.float32(camera.K[0, 0])
        below = (row[first + 1] - value * row[1]) * depth / np.float32(camera.K[1, 1])
        coordinates.append(value)
        steps.append(np.hypot(right, below))
    luminance, mask = materials.sample(row[9], coordinates[0], coordinates[1], steps[0], steps[1])
    to_grain_u, to_grain_v = row[17] / _GRAIN_PERIOD, row[18] / _GRAIN_PERIOD
    pixel = np.maximum(steps[0] * to_grain_u, steps[1] * to_grain_v)
    fine = materials.grain(coordinates[0] * to_grain_u + row[19], coordinates[1] * to_grain_v + row[19] * 7, pixel)
    color = _blend(luminance, mask, row[10:13].T, row[13:16].T)
    return np.asarray(color * (1 + row[16] * fine)[:, None], np.float32)


def _quadric(scene: Scene, rays: Rays) -> F32:
    world, camera = scene.world, scene.camera
    quadrics = world.quadrics
    used, place = np.unique(rays.identity - scene.polygons.count, return_inverse=True)
    upright = np.where(quadrics.height[used] > 0, quadrics.height[used], np.inf)
    facts = [
        quadrics.center[used] - camera.position,
        quadrics.radius[used][:, None],
        upright[:, None],
        quadrics.look[used],
    ]
    row = np.ascontiguousarray(np.concatenate(facts, axis=1).astype(np.float32).T)[:, place]
    turn = camera.rotation.astype(np.float32)
    depth = 1 / rays.inverse_depth
    off_x, off_y, off_z = (each * depth - row[i] for i, each in enumerate(_directions(turn, rays)))
    radius, tall = row[3], row[4]
    normal = np.stack([off_x / radius**2, off_y / tall**2, off_z / radius**2], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    period_u, period_v = row[13], row[14]
    around = np.arctan2(off_x, -off_z) * radius  # the seam is on the far side
    pixel = depth / np.float32(camera.K[0, 0])
    facing = np.abs(normal @ turn[:, 2])
    stretched = np.asarray(pixel / np.maximum(facing, 0.25), np.float32)
    offset = row[15]
    u, v = around / period_u + offset, off_y / period_v + offset * 5
    luminance, mask = materials.sample(row[5], u, v, stretched / period_u, stretched / period_v)
    u, v = around / _GRAIN_PERIOD + offset, off_y / _GRAIN_PERIOD + offset * 3
    fine = materials.grain(u, v, stretched / _GRAIN_PERIOD)
    light = _brightness(world, normal.astype(np.float64)).astype(np.float32)
    color = _blend(luminance, mask, row[6:9].T, row[9:12].T)
    return np.asarray(color * (light * (1 + row[12] * fine))[:, None], np.float32)


def _covered(position: F32, low: float, high: float, pixel: F32) -> F32:
    """Fraction of a pixel that lies in an interval."""
    start, end = np.maximum(position - pixel / 2, low), np.minimum(position + pixel / 2, high)
    return np.asarray(np.clip((end - start) / pixel, 0, 1), np.float32)


def _dashed(position: F32, dash: float, gap: float, pixel: F32) -> F32:
    """Fraction of a pixel that lies on dashes which repeat for ever."""
    period = dash + gap
    ends = np.stack([position - pixel / 2, position + pixel / 2])
    whole = np.floor(ends / period)
    painted = whole * dash + np.minimum(ends - whole * period, dash)  # length of paint up to here
    return np.asarray((painted[1] - painted[0]) / pixel, np.float32)


def _markings(world: World, along: F32, across: F32, step_along: F32, step_across: F32) -> F32:
    """How much of each pixel is paint: center line, edge lines and zebra crossings, exactly box-filtered."""
    step_along, step_across = np.maximum(step_along, 1e-3), np.maximum(step_across, 1e-3)
    section = world.section
    dash, gap = world.dashes
    paint = _covered(across, -0.07, 0.07, step_across) * _dashed(along, dash, gap, step_along)
    line = section.half_width - (2.15 if section.parking else 0.3)
    lines = _covered(np.abs(across), line - 0.06, line + 0.06, step_across)
    paint = paint + (lines * _dashed(along, 1.0, 1.0, step_along) if section.parking else lines)
    for start in world.crossings:
        wide = _covered(np.abs(across), -1.0, section.half_width - 0.4, step_across)
        stripes = wide * _dashed(across, 0.5, 0.5, step_across)
        paint = paint + _covered(along, start, start + 3.2, step_along) * (stripes - paint)
    return np.asarray(np.clip(paint, 0, 1), np.float32)
