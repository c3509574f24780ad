"""The ground plane against planes known in closed form, with what stands on a road in the way."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from saunet.errors import ConfigError
from saunet.geometry.ground import fit_ground, road_region
from saunet.synthetic import SyntheticDrive

K = torch.tensor([[[110.0, 0.0, 95.5], [0.0, 110.0, 29.0], [0.0, 0.0, 1.0]]])
HEIGHT, WIDTH = 64, 192


def plane_depth(height: float, pitch: float = 0.0, roll: float = 0.0) -> tuple[Tensor, Tensor]:
    """Depth of a plane below a camera that is pitched and rolled (radians), 0 in the sky; and its normal."""
    normal = torch.tensor(
        [math.sin(roll), math.cos(roll) * math.cos(pitch), math.cos(roll) * math.sin(pitch)], dtype=torch.float64
    )
    v, u = torch.meshgrid(
        torch.arange(HEIGHT, dtype=torch.float64), torch.arange(WIDTH, dtype=torch.float64), indexing="ij"
    )
    k = K[0].double()
    rays = torch.stack(((u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1], torch.ones_like(u)), -1)
    inverse = rays @ normal / height
    return torch.where(inverse > 0, 1 / inverse, 0.0).float()[None, None], normal.float()


@pytest.mark.parametrize(("height", "pitch", "roll"), [(1.65, 0.0, 0.0), (1.2, 0.08, -0.03), (0.3, -0.05, 0.1)])
def test_a_plane_is_found_exactly(height: float, pitch: float, roll: float) -> None:
    depth, normal = plane_depth(height, pitch, roll)
    plane = fit_ground(depth, K)
    torch.testing.assert_close(plane.height, torch.tensor([height]), rtol=1e-5, atol=0)
    torch.testing.assert_close(plane.normal[0], normal, rtol=0, atol=1e-5)
    assert plane.support == 1.0


def test_height_has_the_unit_of_the_depth() -> None:
    depth, _ = plane_depth(1.65, 0.03)
    noisy = depth * (1 + 0.02 * torch.randn(depth.shape, generator=torch.Generator().manual_seed(1)))
    one, other = fit_ground(noisy, K), fit_ground(37.0 * noisy, K)
    torch.testing.assert_close(other.height, 37.0 * one.height, rtol=1e-5, atol=0)
    torch.testing.assert_close(one.height, torch.tensor([1.65]), rtol=0.01, atol=0)


def test_cars_and_holes_do_not_move_it() -> None:
    depth, _ = plane_depth(1.65, 0.02)
    depth[..., 30:58, 60:90] = 6.0  # a car's back
    depth[..., 40:, 110:125] = torch.tensor([0.0, math.nan, math.inf]).repeat(5)
    plane = fit_ground(depth, K)
    torch.testing.assert_close(plane.height, torch.tensor([1.65]), rtol=1e-3, atol=0)
    assert 0.4 < plane.support[0] < 1


def test_equal_depth_gives_an_equal_plane_whatever_the_random_state() -> None:
    depth = plane_depth(1.65)[0] * (1 + 0.05 * torch.rand(1, 1, HEIGHT, WIDTH))
    first = fit_ground(depth, K)
    torch.manual_seed(99)
    state = torch.get_rng_state()
    assert torch.equal(fit_ground(depth, K).height, first.height)
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.parametrize("kind", ["nothing known", "a wall ahead", "a ceiling"])
def test_no_ground_is_nan(kind: str) -> None:
    depth = torch.zeros(1, 1, HEIGHT, WIDTH)
    if kind == "a wall ahead":
        depth += 5.0
    elif kind == "a ceiling":
        depth = plane_depth(1.65)[0].flip(-2)
    plane = fit_ground(depth, K)
    assert plane.height.isnan().all()
    assert plane.support == 0


def test_images_of_a_batch_are_independent() -> None:
    depth = torch.cat([plane_depth(1.0)[0], torch.zeros(1, 1, HEIGHT, WIDTH), plane_depth(2.0)[0]])
    found = fit_ground(depth, K.expand(3, 3, 3)).height
    torch.testing.assert_close(found[[0, 2]], torch.tensor([1.0, 2.0]), rtol=1e-4, atol=0)
    assert found[1].isnan()


def test_a_region_of_ones_own() -> None:
    depth, _ = plane_depth(1.65)
    depth[..., :96] = 3.0
    region = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    region[45:, 100:] = True
    torch.testing.assert_close(fit_ground(depth, K, region).height, torch.tensor([1.65]), rtol=1e-4, atol=0)
    default = road_region(HEIGHT, WIDTH)
    assert not default[: HEIGHT // 2].any()
    assert torch.equal(default, default.flip(-1))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_camera_height_of_synthetic_streets_within_three_percent(seed: int) -> None:
    """The true depth times an unknown factor gives that factor back, on every frame; kerbs and cars are in view."""
    drive = SyntheticDrive(seed=seed, frames=4, height=64, width=192, moving_cars=1)
    depth = torch.stack([torch.from_numpy(drive.depth(i))[None] for i in drive.indices])
    intrinsics = torch.from_numpy(drive.intrinsics(0)).float().expand(4, 3, 3)
    factor = 1.65 / fit_ground(0.137 * depth, intrinsics).height
    torch.testing.assert_close(factor, torch.full((4,), 1 / 0.137), rtol=0.03, atol=0)


@pytest.mark.parametrize("option", [{"tolerance": 1.5}, {"max_tilt": -1.0}, {"hypotheses": 0}])
def test_numbers_out_of_range(option: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=next(iter(option))):
        fit_ground(plane_depth(1.0)[0], K, **option)
