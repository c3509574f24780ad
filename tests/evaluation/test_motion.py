"""Paths from pose networks: a network that knows the true motion gives the true path, whatever it takes as input."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import nn

from saunet.checks import ConfigError, DataError
from saunet.evaluation.motion import plan, predict_trajectory


class NumberedDrive:
    """Every pixel of a frame is its number."""

    name = "numbered l"

    def __init__(self, frames, missing=()):
        self.indices = [10 + i for i in range(frames) if i not in missing]
        self.read = []

    def image(self, index):
        self.read.append(index)
        return np.full((8, 16, 3), index, np.uint8)


def true_path(frames, seed=0):
    rng = np.random.default_rng(seed)
    poses = [np.eye(4)]
    for _ in range(frames - 1):
        step = np.eye(4)
        step[:3, :3] = Rotation.from_rotvec(rng.normal(size=3) * 0.1).as_matrix()
        step[:3, 3] = [0.1 * rng.normal(), 0.05 * rng.normal(), 1.0 + 0.1 * rng.normal()]
        poses.append(poses[-1] @ step)
    return np.stack(poses)


class Oracle(nn.Module):
    """Reads the numbers of the frames and returns their true motion."""

    def __init__(self, path):
        super().__init__()
        self.path, self.calls = path, 0

    def forward(self, target, sources):
        self.calls += len(target)
        number = lambda image: round(float(image.mean()) * 255) - 10
        rows = [
            [np.linalg.inv(self.path[number(source)]) @ self.path[number(one)] for source in others]
            for one, others in zip(target, sources, strict=True)
        ]
        return torch.from_numpy(np.array(rows)).float()


@pytest.mark.parametrize("offsets", [(-1, 1), (1, -1), (1,), (-1,), (-2, -1, 1, 2), (2, 1)])
@pytest.mark.parametrize("frames", [2, 3, 8, 9])
@pytest.mark.parametrize("batch_size", [1, 4])
def test_a_network_that_knows_the_motion_gives_the_path(offsets, frames, batch_size):
    path, drive = true_path(frames), NumberedDrive(frames)
    found = predict_trajectory(
        Oracle(path), drive, offsets=offsets, height=8, width=16, batch_size=batch_size, progress=False
    )
    np.testing.assert_allclose(found, path, atol=1e-5)


def test_each_motion_is_predicted_once_and_each_image_read_once():
    oracle, drive = Oracle(true_path(21)), NumberedDrive(21)
    predict_trajectory(oracle, drive, offsets=(-1, 1), height=8, width=16, batch_size=3, progress=False)
    assert oracle.calls == 10
    assert len(drive.read) == 21


@pytest.mark.parametrize("frames", [2, 3, 4, 7, 10])
@pytest.mark.parametrize("offsets", [(-1, 1), (1,), (-1,), (-1, 0, 1)])
def test_the_plan_covers_every_motion_exactly_once(frames, offsets):
    steps = plan(frames, offsets)
    assert sorted(step.motion for step in steps) == list(range(frames - 1))
    for step in steps:
        source = step.target + offsets[step.slot]
        assert {step.target, source} == {step.motion, step.motion + 1}
        assert step.inverted == (source < step.target)


def test_what_makes_no_path():
    with pytest.raises(ConfigError, match=r"trained on offsets \[-2, 2\].*trained with offset 1 or -1"):
        plan(5, [-2, 2])
    with pytest.raises(DataError, match="1 frames make no path"):
        plan(1, [-1, 1])
    with pytest.raises(DataError, match="'numbered l' has no frame 13"):
        predict_trajectory(
            Oracle(true_path(8)), NumberedDrive(8, missing=(3,)), offsets=(-1, 1), height=8, width=16, progress=False
        )
