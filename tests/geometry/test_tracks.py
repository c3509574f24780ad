"""Motion from tracked points against the renderer's, whatever the depth; turns alone; a camera that stands still."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from saunet.geometry.camera import scale_intrinsics
from saunet.geometry.pose import scaled_motion
from saunet.geometry.tracks import TrackedMotion, tracked_motion
from saunet.synthetic import SyntheticDrive


def degrees_between(first: np.ndarray, second: np.ndarray) -> float:
    chord = np.linalg.norm((first - second)[:3, :3])
    return float(np.degrees(2 * np.arcsin(chord / 8**0.5)))


def scaled(found: TrackedMotion, depth: np.ndarray) -> np.ndarray:
    """Give the motion the length that a depth map tells, at the points where it knows one."""
    column, row = found.points.round().astype(int).T
    known = depth[row, column] > 0
    points = np.r_[np.c_[found.points, found.depth][known], np.full((1, 3), np.nan)].astype(np.float32)
    T = torch.from_numpy(found.T_src_tgt).float()
    return scaled_motion(T[None, None], torch.from_numpy(points)[None, None], torch.from_numpy(depth)[None, None])[
        0, 0
    ].numpy()


@pytest.mark.parametrize("seed", [0, 5])
@pytest.mark.parametrize("step", [1, -1])
def test_like_the_renderer(seed: int, step: int) -> None:
    drive = SyntheticDrive(seed=seed, frames=6, height=160, width=512)
    for target in (2, 3):
        truth = np.linalg.inv(drive.pose(target + step)) @ drive.pose(target)
        depth, K = drive.depth(target), drive.intrinsics(target)
        found = tracked_motion(drive.image(target), drive.image(target + step), K)
        assert found is not None
        assert degrees_between(found.T_src_tgt, truth) < 0.1
        assert np.linalg.norm(found.T_src_tgt[:3, 3]) == pytest.approx(1)
        way, true_way = scaled(found, depth)[:3, 3], truth[:3, 3]
        assert np.linalg.norm(way) == pytest.approx(np.linalg.norm(true_way), rel=0.05)
        assert way @ true_way / np.linalg.norm(way) / np.linalg.norm(true_way) > np.cos(np.radians(2))
        u, v = found.points.round().astype(int).T
        known = depth[v, u] > 0
        ratio = (found.depth * np.linalg.norm(true_way))[known] / depth[v, u][known]
        assert np.median(np.abs(ratio - 1)) < 0.05


@pytest.mark.parametrize("turn", [-0.04, 0.03])
def test_a_turn_alone_is_no_way(turn: float) -> None:
    drive = SyntheticDrive(seed=1, frames=1, height=160, width=512)
    image, K = drive.image(0), drive.intrinsics(0)
    R = cv2.Rodrigues(np.array([0.0, turn, 0.0]))[0]
    turned = cv2.warpPerspective(image, K @ R @ np.linalg.inv(K), (512, 160), borderMode=cv2.BORDER_REFLECT)
    found = tracked_motion(image, turned, K)
    assert found is not None
    T = np.eye(4)
    T[:3, :3] = R
    assert degrees_between(found.T_src_tgt, T) < 0.1
    np.testing.assert_array_equal(found.T_src_tgt[:3, 3], 0)
    np.testing.assert_array_equal(scaled(found, drive.depth(0)), found.T_src_tgt.astype(np.float32))


def test_standing_still_and_nothing_to_follow() -> None:
    drive = SyntheticDrive(seed=1, frames=1, height=96, width=320)
    image, K = drive.image(0), drive.intrinsics(0)
    still = tracked_motion(image, image.copy(), K)
    assert still is not None
    np.testing.assert_array_equal(still.T_src_tgt, np.eye(4))
    assert tracked_motion(np.zeros_like(image), np.zeros_like(image), K) is None
    noise = np.random.default_rng(0).integers(0, 256, (2, 96, 320, 3), np.uint8)
    assert tracked_motion(noise[0], noise[1], K) is None


@pytest.mark.data
def test_like_the_poses_of_kitti(kitti_mini: Path) -> None:
    sequence = kitti_mini / "odometry" / "sequences" / "06"
    K = np.array((sequence / "calib.txt").read_text().splitlines()[0].split()[1:], float).reshape(3, 4)[:, :3]
    T = np.tile(np.eye(4), (51, 1, 1))
    T[:, :3] = np.loadtxt(kitti_mini / "odometry" / "poses" / "06.txt").reshape(-1, 3, 4)
    images = [cv2.imread(str(path)) for path in sorted((sequence / "image_0").iterdir())]
    K = scale_intrinsics(torch.from_numpy(K), 320 / images[0].shape[1], 96 / images[0].shape[0]).numpy()
    images = [cv2.resize(image, (320, 96), interpolation=cv2.INTER_AREA) for image in images]
    turns, ways, motions = [], [], []
    for frame in range(len(images) - 1):
        truth = np.linalg.inv(T[frame + 1]) @ T[frame]
        found = tracked_motion(images[frame], images[frame + 1], K)
        assert found is not None
        turns.append(degrees_between(found.T_src_tgt, truth))
        motions.append(degrees_between(truth, np.eye(4)))
        cosine = found.T_src_tgt[:3, 3] @ truth[:3, 3] / np.linalg.norm(truth[:3, 3])
        ways.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    print(f"rotation off by {np.mean(turns):.3f} of {np.mean(motions):.3f} degrees, direction by {np.median(ways):.2f}")
    assert np.mean(turns) < 0.08
    assert np.median(ways) < 1.5
