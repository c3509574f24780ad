"""The recipe of the shipped model: its renderer's depth is exact, and its networks learn from what it renders."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

RECIPE = Path(__file__).parents[2] / "recipes" / "street"


@pytest.fixture
def renderer() -> None:
    """What only render.py needs."""
    for needed in ("embreex", "trimesh"):
        pytest.importorskip(needed, reason=f"{needed} of recipes/street/requirements.txt is not installed")


@pytest.fixture(autouse=True)
def recipe_on_path(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the recipe's scripts import each other, as when they are run."""
    monkeypatch.setattr(sys, "path", [str(RECIPE), *sys.path])


@pytest.fixture
def scenes(tmp_path: Path, renderer: None) -> Path:
    """A folder with one scene of two views, one of them a pair, without textures."""
    import frames
    import render

    frames.save(tmp_path / "000001.npz", render.scene(1, None, views=2, pairs=1, height=64, width=192))
    return tmp_path


def test_depth_is_camera_z_of_the_planes_hit(renderer: None) -> None:
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


def test_streets_of_the_own_world_are_scenes_too(tmp_path: Path) -> None:
    """Frames read from a drive's file have its depth, seen as a camera of KITTI's angle sees it."""
    import builtin
    import frames

    scene = builtin.scene(3, height=64, width=192)
    frames.save(tmp_path / "900003.npz", scene)
    loaded = frames.Frames(tmp_path)
    assert (len(loaded.images), loaded.pairs) == (builtin.VIEWS, [])
    image, depth = loaded.depth_sample(np.random.default_rng(0), 1, (64, 192), augment=False)
    assert image.shape == (64, 192, 3)
    truth = np.asarray(scene["depth"])[1].astype(np.float32)
    ground = slice(48, None), slice(80, 112)  # the road before the camera has no gaps to close
    focal = np.asarray(scene["K"])[1][0, 0] / 192
    np.testing.assert_allclose(depth[ground], truth[ground] * frames.CANONICAL_FOCAL / focal, rtol=1e-3)


def test_the_depth_network_learns_from_two_steps(tmp_path: Path) -> None:
    """Its loss is finite, gradients reach the encoder, and the training's way through it gives its own depths."""
    import builtin
    import frames
    import train_depth

    frames.save(tmp_path / "900001.npz", builtin.scene(1, height=64, width=192))
    rng, size, network = np.random.default_rng(0), (64, 192), train_depth.build(weights=None)
    loaded, optimizer = frames.Frames(tmp_path), torch.optim.SGD(network.parameters(), lr=1e-4)
    for _ in range(2):
        image, target = loaded.depth_sample(rng, 0, size)
        batch = torch.from_numpy(image).permute(2, 0, 1)[None]
        value = train_depth.loss(train_depth.forward(network, batch, 0), torch.from_numpy(target)[None, None])
        optimizer.zero_grad()
        value.backward()
        assert torch.isfinite(value)
        assert network.encoder.conv_stem.weight.grad.abs().sum() > 0
        optimizer.step()
    batch = torch.rand(1, 3, *size)
    whole = network(batch).depth
    for finest in range(3):
        torch.testing.assert_close(train_depth.forward(network, batch, finest), whole[finest:])


def test_weights_are_averaged_and_counts_are_not() -> None:
    """Floating point is averaged, and a batch normalization's count of batches is that of the first."""
    import average

    states = [{"w": torch.full((2,), x), "n": torch.tensor(n)} for x, n in ((1.0, 4), (2.0, 5), (6.0, 6))]
    mean = average.average(states)
    assert mean["w"].tolist() == [3.0, 3.0]
    assert mean["n"] == 4


def test_crowns_are_bodies_and_poles_stay_thin() -> None:
    """Gaps between leaves are closed, wider ones in the upper half; what is near keeps its shape."""
    import frames

    depth = np.zeros((160, 200), np.float32)
    depth[20:60:12, 40:100] = depth[20:60, 40:100:12] = 10.0  # leaves with gaps of 11 pixels before the sky
    depth[100:140:12, 40:100] = depth[100:140, 40:100:12] = 10.0
    depth[:, 150:152] = 5.0
    closed = frames.close_gaps(depth)
    assert (closed[24:56, 44:96] == 10).all()
    assert (closed[101:112, 41:52] == 0).mean() > 0.3
    assert (closed[:, 150:152] == 5).all()
    assert (closed[:, 110:145] == 0).all()
    assert (closed[:, 160:] == 0).all()


def test_the_pose_network_learns_from_two_steps(scenes: Path) -> None:
    """Its loss is finite and gradients reach its first layer."""
    import frames
    import train_pose

    rng, network, loaded = np.random.default_rng(0), train_pose.build(), frames.Frames(scenes)
    assert loaded.pairs == [0]
    optimizer = torch.optim.SGD(network.parameters(), lr=1e-4)
    for _ in range(2):
        a, b, T = loaded.pair_sample(rng, 0, (64, 192))
        one, two = (torch.from_numpy(x).permute(2, 0, 1)[None] for x in (a, b))
        value = train_pose.loss(train_pose.motion(network, one, two), torch.from_numpy(T)[None].float())
        optimizer.zero_grad()
        value.backward()
        assert torch.isfinite(value)
        assert network.layers[0].weight.grad.abs().sum() > 0
        optimizer.step()
