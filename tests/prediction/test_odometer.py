"""Paths from pose networks: a network that knows the true motion gives the true path, whatever it takes as input."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from drives import NumberDrive
from scipy.spatial.transform import Rotation
from torch import nn

from saunet.errors import CheckpointError, ConfigError, DataError
from saunet.prediction.odometer import Odometer, TrackedPose, follow
from saunet.runs.record import Scale
from saunet.synthetic import SyntheticDrive
from saunet.types import DepthPyramid


class NumberedDrive(NumberDrive):
    """Every pixel of a frame is its number."""

    def __init__(self, frames, missing=()):
        super().__init__("numbered l", [10 + i for i in range(frames) if i not in missing])
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

    def __init__(self, path, offsets):
        super().__init__()
        self.path, self.offsets, self.asked, self.batches = path, offsets, [], []

    def forward(self, target, sources):
        number = lambda image: round(float(image.mean()) * 255) - 10
        rows = []
        for one, others in zip(target, sources, strict=True):
            self.asked.append((number(one), [number(source) for source in others]))
            center, near = self.asked[-1]
            rows.append([np.linalg.inv(self.path[source]) @ self.path[center] for source in near])
        self.batches.append(len(target))
        return torch.from_numpy(np.array(rows)).float()


@pytest.mark.parametrize("offsets", [(-1, 1), (1, -1), (1,), (-1,), (-2, -1, 1, 2), (2, 1), (-2, 1), (-1, 0, 1)])
@pytest.mark.parametrize("frames", [2, 3, 8, 9])
@pytest.mark.parametrize("batch_size", [1, 4])
def test_a_network_that_knows_the_motion_gives_the_path(offsets, frames, batch_size):
    path = true_path(frames)
    oracle = Oracle(path, offsets)
    found = follow(Odometer(oracle, 8, 16, batch_size=batch_size), NumberedDrive(frames), progress=False)
    np.testing.assert_allclose(found, path, atol=1e-5)
    assert max(oracle.batches) <= batch_size
    for center, near in oracle.asked:  # sources beyond the ends stop at the ends
        assert near == [min(max(center + offset, 0), frames - 1) for offset in offsets]


@pytest.mark.parametrize("offsets", [(-1, 1), (-2, -1, 1, 2), (1,), (-1,)])
def test_a_path_may_be_read_on_the_way(offsets):
    path, drive = true_path(12), NumberedDrive(12)
    odometer = Odometer(Oracle(path, offsets), 8, 16, batch_size=3)
    for count, index in enumerate(drive.indices, start=1):
        odometer.add(drive.image(index))
        if count >= 2:
            np.testing.assert_allclose(odometer.trajectory(), path[:count], atol=1e-5)


def test_each_motion_is_predicted_once_and_each_image_read_once():
    oracle, drive = Oracle(true_path(21), (-1, 1)), NumberedDrive(21)
    follow(Odometer(oracle, 8, 16, batch_size=3), drive, progress=False)
    assert len(oracle.asked) == 10
    assert len(drive.read) == 21


def test_one_network_follows_several_recordings():
    path = true_path(9)
    odometer = Odometer(Oracle(path, (-1, 1)), 8, 16)
    for frames in (9, 4):
        np.testing.assert_allclose(follow(odometer, NumberedDrive(frames), progress=False), path[:frames], atol=1e-5)


def test_scale_is_applied_to_distances_only():
    path = true_path(5)
    found = follow(Odometer(Oracle(path, (-1, 1)), 8, 16, Scale(2.5, "camera height")), NumberedDrive(5), False)
    expected = path.copy()
    expected[:, :3, 3] *= 2.5
    np.testing.assert_allclose(found, expected, atol=1e-5)


class TrueDepth(nn.Module):
    """Knows the depth of the frame that it sees; the sky is far away."""

    def __init__(self, drive):
        super().__init__()
        self.known = {drive.image(index).tobytes(): drive.depth(index) for index in drive.indices}

    def forward(self, image):
        pictures = (image * 255).round().byte().permute(0, 2, 3, 1).numpy()
        depth = torch.from_numpy(np.stack([self.known[each.tobytes()] for each in pictures]))[:, None]
        depth = depth.where(depth > 0, 1000.0)
        return DepthPyramid((depth,), (1 / depth,), (depth,))


@pytest.mark.parametrize("batch_size", [1, 4])
def test_tracked_points_and_depth_give_the_path_without_a_pose_network(batch_size):
    drive = SyntheticDrive(seed=8, frames=9, height=160, width=512)
    odometer = Odometer(TrackedPose(TrueDepth(drive)), 160, 512, batch_size=batch_size)
    assert odometer.tracks
    found = follow(odometer, drive, progress=False)
    true = np.stack([np.linalg.inv(drive.pose(0)) @ drive.pose(index) for index in drive.indices])
    assert np.linalg.norm(true[-1, :3, 3]) > 5
    np.testing.assert_allclose(found[:, :3, 3], true[:, :3, 3], atol=0.2)
    np.testing.assert_allclose(found[:, :3, :3], true[:, :3, :3], atol=0.005)


def test_a_step_without_points_goes_on_as_the_one_before():
    drive = SyntheticDrive(seed=8, frames=5, height=160, width=512)
    known = TrueDepth(drive)
    fog = np.full((160, 512, 3), 99, np.uint8)
    known.known[fog.tobytes()] = drive.depth(0)
    odometer = Odometer(TrackedPose(known), 160, 512)
    for index in drive.indices:
        odometer.add(fog if index == 3 else drive.image(index), drive.intrinsics(index))
    with pytest.warns(UserWarning, match="in 2 of 4 steps of the path"):
        path = odometer.trajectory()
    steps = np.linalg.inv(path[:-1]) @ path[1:]
    np.testing.assert_allclose(steps[2:], np.stack([steps[1]] * 2), atol=1e-9)
    blind = Odometer(TrackedPose(known), 160, 512)
    for _ in range(3):
        blind.add(fog, drive.intrinsics(0))
    with pytest.raises(DataError, match="unknown between all 3 frames"):
        blind.trajectory()


def test_what_makes_no_path(tmp_path: Path):
    with pytest.raises(ConfigError, match=r"trained on offsets \[-2, 2\].*trained with offset 1 or -1"):
        Odometer(Oracle(true_path(2), (-2, 2)), 8, 16)
    with pytest.raises(ConfigError, match="has no pose network"):
        Odometer.from_model(tmp_path / "model.onnx")
    odometer = Odometer(Oracle(true_path(8), (-1, 1)), 8, 16)
    for frames in (0, 1):
        with pytest.raises(DataError, match=f"needs at least 2 frames, got {frames}"):
            follow(odometer, NumberedDrive(frames), progress=False)
    with pytest.raises(DataError, match="'numbered l' has no frame 13"):
        follow(odometer, NumberedDrive(8, missing=(3,)), progress=False)
    broken = np.tile(np.eye(4), (3, 1, 1))
    broken[1, 0, 3] = np.nan
    with pytest.raises(CheckpointError, match="not finite"):
        follow(Odometer(Oracle(broken, (1,)), 8, 16), NumberedDrive(3), progress=False)


def test_every_clip_is_told_why_points_are_tracked():
    """The odometer of another clip says what that of the first one said."""
    for asked_for, why in ((True, "requested by motion=tracked"), (False, "the model has no pose network")):
        odometer = Odometer(TrackedPose(nn.Identity(), asked_for), 64, 96)
        assert why in odometer.told
        assert odometer.restart().told == odometer.told
