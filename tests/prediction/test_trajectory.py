"""The camera's path as a picture and as poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from saunet.io.images import read_image
from saunet.io.trajectories import read_kitti
from saunet.prediction.odometer import draw_from_above, write_trajectory


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
