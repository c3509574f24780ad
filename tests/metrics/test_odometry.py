"""Odometry errors against an established implementation and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from saunet.errors import DataError
from saunet.geometry.pose import pose_matrix
from saunet.metrics import odometry as O


def drive(n=60, step=2.0, turn=0.02, seed=0):
    """A winding camera-to-world path."""
    rng = np.random.default_rng(seed)
    poses = [np.eye(4)]
    for _ in range(n - 1):
        motion = np.eye(4)
        motion[:3, :3] = Rotation.from_rotvec([0.0, turn * (1 + rng.normal()), 0.002 * rng.normal()]).as_matrix()
        motion[:3, 3] = [0.02 * rng.normal(), 0.01 * rng.normal(), step]
        poses.append(poses[-1] @ motion)
    return np.stack(poses)


def moved(poses, scale=1.0, rotvec=(0.3, -0.8, 0.2), shift=(5.0, -3.0, 40.0)):
    return O.Similarity(scale, Rotation.from_rotvec(rotvec).as_matrix(), np.array(shift)).poses(poses)


def test_reference_snippets(reference):
    data = reference("odometry")
    errors = O.snippet_ate(data["predicted_relative"], O.relative_motions(data["gt_camera_to_world"]))
    np.testing.assert_allclose(errors, data["ate_per_snippet"], atol=1e-9)
    assert errors.mean() == pytest.approx(float(data["ate_mean"]), abs=1e-9)
    assert errors.std() == pytest.approx(float(data["ate_std"]), abs=1e-9)
    full = errors[data["snippet_points"] == 5]
    assert full.mean() == pytest.approx(float(data["ate_mean_full_snippets_only"]), abs=1e-9)


def test_reference_from_network_outputs(reference):
    data = reference("odometry")
    motions = pose_matrix(*(torch.from_numpy(data[k]) for k in ("predicted_axisangle", "predicted_translation")))
    errors = O.snippet_ate(motions.numpy(), O.relative_motions(data["gt_camera_to_world"]))
    np.testing.assert_allclose(errors, data["ate_per_snippet"], atol=1e-6)


def test_relative_motions_and_chain_are_inverse():
    poses = drive()
    motions = O.relative_motions(poses)
    point = np.array([1.0, 2.0, 8.0, 1.0])
    in_world = poses[3] @ point
    np.testing.assert_allclose(motions[3] @ point, np.linalg.inv(poses[4]) @ in_world, atol=1e-9)
    np.testing.assert_allclose(O.chain_motions(motions), poses, atol=1e-9)


def test_scaled_truth_has_no_snippet_error():
    true = O.relative_motions(drive())
    predicted = true.copy()
    predicted[:, :3, 3] *= 0.37
    assert O.snippet_ate(predicted, true).max() < 1e-12


def test_no_predicted_motion_is_finite():
    true = O.relative_motions(drive(n=8))
    found = O.snippet_ate(np.tile(np.eye(4), (7, 1, 1)), true)
    assert np.isfinite(found).all()
    assert found[-1] == pytest.approx(np.linalg.norm(true[-1, :3, 3]) / 2)


@pytest.mark.parametrize("scale", [0.05, 1.0, 7.0])
def test_umeyama_recovers_a_similarity(scale):
    target = np.random.default_rng(1).normal(size=(20, 3)) * 10
    rotation = Rotation.from_rotvec([0.5, -1.2, 2.0]).as_matrix()
    source = (target - np.array([1.0, 2.0, 3.0])) @ rotation / scale
    found = O.umeyama(source, target)
    assert found.scale == pytest.approx(scale)
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-12)
    np.testing.assert_allclose(found.positions(source), target, atol=1e-9)


def test_umeyama_never_reflects():
    source = np.random.default_rng(2).normal(size=(30, 3))
    found = O.umeyama(source, source * np.array([1.0, 1.0, -1.0]))
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)


def test_umeyama_is_the_least_squares_optimum():
    rng = np.random.default_rng(3)
    source = rng.normal(size=(15, 3))
    target = rng.normal(size=(15, 3))
    best = O.umeyama(source, target)
    error = ((best.positions(source) - target) ** 2).sum()
    for _ in range(200):
        nudge = Rotation.from_rotvec(rng.normal(size=3) * 0.01).as_matrix()
        other = O.Similarity(
            best.scale * (1 + 0.01 * rng.normal()), nudge @ best.rotation, best.translation + 0.01 * rng.normal(size=3)
        )
        assert ((other.positions(source) - target) ** 2).sum() >= error


def test_the_alignment_removes_a_similarity():
    true = drive()
    assert O.trajectory_ate(moved(true, 0.2), true) < 1e-9


def test_ate_of_constant_sideways_noise():
    true = np.tile(np.eye(4), (100, 1, 1))
    true[:, 2, 3] = np.arange(100.0)
    predicted = true.copy()
    predicted[:, 0, 3] = np.where(np.arange(100) % 2, 0.1, -0.1)
    assert O.trajectory_ate(predicted, true) == pytest.approx(0.1, rel=1e-3)


def test_segment_errors_of_a_scaled_straight_path():
    true = np.tile(np.eye(4), (201, 1, 1))
    true[:, 2, 3] = np.arange(201.0)
    predicted = true.copy()
    predicted[:, 2, 3] *= 1.02
    found = O.segment_errors(predicted, true, lengths=(100.0,))
    # The segment ends at the first frame beyond 100 m, here 101 m, and the error is divided by 100, as in KITTI's tool.
    assert found.t_rel == pytest.approx(2.02)
    assert found.r_rel == pytest.approx(0.0, abs=1e-5)
    assert found.segments == 10


def test_segment_errors_of_a_turning_path():
    true = np.tile(np.eye(4), (301, 1, 1))
    true[:, 2, 3] = np.arange(301.0)
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_euler("y", 0.01, degrees=True).as_matrix()
    motion[2, 3] = 1.0
    predicted = np.stack([np.linalg.matrix_power(motion, k) for k in range(301)])
    found = O.segment_errors(predicted, true, lengths=(100.0, 200.0))
    per_meter = np.mean([1.01] * 20 + [2.01 / 2] * 10)
    assert found.segments == 30
    assert found.r_rel == pytest.approx(per_meter, rel=1e-6)


def test_segments_do_not_depend_on_the_world_frame():
    true = drive(120)
    predicted = drive(120, seed=9)
    here = O.segment_errors(predicted, true)
    there = O.segment_errors(moved(predicted), true)
    assert here.segments > 0
    assert (here.t_rel, here.r_rel) == pytest.approx((there.t_rel, there.r_rel))


def test_no_segment_fits():
    found = O.segment_errors(drive(10), drive(10))
    assert found.segments == 0
    assert np.isnan(found.t_rel)


def test_perfect_prediction_up_to_similarity_is_perfect():
    true = drive(150)
    predicted = moved(true, 0.1)
    found = O.segment_errors(O.umeyama(predicted[:, :3, 3], true[:, :3, 3]).poses(predicted), true)
    assert found.t_rel < 1e-8
    assert found.r_rel < 1e-4


def test_bad_input():
    with pytest.raises(DataError, match="9 predicted and 10 true positions"):
        O.trajectory_ate(drive(9), drive(10))
    with pytest.raises(DataError, match="0 predicted and 0 true motions; give equally many, at least 1"):
        O.snippet_ate(np.zeros((0, 4, 4)), np.zeros((0, 4, 4)))
