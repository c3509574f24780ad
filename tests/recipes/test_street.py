"""The recipe of the shipped model: its renderer's depth is exact, and its networks learn from what it renders."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

RECIPE = Path(__file__).parents[2] / "recipes" / "street"
for needed in ("embreex", "trimesh"):
    pytest.importorskip(needed, reason=f"{needed} of recipes/street/requirements.txt is not installed")


@pytest.fixture(autouse=True)
def recipe_on_path(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the recipe's scripts import each other, as when they are run."""
    monkeypatch.setattr(sys, "path", [str(RECIPE), *sys.path])


@pytest.fixture
def scenes(tmp_path: Path) -> Path:
    """A folder with one scene of two views, one of them a pair, without textures."""
    import render

    render.save(tmp_path / "000001.npz", render.scene(1, None, views=2, pairs=1, height=64, width=192))
    return tmp_path


def test_depth_is_camera_z_of_the_planes_hit() -> None:
    """A wall 10 m ahead has depth 10 in every pixel; the ground has camera height * fy / (row - cy)."""
    import meshes
    import render

    soup, materials = meshes.Soup(), meshes.Materials()
    gray = materials.add((0.5, 0.5, 0.5))
    soup.add(meshes.quads([-99, 0, 10], [99, 0, 10], [99, 99, 10], [-99, 99, 10]), gray)
    soup.add(meshes.quads([-99, 0, -99], [99, 0, -99], [99, 0, 99], [-99, 0, 99]), gray)
    light = SimpleNamespace(
        sun=np.array([0, 1, 0], np.float32),
        sun_color=np.ones(3, np.float32),
        sky_color=np.ones(3, np.float32),
        horizon_color=np.ones(3, np.float32),
        fog=0.0,
    )
    street = SimpleNamespace(soup=soup, materials=materials, light=light, vehicles=[])
    K = np.array([[100.0, 0, 79.5], [0, 100, 23.5], [0, 0, 1]])
    T = np.diag([1.0, -1, 1, 1])
    T[1, 3] = 1.5
    image, depth = render.Renderer(street, None).render(np.random.default_rng(0), T, K, 48, 160)
    rows = np.arange(48)
    with np.errstate(divide="ignore"):
        ground = np.where(rows > 23.5, 1.5 * 100 / (rows - 23.5), np.inf)
    expected = np.broadcast_to(np.minimum(10.0, ground)[:, None], (48, 160))
    np.testing.assert_allclose(depth, expected, rtol=1e-4)
    assert np.isfinite(image).all()
    assert image.min() > 0


def test_a_pair_agrees_with_its_motion(scenes: Path) -> None:
    """Points of the first frame, moved by the recorded poses, land on the second frame's depth."""
    with np.load(scenes / "000001.npz") as data:
        depth, K, T, second = (
            data["depth"].astype(float),
            data["K"][0].astype(float),
            data["T_world_cam"],
            data["second"],
        )
    assert second.tolist() == [False, True, False]
    assert depth[0].min() >= 0
    assert (depth > 0).mean() > 0.3
    v, u = np.nonzero((depth[0] > 1) & (depth[0] < 40))
    points = np.linalg.inv(K) @ (np.stack([u, v, np.ones_like(u)]) * depth[0][v, u])
    moved = (np.linalg.inv(T[1]) @ T[0] @ np.vstack([points, np.ones_like(u)]))[:3]
    pixel = K @ moved
    x, y = np.round(pixel[0] / pixel[2]).astype(int), np.round(pixel[1] / pixel[2]).astype(int)
    inside = (moved[2] > 0) & (x >= 0) & (x < 192) & (y >= 0) & (y < 64)
    error = np.abs(depth[1][y[inside], x[inside]] - moved[2][inside]) / moved[2][inside]
    assert np.median(error) < 0.03  # traffic and hidden parts differ


def test_both_networks_learn_from_two_steps(scenes: Path) -> None:
    """The losses of depth and pose are finite and their gradients reach the encoder."""
    import frames
    import train_depth
    import train_pose

    rng, size = np.random.default_rng(0), (64, 192)
    loaded = frames.Frames(scenes)
    assert loaded.pairs == [0]
    depth, pose = train_depth.build(weights=None), train_pose.build()
    for network in (depth, pose):
        optimizer = torch.optim.SGD(network.parameters(), lr=1e-4)
        for _ in range(2):
            if network is depth:
                image, target = loaded.depth_sample(rng, 0, size)
                batch = torch.from_numpy(image).permute(2, 0, 1)[None]
                value = train_depth.loss(train_depth.forward(depth, batch, 0), torch.from_numpy(target)[None, None])
            else:
                a, b, T = loaded.pair_sample(rng, 0, size)
                one, two = (torch.from_numpy(x).permute(2, 0, 1)[None] for x in (a, b))
                value = train_pose.loss(train_pose.motion(pose, one, two), torch.from_numpy(T)[None].float())
            optimizer.zero_grad()
            value.backward()
            assert torch.isfinite(value)
            first = network.encoder.conv_stem if network is depth else network.layers[0]
            assert first.weight.grad.abs().sum() > 0
            optimizer.step()
    out = train_depth.forward(depth, batch := torch.rand(1, 3, *size), 0)
    torch.testing.assert_close(out, depth(batch).depth)
