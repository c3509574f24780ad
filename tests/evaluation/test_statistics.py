"""Intervals that cover, and paired comparisons that see what is there and nothing else."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from saunet.errors import ConfigError, DataError
from saunet.evaluation.result import EvaluationResult, ImageRow
from saunet.evaluation.statistics import bootstrap_mean, compare, drive_of, spreads
from saunet.metrics.protocols import protocol


def rows(errors, predictor="m", drives=10, blank=()):
    return [
        ImageRow(
            predictor, "metric", f"drive{i % drives} {i:04d} l", 0 if i in blank else 9, 1.0, tuple(map(float, error))
        )
        for i, error in enumerate(errors)
    ]


def test_interval_matches_the_normal_approximation():
    values = np.random.default_rng(0).normal(size=(400, 2)) * [1.0, 3.0] + [5.0, -2.0]
    found = bootstrap_mean(values)
    spread = 1.96 * values.std(0) / np.sqrt(400)
    np.testing.assert_allclose(found.high - found.low, 2 * spread, rtol=0.1)
    np.testing.assert_allclose((found.high + found.low) / 2, values.mean(0), atol=0.1 * spread.max())


def test_interval_covers_the_truth_about_as_often_as_it_says():
    rng = np.random.default_rng(1)
    hits = 0
    for seed in range(100):
        found = bootstrap_mean(rng.normal(size=(40, 1)), resamples=300, level=0.9, seed=seed)
        hits += found.low[0] <= 0 <= found.high[0]
    assert 80 <= hits <= 98


def test_drives_make_the_interval_honest():
    """Ten drives of fifty alike frames say as much as ten images."""
    rng = np.random.default_rng(2)
    drive = np.repeat(rng.normal(size=10), 50)
    values = (drive + 0.01 * rng.normal(size=500))[:, None]
    groups = [f"d{i // 50}" for i in range(500)]
    narrow, honest = bootstrap_mean(values), bootstrap_mean(values, groups)
    assert (honest.high - honest.low) > 4 * (narrow.high - narrow.low)
    alone = bootstrap_mean(values[::50])
    np.testing.assert_allclose(honest.high - honest.low, alone.high - alone.low, rtol=0.2)


def test_same_seed_same_interval():
    values = np.random.default_rng(3).normal(size=(30, 3))
    one, two = bootstrap_mean(values, seed=4), bootstrap_mean(values, seed=4)
    np.testing.assert_array_equal(one.low, two.low)


def test_a_real_difference_is_found():
    rng = np.random.default_rng(5)
    base = rng.random((200, 7))
    better = base.copy()
    better[:, :4] -= 0.01 + 0.001 * rng.normal(size=(200, 4))
    better[:, 4:] += 0.01
    comparison = compare(rows(base), rows(better, "other"), names=("a", "b"))
    assert (comparison.protocol, comparison.first, comparison.second) == ("metric", "a", "b")
    assert (comparison.images, comparison.by, comparison.groups) == (200, "drive", 10)
    found = comparison.differences
    for row in found[:4]:
        assert row.high < 0
        assert row.better == 1.0
    for row in found[4:]:
        assert row.low > 0
        assert row.better == 1.0
    assert found[0].difference == pytest.approx((better - base)[:, 0].mean())
    assert found[0].p_value < 0.02
    assert (found[0].first, found[0].second) == pytest.approx((base[:, 0].mean(), better[:, 0].mean()))


def test_noise_is_not_a_difference():
    rng = np.random.default_rng(6)
    base = rng.random((200, 7))
    found = compare(rows(base, drives=2), rows(base + 0.01 * rng.normal(size=base.shape), drives=2)).differences
    assert sum(row.low <= 0 <= row.high for row in found) >= 6
    assert np.median([row.p_value for row in found]) > 0.05


def test_equal_results_tie():
    base = np.random.default_rng(7).random((20, 7))
    for row in compare(rows(base), rows(base)).differences:
        assert (row.difference, row.better, row.p_value) == (0.0, 0.5, 1.0)


def test_pairs_by_name_in_any_order_and_skips_images_without_truth():
    base = np.random.default_rng(8).random((20, 7))
    other = base + 0.5
    other[3] = math.nan
    found = compare(rows(base), rows(other, blank=(3,))[::-1]).differences
    assert found[0].difference == pytest.approx(0.5)
    assert found[0].first == pytest.approx(np.delete(base, 3, 0)[:, 0].mean())


def test_what_cannot_be_compared():
    base = np.ones((5, 7))
    with pytest.raises(DataError, match="5 and 4 rows do not pair up: 'drive4 0004 l' is only in one"):
        compare(rows(base), rows(base[:4]))
    with pytest.raises(DataError, match="a name occurs twice"):
        compare(rows(base) * 2, rows(base))
    with pytest.raises(DataError, match="0 rows"):
        compare(rows(base, blank=range(5)), rows(base))
    with pytest.raises(DataError, match="5 rows with 4 groups"):
        bootstrap_mean(base, ["a"] * 4)
    with pytest.raises(ConfigError, match="level is"):
        bootstrap_mean(base, level=1.5)


def test_rows_of_two_protocols_are_not_compared():
    base = rows(np.ones((5, 7)))
    with pytest.raises(DataError, match="protocols eigen_lidar_x, metric; compare under one"):
        compare(base, [dataclasses.replace(row, protocol="eigen_lidar_x") for row in base])


def test_spreads_resample_drives_where_there_are_enough_and_say_what_they_did():
    values = np.random.default_rng(9).random((60, 7))
    for drives, by, groups in ((6, "drive", 6), (2, "image", 60)):
        result = EvaluationResult((protocol("metric"),), ("m",), tuple(rows(values, drives=drives)))
        (found,) = spreads(result, resamples=500)
        assert (found.by, found.groups, found.predictor, found.protocol) == (by, groups, "m", "metric")
        mean = values.mean(0)
        assert all(low < value < high for low, value, high in zip(found.low, mean, found.high, strict=True))


def test_no_spread_where_no_image_has_truth():
    blank = tuple(rows(np.full((3, 7), math.nan), blank=range(3)))
    assert spreads(EvaluationResult((protocol("metric"),), ("m",), blank)) == ()


def test_drive_of():
    assert drive_of("synthetic 7 0000000005") == "synthetic 7"
    assert drive_of("2011_09_26/2011_09_26_drive_0001_sync 0000000005 l") == "2011_09_26/2011_09_26_drive_0001_sync"
