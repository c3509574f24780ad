"""The road as a plane below the camera: a robust fit to predicted depth, and with it the height of the camera.

A plane ``n . p = h`` (n the unit normal that points down, h the camera's height above it) means ``g . p = 1`` with
``g = n / h``, and on the ray through a pixel ``g . ray = 1 / z``: inverse depth is linear in the rays. The relative
error ``z (g . ray) - 1`` therefore does not depend on the unit of depth, and one tolerance fits every network.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from saunet.errors import in_range, positive
from saunet.geometry import full_precision
from saunet.geometry.warp import backproject

_MOST_POINTS = 2000
"""Largest number of pixels to score hypotheses on, evenly spread; the final fit uses all pixels."""
_ROUNDS = 5
"""Reweighting iterations; the fit converges after three or four."""


class GroundPlane(NamedTuple):
    """The plane of each image of a batch."""

    normal: Float[Tensor, "b 3"]
    """Unit normal in the camera's frame (x right, y down, z forward), from the camera down to the plane."""
    height: Float[Tensor, " b"]
    """Distance from the camera to the plane, in the unit of the depth; NaN if there is no plane."""
    support: Float[Tensor, " b"]
    """Fraction of the examined pixels that lie on the plane."""


def road_region(height: int, width: int, device: torch.device | None = None) -> Bool[Tensor, "{height} {width}"]:
    """Where a forward camera expects road: a trapezoid in the lower two fifths of the image."""
    v = (torch.arange(height, device=device)[:, None] + 0.5) / height
    u = (torch.arange(width, device=device) + 0.5) / width
    depth_in_image = (v - 0.6) / 0.4
    return (v > 0.6) & ((u - 0.5).abs() < 0.12 + 0.2 * depth_in_image)


@full_precision
def fit_ground(
    depth: Float[Tensor, "b 1 h w"],
    K: Float[Tensor, "b 3 3"],
    region: Bool[Tensor, "h w"] | None = None,
    *,
    tolerance: float = 0.05,
    max_tilt: float = 25.0,
    hypotheses: int = 256,
) -> GroundPlane:
    """Fit the ground plane to each depth map: the plane that most pixels agree with, then reweighted least squares.

    Planes through three pixels each are drawn, always the same ones, so equal depth gives an equal plane. Cars, curbs
    and noise are ignored as long as the road is the largest plane below the camera in the region.

    Args:
        depth: Depth in any unit; 0, NaN or infinite where unknown.
        K: Intrinsics, pixels.
        region: Where to look; `road_region` if None.
        tolerance: Largest relative depth error for a pixel to belong to the plane.
        max_tilt: Largest angle between the plane's normal and the camera's y axis, degrees.
        hypotheses: Number of planes tried.
    """
    in_range("tolerance", tolerance, 0, 1)
    in_range("max_tilt", max_tilt, 0, 90)
    positive("hypotheses", hypotheses)
    if region is None:
        region = road_region(depth.shape[-2], depth.shape[-1], depth.device)
    places = region.flatten().nonzero()[:, 0]
    z = depth.double().flatten(1)[:, places]
    rays = backproject(torch.ones_like(depth, dtype=torch.float64), K.double()).flatten(2)[:, :, places]
    upright = math.cos(math.radians(max_tilt))
    planes = []
    for each, ray in zip(z, rays, strict=True):
        known = (each > 0) & each.isfinite()
        planes.append(_fit(ray.T[known], each[known], tolerance, upright, hypotheses))
    normal, height, support = (torch.stack(column).to(depth) for column in zip(*planes, strict=True))
    return GroundPlane(normal, height, support)


def _fit(
    rays: Float[Tensor, "n 3"], z: Float[Tensor, " n"], tolerance: float, upright: float, hypotheses: int
) -> tuple[Float[Tensor, "3"], Float[Tensor, ""], Float[Tensor, ""]]:
    nan = z.new_full((), math.nan)
    nothing = (nan.expand(3), nan, z.new_zeros(()))
    if len(z) < 3:
        return nothing
    step = max(1, len(z) // _MOST_POINTS)
    few_rays, few_z = rays[::step], z[::step]
    generator = torch.Generator().manual_seed(0)
    triples = torch.randint(len(few_z), (hypotheses, 3), generator=generator).to(z.device)
    solved, info = torch.linalg.solve_ex(few_rays[triples], 1 / few_z[triples])
    good = (info == 0) & _is_ground(solved, upright)
    error = (few_rays @ solved.T * few_z[:, None] - 1).abs()
    votes = torch.where(good, (error < tolerance).sum(0), -1)
    best = votes.argmax()
    if votes[best] < 3:
        return nothing
    g = solved[best]
    for _ in range(_ROUNDS):
        expected = rays @ g  # inverse depth on the plane, used as weight instead of the noisy measurement
        error = 1 / (expected * z) - 1
        weight = torch.where(expected > 0, (1 - (error / tolerance).square()).clamp(min=0).square(), 0.0)
        A, b = rays / expected[:, None], 1 / (z * expected)
        weighted = A.T * weight
        g, info = torch.linalg.solve_ex(weighted @ A, weighted @ b)
        if info != 0 or not _is_ground(g, upright):
            return nothing
    length = torch.linalg.vector_norm(g)
    on_plane = ((rays @ g * z - 1).abs() < tolerance).to(z).mean()
    return g / length, 1 / length, on_plane


def _is_ground(g: Float[Tensor, "*n 3"], upright: float) -> Bool[Tensor, "*n"]:
    """Whether planes g . p = 1 lie below the camera and are roughly level."""
    length = torch.linalg.vector_norm(g, dim=-1)
    below: Tensor = (g[..., 1] > upright * length) & g.isfinite().all(-1) & (length > 0)
    return below
