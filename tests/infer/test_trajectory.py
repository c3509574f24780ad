"""The camera's path: motions chained the right way round, for every kind of pose network, and a picture of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from saunet.checks import CheckpointError, ConfigError, DataError
from saunet.images import read_image
from saunet.infer.trajectory import Odometer, draw_from_above, write_trajectory
from saunet.record import Scale
from saunet.trajectories import read_kitti


def truth(count: int) -> NDArray[np.float64]:
    """A camera that drives ahead and turns left: camera-to-world."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    for index in range(1, count):
        turn = np.eye(4)
        angle = 0.02 * index
        turn[:3, :3] = [[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]]
        turn[:3, 3] = (0.01 * index, 0.0, 1.0)
        poses[index] = poses[index - 1] @ turn
    return poses


class Oracle(nn.Module):
    """Reads the frames' numbers off their pixels and knows the truth."""

    def __init__(self, offsets: tuple[int, ...], count: int) -> None:
        super().__init__()
        self.offsets = offsets
        self.poses = truth(count)
        self.asked: list[tuple[int, list[int]]] = []

    def forward(self, target: Tensor, sources: Tensor) -> Tensor:
        def number(image: Tensor) -> int:
            return round(float(image.mean()) * 255)

        frame, others = number(target), [number(source) for source in sources[0]]
        self.asked.append((frame, others))
        T = [np.linalg.inv(self.poses[other]) @ self.poses[frame] for other in others]
        return torch.from_numpy(np.stack(T))[None].float()


def frames(count: int) -> list[NDArray[np.uint8]]:
    return [np.full((12, 20, 3), index, np.uint8) for index in range(count)]


@pytest.mark.parametrize("offsets", [(-1, 1), (1, -1), (1,), (-1,), (-2, -1, 1, 2), (-2, 1)])
def test_any_pose_network_gives_the_path(offsets: tuple[int, ...]) -> None:
    oracle = Oracle(offsets, 9)
    odometer = Odometer(oracle, 6, 10)
    for frame in frames(9):
        odometer.add(frame)
    assert np.allclose(odometer.trajectory(), truth(9), atol=1e-5)
    for frame, others in oracle.asked:  # real neighbours only; farther sources may stop at the borders
        assert [other - frame for other, offset in zip(others, offsets, strict=True) if abs(offset) == 1] == [
            offset for offset in offsets if abs(offset) == 1
        ]


def test_scale_is_applied_to_distances_only() -> None:
    odometer = Odometer(Oracle((-1, 1), 5), 6, 10, Scale(2.5, "camera height"))
    for frame in frames(5):
        odometer.add(frame)
    expected = truth(5)
    expected[:, :3, 3] *= 2.5
    assert np.allclose(odometer.trajectory(), expected, atol=1e-5)


def test_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"offsets \[-2, 2\]; a trajectory needs 1 or -1"):
        Odometer(Oracle((-2, 2), 1), 6, 10)
    with pytest.raises(ConfigError, match="has no pose network"):
        Odometer.from_model(tmp_path / "model.onnx")
    for count in (0, 1, 2):
        odometer = Odometer(Oracle((-1, 1), 3), 6, 10)
        for frame in frames(count):
            odometer.add(frame)
        with pytest.raises(DataError, match=f"needs at least 3 frames, got {count}"):
            odometer.trajectory()
    broken = Oracle((1,), 3)
    broken.poses[:] = np.eye(4)
    broken.poses[1, 0, 3] = np.nan
    odometer = Odometer(broken, 6, 10)
    for frame in frames(3):
        odometer.add(frame)
    with pytest.raises(CheckpointError, match="not finite"):
        odometer.trajectory()


def test_picture_and_poses(tmp_path: Path) -> None:
    poses = truth(30)
    write_trajectory(tmp_path / "x.png", poses, metric=True)
    assert np.array_equal(read_kitti(tmp_path / "x.txt"), poses)
    picture = read_image(tmp_path / "x.png").astype(int)
    assert picture.shape == (800, 800, 3)
    green = np.argwhere((picture[:, :, 1] > 120) & (picture[:, :, 0] < 80) & (picture[:, :, 2] < 100)).mean(axis=0)
    red = np.argwhere((picture[:, :, 0] > 180) & (picture[:, :, 1] < 90)).mean(axis=0)
    assert green[0] > red[0], "the start is below the end"
    assert green[1] > red[1], "the path turns left"


@pytest.mark.parametrize("count", [2, 3])
def test_a_camera_that_stands_still_is_drawn(count: int) -> None:
    assert draw_from_above(np.tile(np.eye(4), (count, 1, 1)), metric=False).shape == (800, 800, 3)
