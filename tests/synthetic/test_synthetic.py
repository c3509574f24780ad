"""The synthetic world: exact geometry, brightness constancy, seeds."""

from __future__ import annotations

import functools
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from jaxtyping import TypeCheckError

from saunet.errors import ConfigError, DataError
from saunet.geometry.warp import synthesize
from saunet.synthetic import SyntheticDrive
from saunet.synthetic.world import FASTEST, SLOWEST, World

SIZE = {"height": 64, "width": 192}


@functools.cache
def drive(seed: int = 3, frames: int = 4, moving_cars: int = 0, **changes: Any) -> SyntheticDrive:
    return SyntheticDrive(seed=seed, frames=frames, moving_cars=moving_cars, **{**SIZE, **changes})


def tensor(image: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255


def warped(target: SyntheticDrive, source: SyntheticDrive, i: int, j: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Photometric error after warping with the truth, without warping, and where the warp is inside the picture."""
    depth = torch.from_numpy(target.depth(i))[None, None]
    depth = torch.where(depth > 0, depth, torch.full_like(depth, 1e6))
    T_src_tgt = torch.from_numpy(np.linalg.inv(source.pose(j)) @ target.pose(i)).float()[None, None]
    K = torch.from_numpy(target.intrinsics(i)).float()[None]
    view = synthesize(tensor(source.image(j))[:, None], depth, K, T_src_tgt)
    error = (view.image[:, 0] - tensor(target.image(i))).abs().mean(1)[0].numpy()
    identity = (tensor(source.image(j)) - tensor(target.image(i))).abs().mean(1)[0].numpy()
    return error, identity, view.valid[0, 0, 0].numpy()


@pytest.mark.parametrize("seed", [0, 1, 5])
@pytest.mark.parametrize("step", [1, -1])
def test_true_depth_and_motion_explain_the_neighboring_frame(seed: int, step: int) -> None:
    error, identity, valid = warped(drive(seed), drive(seed), 1, 1 + step)
    assert valid.mean() > 0.7
    assert np.median(error[valid]) < 0.012
    assert np.median(error[valid]) < 0.5 * np.median(identity[valid])
    assert error[valid].mean() < 0.5 * identity[valid].mean()


def test_true_depth_explains_the_right_camera() -> None:
    left = drive(1)
    error, identity, valid = warped(left, left.stereo(), 0, 0)
    assert np.median(error[valid]) < 0.012
    assert error[valid].mean() < 0.6 * identity[valid].mean()
    np.testing.assert_allclose(np.linalg.inv(left.pose(0)) @ left.stereo().pose(0), translation(0.54, 0, 0), atol=1e-12)


def translation(*meters: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = meters
    return T


@pytest.mark.parametrize("camera_height", [0.8, 1.65])
def test_depth_of_the_road_is_the_closed_form(camera_height: float) -> None:
    recording = drive(7, camera_height=camera_height)
    K, T, depth = recording.intrinsics(), recording.pose(2), recording.depth(2)
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]]
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1)
    down = rays @ T[1, :3]
    plane = np.where(down > 1e-6, camera_height / np.maximum(down, 1e-6), np.inf)
    on_plane = np.abs(depth / plane - 1) < 1e-5
    assert T[1, 3] == -camera_height
    assert on_plane.mean() > 0.1
    assert on_plane[-4:].mean() > 0.5
    assert (depth <= plane * 1.0001)[down > 0].all()  # nothing lies below the road


def test_pavement_is_a_kerb_higher_than_the_road() -> None:
    recording = drive(7)
    points = _points(recording, 0)
    heights = -points[..., 1][recording.depth(0) > 0]
    assert heights.min() > -1e-3
    near = np.sort(heights[heights < 0.3])
    assert np.mean(np.abs(near) < 1e-3) > 0.2
    assert np.mean(np.abs(near - 0.12) < 1e-3) > 0.03


def _points(recording: SyntheticDrive, index: int) -> np.ndarray:
    K, T, depth = recording.intrinsics(), recording.pose(index), recording.depth(index)
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]]
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1)
    return (rays * depth[..., None]) @ T[:3, :3].T + T[:3, 3]


def test_depth_does_not_depend_on_resolution() -> None:
    small, large = drive(4, 1), drive(4, 1, height=192, width=576)
    K, fine = small.intrinsics(), large.intrinsics()
    v, u = np.mgrid[: SIZE["height"], : SIZE["width"]]
    x = (u - K[0, 2]) / K[0, 0] * fine[0, 0] + fine[0, 2]
    y = (v - K[1, 2]) / K[1, 1] * fine[1, 1] + fine[1, 2]
    nearest = large.depth(0)[np.rint(y).astype(int).clip(0, 191), np.rint(x).astype(int).clip(0, 575)]
    both = (nearest > 0) & (small.depth(0) > 0)
    assert np.median(np.abs(nearest - small.depth(0))[both] / nearest[both]) < 0.02


def test_the_sky_has_no_depth_and_the_rest_has() -> None:
    depth = drive(3).depth(0)
    assert depth.dtype == np.float32
    assert depth.shape == (64, 192)
    assert 0.02 < (depth == 0).mean() < 0.6
    assert (depth[-10:] > 0).all()
    assert np.isfinite(depth).all()
    assert depth[depth > 0].min() > 0.3
    assert 80 < depth.max() <= 1000


def test_pictures_have_contrast_near_and_far() -> None:
    image, depth = (
        drive(3, height=128, width=384).image(0).astype(float).mean(-1),
        drive(3, height=128, width=384).depth(0),
    )
    slope = np.abs(np.diff(image, axis=1))[:, :-1]
    for near, far in ((2, 10), (10, 25), (25, 60)):
        band = (depth[:, 1:-1] > near) & (depth[:, 1:-1] < far)
        assert slope[band].mean() > 2.0, (near, far)
    assert image.std() > 25


def test_equal_seeds_give_equal_bytes_and_others_other_streets() -> None:
    again = SyntheticDrive(seed=3, frames=4, **SIZE)
    assert again.image(2).tobytes() == drive(3).image(2).tobytes()
    assert again.depth(2).tobytes() == drive(3).depth(2).tobytes()
    pictures = [drive(seed).image(0).astype(float) for seed in (0, 1, 3, 5)]
    for i, first in enumerate(pictures):
        for second in pictures[:i]:
            assert np.abs(first - second).mean() > 10


def test_frames_do_not_depend_on_the_order_of_asking() -> None:
    backwards = SyntheticDrive(seed=3, frames=4, **SIZE)
    backwards.image(3)
    assert backwards.image(0).tobytes() == drive(3).image(0).tobytes()


def test_mean_depth_maps_of_streets_differ() -> None:
    maps = np.stack([np.log(np.maximum(drive(seed, 1).depth(0), 1.0)) for seed in range(8)])
    upper = maps[:, 5:40]  # above the road in front
    assert upper.std(axis=0).mean() > 0.5


def test_motion_is_that_of_a_car() -> None:
    long = SyntheticDrive(seed=12, frames=80, **SIZE)
    poses = np.stack([long.pose(i) for i in long.indices])
    np.testing.assert_allclose(
        poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1), np.eye(3)[None].repeat(80, 0), atol=1e-12
    )
    relative = np.linalg.inv(poses[:-1]) @ poses[1:]
    step = np.linalg.norm(relative[:, :3, 3], axis=1)
    assert step.min() > SLOWEST * 0.9
    assert step.max() < FASTEST * 1.1
    assert step.std() > 0.005
    assert relative[:, 2, 3].min() > 0.5
    turn = np.degrees(np.arctan2(relative[:, 0, 2], relative[:, 2, 2]))
    assert 0.05 < np.abs(turn).max() < 3


def test_streets_bend() -> None:
    headings = [abs(World(seed, 60.0).road.heading_at(60.0)) for seed in range(6)]
    assert max(headings) > np.radians(8)


def test_street_coordinates_invert() -> None:
    road = World(2, 50.0).road
    wanted = [(10.0, 3.0), (40.0, -6.0), (75.0, 12.0), (120.0, 0.0)]
    x, z = np.array([road.point(*place) for place in wanted], np.float32).T
    along, across, cosine, sine = road.locate(x, z)
    np.testing.assert_allclose(np.stack([along, across], 1), wanted, atol=0.06)
    np.testing.assert_allclose(cosine**2 + sine**2, 1, atol=1e-3)
    assert road.locate(np.array([5000.0], np.float32), np.array([0.0], np.float32))[1][0] > 500


def test_moving_cars_move_and_parked_ones_do_not() -> None:
    world = World(6, 40.0, moving_cars=2)
    count = world.polygons.count
    before, after = world.polygons_at(0), world.polygons_at(5)
    np.testing.assert_array_equal(before.corners[:count], after.corners[:count])
    moved = np.linalg.norm(after.corners[count:] - before.corners[count:], axis=-1)
    assert before.count > count
    assert moved.min() > 2
    assert moved.max() < 8
    ahead, oncoming = world.moving
    assert ahead.speed > 0 > oncoming.speed


def test_moving_cars_break_the_static_world() -> None:
    still, moving = drive(6, 6), drive(6, 6, moving_cars=1)
    np.testing.assert_allclose(still.pose(5), moving.pose(5))
    car = np.abs(still.depth(2) - moving.depth(2)) > 0.1
    assert 0.002 < car.mean() < 0.3
    error, _, valid = warped(moving, moving, 2, 4)
    seen = car & valid
    assert error[seen].mean() > 1.5 * warped(still, still, 2, 4)[0][seen].mean()


def test_cache_on_disk_gives_the_same_bytes(tmp_path: Path) -> None:
    first = SyntheticDrive(seed=3, frames=2, cache=tmp_path, **SIZE)
    calls: list[int] = []
    first.render(lambda: calls.append(1))
    assert len(calls) == 2
    (file,) = tmp_path.iterdir()
    second = SyntheticDrive(seed=3, frames=2, cache=tmp_path, **SIZE)
    second.render()
    assert "world" not in second.__dict__  # nothing was rendered
    assert second.image(1).tobytes() == first.image(1).tobytes()
    assert second.depth(1).tobytes() == first.depth(1).tobytes()
    SyntheticDrive(seed=3, frames=2, camera_height=1.5, cache=tmp_path, **SIZE).render()
    assert len(list(tmp_path.iterdir())) == 2
    file.write_bytes(b"broken")
    with pytest.raises(DataError, match="delete it to render it again"):
        SyntheticDrive(seed=3, frames=2, cache=tmp_path, **SIZE).render()


def test_cache_that_cannot_be_written_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="cannot write"):
        SyntheticDrive(seed=3, frames=1, cache=tmp_path / "file", **SIZE).render()


def test_drives_pickle() -> None:
    copy = pickle.loads(pickle.dumps(drive(3)))
    assert copy.image(1).tobytes() == drive(3).image(1).tobytes()
    assert copy.name == "synthetic/000003 l"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames": 0}, "frames is 0"),
        ({"width": -3}, "width is -3"),
        ({"moving_cars": -1}, "moving_cars is -1"),
        ({"camera_height": 0.1}, "camera_height is 0.1 m"),
        ({"seed": -1}, "seed is -1"),
        ({"camera": "middle"}, "camera is 'middle'|parameter camera="),
    ],
)
def test_impossible_settings_are_one_sentence(changes: dict[str, Any], message: str) -> None:
    with pytest.raises((ConfigError, TypeCheckError), match=message):
        SyntheticDrive(**{**SIZE, **changes})


def test_a_frame_that_does_not_exist_is_one_sentence() -> None:
    with pytest.raises(DataError, match="has no frame 99; it has 0 to 3"):
        drive(3).image(99)


@pytest.mark.parametrize("length", [0.0, 3.0, 17.3, 58.9, 150.0])
def test_streets_of_any_length_are_built(length: float) -> None:
    world = World(int(length), length, moving_cars=3)
    assert world.road.along[-1] > length + 150
    assert world.polygons.count > 100
    assert np.isfinite(world.polygons.corners).all()
