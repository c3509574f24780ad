"""View synthesis: Monodepth2's numbers, the pixel convention, and what happens at the edges."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Mapping
from typing import Any

import pytest
import torch
from torch import Tensor

from saunet.geometry.pose import pose_matrix
from saunet.geometry.warp import BEHIND, backproject, project, synthesize, visible

Load = Callable[[str], Mapping[str, Any]]
K_SMALL = torch.tensor([[20.0, 0.0, 7.3], [0.0, 18.0, 5.1], [0.0, 0.0, 1.0]])


def shift(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Tensor:
    """A motion without rotation, b = s = 1."""
    return pose_matrix(torch.zeros(1, 1, 3), torch.tensor([[[x, y, z]]]))


def smooth_image(batch: int, sources: int, height: int, width: int) -> Tensor:
    v, u = torch.meshgrid(torch.arange(height) / height, torch.arange(width) / width, indexing="ij")
    waves = [torch.sin(3 * u + k + s) * torch.cos(2 * v + s) for s in range(sources) for k in range(3)]
    return torch.stack(waves).reshape(1, sources, 3, height, width).expand(batch, -1, -1, -1, -1) * 0.5 + 0.5


@pytest.mark.parametrize("prefix", ["", "hard_", "identity_"])
def test_reference(reference: Load, prefix: str) -> None:
    data = {key: torch.from_numpy(value) for key, value in reference("warp").items()}
    depth = data["depth"] if prefix == "identity_" else data[f"{prefix}depth"]
    K, T = data["K"][:, :3, :3], data[f"{prefix}T"]
    pixels, z = project(backproject(depth, K), K, T)
    grid = 2 * pixels / torch.tensor([159.0, 47.0]) - 1
    view = synthesize(data["source"][:, None], depth, K, T[:, None])
    # The reference mirrors points behind the camera; here they are invalid instead.
    same = torch.ones_like(z, dtype=torch.bool)
    if prefix == "hard_":
        same = (data["hard_well_conditioned"] == 1) & (data["hard_z_in_source"] > 0)
        assert 0.2 < same.float().mean() < 1
    grid_tolerance, image_tolerance = (1e-3, 2e-4) if prefix == "hard_" else (5e-6, 2e-5)
    expected = data[f"{prefix}grid"]
    torch.testing.assert_close(grid[same], expected[same], rtol=0 if prefix != "hard_" else 1e-5, atol=grid_tolerance)
    image = view.image[:, 0].permute(0, 2, 3, 1)[same]
    torch.testing.assert_close(image, data[f"{prefix}warped"].permute(0, 2, 3, 1)[same], rtol=0, atol=image_tolerance)
    if prefix == "identity_":
        assert view.valid.all()
    else:
        at_border = ((expected.abs() - 1).abs() < 1e-3).any(-1)
        clear = (data[f"{prefix}well_conditioned"] == 1) & ~at_border
        assert torch.equal(view.valid[:, 0, 0][clear], data[f"{prefix}inside"][clear] == 1)


def test_zero_motion_changes_nothing() -> None:
    images = torch.rand(2, 3, 3, 24, 80)
    K = torch.tensor([[70.0, 0.0, 38.2], [0.0, 60.0, 11.9], [0.0, 0.0, 1.0]]).expand(2, 3, 3)
    depth = torch.rand(2, 1, 24, 80) * 50 + 0.2
    view = synthesize(images, depth, K, torch.eye(4).expand(2, 3, 4, 4))
    torch.testing.assert_close(view.image, images, rtol=0, atol=2e-5)
    assert view.valid.all()


@pytest.mark.parametrize(("z", "axis"), [(2.0, "x"), (7.5, "x"), (2.0, "y")])
def test_plane_moved_by_z_over_f_shifts_one_pixel(z: float, axis: str) -> None:
    images = torch.rand(1, 1, 3, 12, 16)
    depth, K = torch.full((1, 1, 12, 16), z), K_SMALL[None]
    motion = shift(x=z / 20.0) if axis == "x" else shift(y=z / 18.0)
    view = synthesize(images, depth, K, motion)
    if axis == "x":  # pixel u of the target is pixel u + 1 of the source
        torch.testing.assert_close(view.image[..., :-1], images[..., 1:], rtol=0, atol=1e-5)
        assert view.valid[..., :-1].all()
        assert not view.valid[..., -1].any()
    else:
        torch.testing.assert_close(view.image[..., :-1, :], images[..., 1:, :], rtol=0, atol=1e-5)
        assert view.valid[..., :-1, :].all()
        assert not view.valid[..., -1, :].any()


def test_backprojected_points_project_to_their_pixels() -> None:
    depth = torch.rand(2, 1, 6, 9) * 10 + 0.5
    K = torch.tensor([[20.0, 0.7, 4.0], [0.0, 18.0, 2.0], [0.0, 0.0, 1.0]]).expand(2, 3, 3)
    points = backproject(depth, K)
    torch.testing.assert_close(points[:, 2:], depth)
    pixels, z = project(points, K, torch.eye(4).expand(2, 4, 4))
    v, u = torch.meshgrid(torch.arange(6.0), torch.arange(9.0), indexing="ij")
    torch.testing.assert_close(pixels, torch.stack((u, v), -1).expand(2, 6, 9, 2), rtol=0, atol=1e-5)
    torch.testing.assert_close(z, depth[:, 0])


@pytest.mark.parametrize("z", [-5.0, -2.0, -1.9999])
def test_behind_or_in_the_camera_is_invalid_and_gradients_stay_finite(z: float) -> None:
    depth = torch.full((1, 1, 12, 16), 2.0, requires_grad=True)
    motion = shift(z=z).requires_grad_()
    view = synthesize(torch.rand(1, 1, 3, 12, 16), depth, K_SMALL[None], motion)
    assert not view.valid.any()
    assert view.image.isfinite().all()
    view.image.square().sum().backward()
    assert depth.grad is not None
    assert depth.grad.isfinite().all()
    assert motion.grad is not None
    assert motion.grad.isfinite().all()


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_point_that_is_no_number_is_outside_and_invalid(axis: int) -> None:
    moved = torch.eye(4)[None]
    moved[0, axis, 3] = torch.nan  # of a pose network that has diverged
    pixels, z = project(backproject(torch.full((1, 1, 12, 16), 4.0), K_SMALL[None]), K_SMALL[None], moved)
    assert (pixels == BEHIND).all()
    assert not visible(pixels, z, 12, 16).any()


def test_out_of_view_is_invalid_and_takes_the_border_color() -> None:
    images = torch.rand(1, 1, 3, 12, 16)
    view = synthesize(images, torch.full((1, 1, 12, 16), 2.0), K_SMALL[None], shift(x=1e4))
    assert not view.valid.any()
    torch.testing.assert_close(view.image, images[..., -1:].expand_as(images), rtol=0, atol=1e-5)


def test_infinite_depth_only_rotates() -> None:
    images = smooth_image(1, 1, 12, 16)
    depth = torch.full((1, 1, 12, 16), torch.inf, requires_grad=True)
    moved = synthesize(images, depth, K_SMALL[None], shift(x=1.0, y=-2.0, z=3.0))
    torch.testing.assert_close(moved.image, images, rtol=0, atol=1e-3)
    rotation = torch.tensor([[[0.0, 0.02, 0.0]]])
    both = synthesize(images, depth, K_SMALL[None], pose_matrix(rotation, torch.ones(1, 1, 3)))
    only = synthesize(images, torch.full_like(depth, 5.0), K_SMALL[None], pose_matrix(rotation, torch.zeros(1, 1, 3)))
    torch.testing.assert_close(both.image, only.image, rtol=0, atol=1e-3)
    both.image.sum().backward()
    assert depth.grad is not None
    assert depth.grad.isfinite().all()


def test_sources_do_not_mix() -> None:
    images, depth = torch.rand(2, 3, 3, 10, 14), torch.rand(2, 1, 10, 14) * 5 + 1
    K = K_SMALL.expand(2, 3, 3)
    motions = pose_matrix(torch.randn(2, 3, 3) * 0.02, torch.randn(2, 3, 3) * 0.1)
    together = synthesize(images, depth, K, motions)
    for s in range(3):
        alone = synthesize(images[:, s : s + 1], depth, K, motions[:, s : s + 1])
        torch.testing.assert_close(together.image[:, s : s + 1], alone.image, rtol=0, atol=1e-6)
        assert torch.equal(together.valid[:, s : s + 1], alone.valid)


@pytest.mark.usefixtures("unchecked")
def test_gradcheck() -> None:
    images = smooth_image(1, 2, 5, 6).double().contiguous().requires_grad_()
    depth = (torch.rand(1, 1, 5, 6, dtype=torch.float64) * 2 + 3).requires_grad_()
    K = torch.tensor([[[6.0, 0.1, 2.6], [0.0, 5.5, 2.2], [0.0, 0.0, 1.0]]], dtype=torch.float64).requires_grad_()
    axisangle = torch.tensor([[[0.02, -0.03, 0.01], [-0.01, 0.02, 0.03]]], dtype=torch.float64).requires_grad_()
    translation = torch.tensor([[[0.21, 0.13, -0.1], [-0.17, 0.08, 0.2]]], dtype=torch.float64).requires_grad_()

    def warped(images: Tensor, depth: Tensor, K: Tensor, axisangle: Tensor, translation: Tensor) -> Tensor:
        view = synthesize(images, depth, K, pose_matrix(axisangle, translation))
        return view.image * view.valid  # the border is a kink

    assert torch.autograd.gradcheck(warped, (images, depth, K, axisangle, translation))


def test_full_precision_inside_autocast() -> None:
    images, depth = torch.rand(1, 2, 3, 12, 16), torch.rand(1, 1, 12, 16) + 2
    motions = pose_matrix(torch.randn(1, 2, 3) * 0.02, torch.randn(1, 2, 3) * 0.1)
    outside = synthesize(images, depth, K_SMALL[None], motions)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        inside = synthesize(images, depth, K_SMALL[None], motions)
    torch.testing.assert_close(inside.image, outside.image, rtol=0, atol=0)


COMPILE = """
import torch
from saunet.geometry.pose import pose_matrix
from saunet.geometry.warp import synthesize

def step(images, depth, K, axisangle, translation):
    return synthesize(images, depth, K, pose_matrix(axisangle, translation))

K = torch.tensor([[[20.0, 0.0, 7.3], [0.0, 18.0, 5.1], [0.0, 0.0, 1.0]]])
inputs = torch.rand(1, 2, 3, 12, 16), torch.rand(1, 1, 12, 16) + 2, K, torch.randn(1, 2, 3) * 0.02, torch.rand(1, 2, 3)
found, expected = torch.compile(step, fullgraph=True, backend="aot_eager")(*inputs), step(*inputs)
torch.testing.assert_close(found.image, expected.image, rtol=0, atol=1e-5)
assert torch.equal(found.valid, expected.valid)
"""


@pytest.mark.slow
def test_compiles_as_one_graph() -> None:
    # In a process of its own: the shape checks that pytest installs cannot be compiled.
    done = subprocess.run([sys.executable, "-c", COMPILE], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
