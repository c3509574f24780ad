"""Depth edges and point clouds: cases by hand, and searches without trees or transforms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from saunet.metrics.shapes import FARTHEST_EDGE, boundaries, boundary_scores, cloud_scores, points

ALL = np.ones((40, 60), dtype=bool)


def step(column: int, near: float = 10.0, far: float = 30.0) -> np.ndarray:
    depth = np.full((40, 60), far)
    depth[:, :column] = near
    return depth


def test_edges_lie_at_steps_and_are_one_pixel_wide() -> None:
    found = boundaries(step(25))
    assert (found[2:-2].sum(1) == 1).all()
    assert set(found[2:-2].nonzero()[1]) <= {24, 25}
    assert not boundaries(step(25, 10.0, 10.2)).any()
    wall = np.linspace(10, 12, 60)[None].repeat(40, 0)
    assert not boundaries(wall).any()


@pytest.mark.parametrize("shift", [0, 1, 3, 7])
def test_a_shifted_edge_is_off_by_that_many_pixels(shift: int) -> None:
    assert boundary_scores(step(25 + shift), step(25), ALL) == pytest.approx((shift, shift))


def test_a_missing_edge_costs_completeness_and_a_false_one_accuracy() -> None:
    both = step(20)
    both[:, 40:] = 90.0
    accuracy, completeness = boundary_scores(step(20), both, ALL)
    assert accuracy == 0
    assert completeness == pytest.approx(10)  # half of the true edges are 20 columns from the nearest predicted one
    assert boundary_scores(both, step(20), ALL) == (0, 0)  # a false edge 20 columns away is too far to count
    both[:, 26:40] = 90.0
    assert boundary_scores(both, step(20), ALL)[0] == pytest.approx(3, abs=0.05)  # half are 6 columns away


def test_no_edge_near_a_true_one_is_the_worst() -> None:
    assert boundary_scores(step(0), step(25), ALL) == (FARTHEST_EDGE, FARTHEST_EDGE)
    assert boundary_scores(step(40), step(25), ALL) == (FARTHEST_EDGE, FARTHEST_EDGE)


def test_nothing_to_compare_is_nan() -> None:
    sparse = np.where(np.arange(40)[:, None] % 4 == 0, step(25), 0.0)
    for truth in (step(0), sparse, np.zeros((40, 60))):
        assert all(map(math.isnan, boundary_scores(step(25), truth, truth > 0)))
    crop = ALL.copy()
    crop[:, 20:30] = False
    assert all(map(math.isnan, boundary_scores(step(25), step(25), crop)))


def test_unknown_pixels_make_no_edges() -> None:
    truth = step(25)
    truth[10:20, 40:50] = 0
    assert boundary_scores(step(27), truth, ALL) == pytest.approx((2, 2))


def test_distances_are_those_of_a_plain_search() -> None:
    random = np.random.default_rng(2)
    blocks = [np.kron(random.uniform(5, 50, (4, 6)), np.ones((10, 10))) for _ in range(2)]
    true, found = (np.argwhere(boundaries(each)) for each in blocks)
    apart = np.linalg.norm(true[:, None] - found[None], axis=-1)
    near = apart.min(0)[apart.min(0) < FARTHEST_EDGE]
    assert boundary_scores(blocks[1], blocks[0], ALL) == pytest.approx((near.mean(), apart.min(1).mean()))


def test_points_are_where_the_camera_sees_them() -> None:
    K = np.array([[50.0, 0.0, 29.5], [0.0, 40.0, 19.5], [0.0, 0.0, 1.0]])
    mask = np.zeros((40, 60), dtype=bool)
    mask[3, 10] = mask[30, 2] = True
    expected = [[(10 - 29.5) / 50 * 8, (3 - 19.5) / 40 * 8, 8], [(2 - 29.5) / 50 * 2, (30 - 19.5) / 40 * 2, 2]]
    np.testing.assert_allclose(points(np.array([8.0, 2.0]), mask, K), expected)


def test_cloud_by_hand() -> None:
    true = np.array([[0.0, 0, 5], [1, 0, 5], [2, 0, 5], [3, 0, 5]])
    predicted = np.array([[0.0, 0.05, 5], [1, 0, 5.2]])
    precision, recall, f_score = cloud_scores(predicted, true, 0.1)
    assert (precision, recall) == (0.5, 0.25)
    assert f_score == pytest.approx(2 * 0.5 * 0.25 / 0.75)
    assert cloud_scores(predicted, true, 0.01) == (0, 0, 0)
    assert cloud_scores(true, true, 0.01) == (1, 1, 1)
    assert all(map(math.isnan, cloud_scores(predicted[:0], true, 0.1)))


def test_cloud_against_all_distances() -> None:
    random = np.random.default_rng(1)
    predicted, true = random.uniform(0, 3, (300, 3)), random.uniform(0, 3, (200, 3))
    apart = np.linalg.norm(predicted[:, None] - true[None], axis=-1)
    precision, recall = (apart.min(1) < 0.2).mean(), (apart.min(0) < 0.2).mean()
    expected = (precision, recall, 2 / (1 / precision + 1 / recall))
    assert cloud_scores(predicted, true, 0.2) == pytest.approx(expected)
