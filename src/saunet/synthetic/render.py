"""Ray casting: what each sample of a pixel sees first, and how far along the camera's axis.

In a pinhole camera the inverse depth of a plane, its texture coordinates over depth, and the edges of a convex polygon
are all linear in the ray (x, y, 1). So each polygon is tested exactly on the samples inside its screen rectangle with a
few sums, and ellipsoids and cylinders with one quadratic form. Road, kerb and pavement are solved in closed form for
what is left.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from saunet.synthetic.objects import CORNERS, Polygons, Quadrics
from saunet.synthetic.world import KERB_HEIGHT, World

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
I32 = NDArray[np.int32]

SAMPLES = np.array([[0.0, 0.0], [-0.125, -0.375], [0.375, -0.125], [0.125, 0.375], [-0.375, 0.125]])
"""Where a pixel is sampled, pixels from its center: the center, which alone gives the depth, and a rotated square."""

NEAR, DRAW = 0.3, 230.0
"""Nothing nearer is drawn, and nothing farther but ground and sky; meters."""
SKY, ROAD, KERB_FACE, KERB_TOP, PAVEMENT, GRASS = -1, -2, -3, -4, -5, -6
"""Identities of what is not a polygon (0 ... q - 1) or quadric (q ... q + k - 1)."""
KERB_WIDTH = 0.18

_BOX_EDGES = np.array([(0, 1), (1, 3), (3, 2), (2, 0), (4, 5), (5, 7), (7, 6), (6, 4), (0, 4), (1, 5), (2, 6), (3, 7)])
_POLYGON_EDGES = np.array([(i, (i + 1) % CORNERS) for i in range(CORNERS)])


@dataclass(frozen=True, slots=True)
class Camera:
    """A pinhole camera in the world."""

    K: F64  # 3 x 3, pixels; integer coordinates are pixel centers
    T_world_cam: F64  # 4 x 4, meters, x right, y down, z forward
    height: int
    width: int

    @property
    def rotation(self) -> F64:
        return self.T_world_cam[:3, :3]

    @property
    def position(self) -> F64:
        return self.T_world_cam[:3, 3]


@dataclass(frozen=True, slots=True)
class Hits:
    """What the samples see; s samples a pixel, the first at its center."""

    inverse_depth: F32  # s x h x w, 1/meter along the camera's axis, 0 for the sky
    identity: I32  # s x h x w
    x: F32  # s x 1 x w: rays are (x, y, 1)
    y: F32  # s x h x 1
    planes: F64  # q x 3: inverse depth of each polygon's plane is planes . (x, y, 1)


def cast(world: World, polygons: Polygons, camera: Camera) -> Hits:
    """Find what each sample of each pixel sees."""
    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    offsets = SAMPLES.astype(np.float64)
    x = ((np.arange(camera.width)[None, None] + offsets[:, 0, None, None] - cx) / fx).astype(np.float32)
    y = ((np.arange(camera.height)[None, :, None] + offsets[:, 1, None, None] - cy) / fy).astype(np.float32)
    shape = (len(offsets), camera.height, camera.width)
    nearest = np.zeros(shape, np.float32)
    identity = np.full(shape, SKY, np.int32)
    planes = _cast_polygons(polygons, camera, x, y, nearest, identity)
    _cast_quadrics(world.quadrics, polygons.count, camera, x, y, nearest, identity)
    _cast_ground(world, camera, x, y, nearest, identity)
    return Hits(nearest, identity, x, y, planes)


def _rectangles(camera: Camera, points: F64, edges: NDArray[np.int64]) -> tuple[I32, F64]:
    """Return screen rectangles (left, right, top, bottom; exclusive ends) of point sets and their nearest depth.

    Edges that cross the near plane contribute their crossing point, so objects beside the camera keep tight rectangles.
    """
    z = points[..., 2]
    first, second = points[:, edges[:, 0]], points[:, edges[:, 1]]
    z0, z1 = first[..., 2], second[..., 2]
    crosses = (z0 < NEAR) != (z1 < NEAR)
    step = np.where(crosses, (NEAR - z0) / np.where(crosses, z1 - z0, 1.0), 0.0)
    cut = first + step[..., None] * (second - first)
    candidates = np.concatenate([points, cut], axis=1)
    seen = np.concatenate([z >= NEAR, crosses], axis=1)
    depth = np.where(seen, candidates[..., 2], 1.0)
    u = camera.K[0, 0] * candidates[..., 0] / depth + camera.K[0, 2]
    v = camera.K[1, 1] * candidates[..., 1] / depth + camera.K[1, 2]
    big, reach = 1e9, float(np.abs(SAMPLES).max())
    sides, tiny = [], np.zeros(len(points), bool)
    for pixel, count in ((u, camera.width), (v, camera.height)):
        low, high = np.where(seen, pixel, big).min(axis=1), np.where(seen, pixel, -big).max(axis=1)
        tiny |= high - low < 0.1
        sides += [np.clip(np.ceil(low - reach), 0, count), np.clip(np.floor(high + reach) + 1, 0, count)]
    sides[1] = np.where(tiny, sides[0], sides[1])
    return np.stack(sides, axis=1).astype(np.int32), np.where(seen, depth, big).min(axis=1)


def _near_to_far(rectangles: I32, front: F64, nearest: F32) -> Iterator[tuple[int, slice, slice, F32]]:
    """Yield what may be seen with its rows, columns and buffer, near to far, so that hidden things are found early."""
    shown = np.flatnonzero((rectangles[:, 1] > rectangles[:, 0]) & (rectangles[:, 3] > rectangles[:, 2]))
    for i in shown[np.argsort(front[shown], kind="stable")].tolist():
        left, right, top, bottom = rectangles[i]
        buffer = nearest[:, top:bottom, left:right]
        if buffer.min() * front[i] < 1.0:
            yield i, slice(top, bottom), slice(left, right), buffer


def _cast_polygons(polygons: Polygons, camera: Camera, x: F32, y: F32, nearest: F32, identity: I32) -> F64:
    planes = np.zeros((polygons.count, 3))
    offset = polygons.corners[:, 0] - camera.position
    chosen = np.flatnonzero((offset**2).sum(axis=1) < DRAW**2)
    corners = (polygons.corners[chosen] - camera.position) @ camera.rotation
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    distance = (normal * corners[:, 0]).sum(axis=1)
    scale = np.linalg.norm(normal, axis=1)
    visible = (distance > 1e-6 * scale) & (corners[..., 2].max(axis=1) > NEAR)
    chosen, corners, normal, distance = chosen[visible], corners[visible], normal[visible], distance[visible]
    rectangles, front = _rectangles(camera, corners, _POLYGON_EDGES)
    inside = np.cross(corners, np.roll(corners, -1, axis=1))  # x, y, 1 coefficients of each edge
    size = np.abs(inside).max(axis=2, keepdims=True)
    plane = normal / distance[:, None]
    planes[chosen] = plane
    tests = np.concatenate([inside / np.maximum(size, 1e-9), plane[:, None]], axis=1).astype(np.float32)
    real = size[..., 0] > 1e-9
    for i, rows, columns, buffer in _near_to_far(rectangles, front, nearest):
        test = tests[i][np.append(real[i], True)][:, :, None, None, None]
        value = test[:, 0] * x[:, :, columns] + (test[:, 1] * y[:, rows] + test[:, 2])
        hit = (value[:-1] >= 0).all(axis=0) & (value[-1] > buffer)
        np.copyto(buffer, value[-1], where=hit)
        np.copyto(identity[:, rows, columns], np.int32(chosen[i]), where=hit)
    return planes


def _cast_quadrics(quadrics: Quadrics, first: int, camera: Camera, x: F32, y: F32, nearest: F32, identity: I32) -> None:
    offset = quadrics.center - camera.position
    chosen = np.flatnonzero((offset[:, 0] ** 2 + offset[:, 2] ** 2 < DRAW**2) & (offset @ camera.rotation[:, 2] > -15))
    signs = np.array([(i, j, k) for i in (-1, 1) for j in (0, 1) for k in (-1, 1)])
    box = np.empty((chosen.size, 8, 3))
    box[..., 0] = offset[chosen, 0, None] + signs[:, 0] * quadrics.radius[chosen, None]
    box[..., 1] = quadrics.extent[chosen][:, signs[:, 1]] - camera.position[1]
    box[..., 2] = offset[chosen, 2, None] + signs[:, 2] * quadrics.radius[chosen, None]
    rectangles, front = _rectangles(camera, box @ camera.rotation, _BOX_EDGES)
    is_cylinder = quadrics.height[chosen] == 0
    upright = np.where(is_cylinder, 0.0, 1 / np.where(is_cylinder, 1.0, quadrics.height[chosen]))
    scale = np.stack([1 / quadrics.radius[chosen], upright, 1 / quadrics.radius[chosen]], axis=1)
    form = camera.rotation * scale[:, :, None]  # ray -> direction in which the surface is a unit sphere
    center = offset[chosen] * scale
    outside = (center**2).sum(axis=1) - 1.0
    toward = np.einsum("nij,ni->nj", form, center)
    # Relative to the middle of the rectangle, and in float64: in float32, thin distant objects suffer cancellation.
    middle = (rectangles[:, ::2] + rectangles[:, 1::2]) / 2 - camera.K[:2, 2]
    middle /= np.diag(camera.K)[:2]
    shift = np.tile(np.eye(3), (chosen.size, 1, 1))
    shift[:, :2, 2] = middle
    swapped = form.transpose(0, 2, 1)
    conics = toward[:, :, None] * toward[:, None] - outside[:, None, None] * swapped @ form
    conics = (shift.transpose(0, 2, 1) @ conics @ shift).astype(np.float32)
    outside_or_one = np.where(outside > 0, outside, 1.0)
    lines = ((toward[:, None] @ shift)[:, 0] / outside_or_one[:, None]).astype(np.float32)
    falls = (camera.rotation[1] @ shift).astype(np.float32)  # world y per meter of depth along the ray
    centers = middle.astype(np.float32)
    for i, rows, columns, buffer in _near_to_far(rectangles, front, nearest):
        if outside[i] <= 0:
            continue
        k, conic, line = chosen[i], conics[i], lines[i]
        xs, ys = x[:, :, columns] - centers[i, 0], y[:, rows] - centers[i, 1]
        root = (2 * conic[0, 1] * xs) * ys
        root += (conic[0, 0] * xs + 2 * conic[0, 2]) * xs + conic[2, 2]
        root += (conic[1, 1] * ys + 2 * conic[1, 2]) * ys
        hit = root > 0
        inverse = np.sqrt(np.maximum(root, 0, out=root), out=root)
        inverse *= np.float32(1 / outside[i])
        inverse += line[0] * xs
        inverse += line[1] * ys + line[2]
        hit &= inverse > buffer
        if front[i] < 2 * NEAR:
            hit &= inverse < 1 / NEAR
        if is_cylinder[i]:
            fall = falls[i]
            below = fall[0] * xs + (fall[1] * ys + fall[2])
            highest, lowest = (np.float32(v) for v in quadrics.extent[k] - camera.position[1])
            hit &= (below >= highest * inverse) & (below <= lowest * inverse)
        np.copyto(buffer, inverse, where=hit)
        np.copyto(identity[:, rows, columns], np.int32(first + k), where=hit)


def _cast_ground(world: World, camera: Camera, x: F32, y: F32, nearest: F32, identity: I32) -> None:
    """Solve road, kerb and pavement: two level planes and the upright step between them."""
    down = camera.rotation[1].astype(np.float32)
    drop = down[0] * x + (down[1] * y + down[2])
    height = -float(camera.position[1])
    upper = drop * np.float32(1 / (height - KERB_HEIGHT))
    sample, row, column = np.nonzero(upper > np.maximum(nearest, np.float32(1e-6)))
    if sample.size == 0:
        return
    upper = upper[sample, row, column]
    lower = drop[sample, row, column] * np.float32(1 / height)
    rays = (x[sample, 0, column], y[sample, row, 0])
    half = np.float32(world.section.half_width)
    edge, edge_lower = (
        np.abs(world.road.locate(*ground_point(camera, *rays, inverse))[1]) for inverse in (upper, lower)
    )
    on_road, on_top = edge_lower <= half, edge >= half
    share = np.clip((half - edge) / np.maximum(edge_lower - edge, 1e-6), 0, 1)  # on the kerb's face, 0 top to 1 bottom
    face = 1 / (1 / upper + share * (1 / lower - 1 / upper))
    inverse = np.where(on_top, upper, np.where(on_road, lower, face))
    beyond = edge - half
    kind = np.where(on_road, ROAD, KERB_FACE)
    kind = np.where(on_top, np.where(beyond < KERB_WIDTH, KERB_TOP, PAVEMENT), kind)
    kind = np.where(on_top & (beyond > world.section.pavement), GRASS, kind)
    wins = inverse > nearest[sample, row, column]
    sample, row, column = sample[wins], row[wins], column[wins]
    nearest[sample, row, column] = inverse[wins]
    identity[sample, row, column] = kind[wins]


def ground_point(camera: Camera, x: F32, y: F32, inverse_depth: F32) -> tuple[F32, F32]:
    """Return world (x, z) of the points at an inverse depth along rays (x, y, 1)."""
    turn, place = camera.rotation.astype(np.float32), camera.position.astype(np.float32)
    depth = 1 / inverse_depth
    return (
        place[0] + (turn[0, 0] * x + turn[0, 1] * y + turn[0, 2]) * depth,
        place[2] + (turn[2, 0] * x + turn[2, 1] * y + turn[2, 2]) * depth,
    )
