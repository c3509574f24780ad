"""Intervals that cover, and paired comparisons that see what is there and nothing else."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from saunet.errors import DataError
from saunet.evaluation.files import read_rows, write_results
from saunet.evaluation.result import EvaluationResult
from saunet.evaluation.rows import ImageRow, ViewRow
from saunet.evaluation.statistics import bootstrap_mean, compare, spreads, with_statistics
from saunet.metrics.protocols import protocol


def rows(errors, predictor="m", drives=10, blank=()):
    return [
        ImageRow(
            predictor, "metric", f"drive{i % drives} {i:04d} l", 0 if i in blank else 9, 1.0, tuple(map(float, error))
        )
        for i, error in enumerate(errors)
    ]


def each(values):
    """Every row as a group of its own."""
    return [str(i) for i in range(len(values))]


def test_interval_matches_the_normal_approximation():
    values = np.random.default_rng(0).normal(size=(400, 2)) * [1.0, 3.0] + [5.0, -2.0]
    low, high = bootstrap_mean(values, each(values))
    spread = 1.96 * values.std(0) / np.sqrt(400)
    np.testing.assert_allclose(high - low, 2 * spread, rtol=0.1)
    np.testing.assert_allclose((high + low) / 2, values.mean(0), atol=0.1 * spread.max())


@pytest.mark.parametrize("drives", [5, 6, 7, 8, 10, 28])
def test_intervals_over_few_drives_cover_the_truth_as_often_as_they_say(drives):
    """Plain percentiles cover .82 to .91 at 5 to 10 drives, and SciPy's BCa no more."""
    values = np.random.default_rng(drives).normal(size=(drives, 4000))  # as many columns, each a trial
    low, high = bootstrap_mean(values, each(values), resamples=1000)
    assert 0.93 <= ((low <= 0) & (high >= 0)).mean() <= 0.97


def test_intervals_cover_means_over_drives_of_unequal_length():
    rng = np.random.default_rng(1)
    lengths = [5, 40, 20, 60, 30, 10, 25, 50]
    drives = np.repeat(rng.normal(size=(8, 2000)), lengths, axis=0)
    groups = [name for name, length in zip("abcdefgh", lengths, strict=True) for _ in range(length)]
    low, high = bootstrap_mean(drives + 0.1 * rng.normal(size=drives.shape), groups, resamples=500)
    assert 0.89 <= ((low <= 0) & (high >= 0)).mean() <= 0.98


def test_intervals_of_data_without_spread():
    for value in (0.3, 0.25):  # BCa gives NaN for one and a wide interval for the other
        low, high = bootstrap_mean(np.full((6, 1), value), list("abcdef"))
        assert low[0] == high[0] == value
    assert np.isnan(bootstrap_mean(np.ones((3, 2)), ["a"] * 3)).all()  # one drive says nothing of the others


def test_drives_make_the_interval_honest():
    """Ten drives of fifty alike frames say as much as ten images."""
    rng = np.random.default_rng(2)
    drive = np.repeat(rng.normal(size=10), 50)
    values = (drive + 0.01 * rng.normal(size=500))[:, None]
    groups = [f"d{i // 50}" for i in range(500)]
    narrow, honest, alone = (
        np.subtract(*bootstrap_mean(v, g)[::-1])
        for v, g in ((values, each(values)), (values, groups), (values[::50], each(values[::50])))
    )
    assert honest > 4 * narrow
    np.testing.assert_allclose(honest, alone, rtol=0.2)


def test_same_seed_same_interval():
    values = np.random.default_rng(3).normal(size=(30, 3))
    one, two = (bootstrap_mean(values, each(values), seed=4) for _ in range(2))
    np.testing.assert_array_equal(one, two)


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
    found = compare(rows(base), rows(base + 0.01 * rng.normal(size=base.shape))).differences
    assert sum(row.low <= 0 <= row.high for row in found) >= 6
    assert np.median([row.p_value for row in found]) > 0.05


def test_p_values_are_those_of_all_exchanges_of_labels():
    """Five drives have 32 exchanges; the largest possible effect cannot be rarer than two of them."""
    base = np.random.default_rng(4).random((50, 7))
    shift = np.array([0.1, 0.2, 0.3, 0.4, 0.5])[np.arange(50) % 5, None]
    for change, expected in ((shift, 2 / 32), (np.where(shift < 0.15, -shift, shift), 4 / 32)):
        for row in compare(rows(base, drives=5), rows(base + change, drives=5)).differences:
            assert row.p_value == pytest.approx(expected)


def test_few_drives_get_no_p_value():
    """Alike frames of two drives would make any difference look like proof."""
    base = np.random.default_rng(6).random((200, 7))
    comparison = compare(rows(base, drives=4), rows(base + 0.01, drives=4))
    assert [row.p_value for row in comparison.differences] == [None] * 7
    assert comparison.table().rows[0].cells[-1] is None
    assert "too narrow" in comparison.table().notes[-1]


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
    with pytest.raises(DataError, match="5 and 4 rows cannot be paired: 'drive4 0004 l' is only in one"):
        compare(rows(base), rows(base[:4]))
    with pytest.raises(DataError, match="a name occurs twice"):
        compare(rows(base) * 2, rows(base))
    with pytest.raises(DataError, match="0 rows"):
        compare(rows(base, blank=range(5)), rows(base))
    with pytest.raises(DataError, match="5 rows with 4 groups"):
        bootstrap_mean(base, ["a"] * 4)


def test_rows_of_two_protocols_are_not_compared():
    base = rows(np.ones((5, 7)))
    with pytest.raises(DataError, match="protocols eigen_lidar_x, metric; compare under one"):
        compare(base, [dataclasses.replace(row, protocol="eigen_lidar_x") for row in base])


def test_spreads_resample_drives_where_there_are_enough_and_say_what_they_did():
    values = np.random.default_rng(9).random((60, 7))
    for drives, by, groups in ((6, "drive", 6), (2, "image", 60)):
        result = EvaluationResult((protocol("metric"),), ("m",), tuple(rows(values, drives=drives)))
        (found,) = spreads(result)
        assert (found.by, found.groups, found.predictor, found.protocol) == (by, groups, "m", "metric")
        mean = values.mean(0)
        assert all(low < value < high for low, value, high in zip(found.low, mean, found.high, strict=True))


def test_no_spread_where_no_image_has_truth():
    blank = tuple(rows(np.full((3, 7), math.nan), blank=range(3)))
    assert spreads(EvaluationResult((protocol("metric"),), ("m",), blank)) == ()


def test_an_earlier_evaluation_without_ground_truth_is_compared_too(tmp_path):
    def explained(shift):
        views = [ViewRow("model", "campus", f"a {i:06d}", "a", 0.1 + shift + 0.01 * i, 0.3, 0.7, 0.9) for i in range(6)]
        return EvaluationResult((protocol("campus"),), ("model",), (), views=tuple(views))

    write_results(explained(0.0), tmp_path)
    earlier = read_rows(tmp_path)
    assert earlier == explained(0.0).views
    (comparison,) = with_statistics(explained(0.02), None, earlier, "before").comparisons
    assert [(row.name, row.better) for row in comparison.differences] == [("warped", 0.0), ("explained", 0.5)]
    assert comparison.differences[0].difference == pytest.approx(0.02)
    write_results(dataclasses.replace(explained(0.0), views=()), tmp_path)
    assert read_rows(tmp_path) == ()  # of the later evaluation in this folder
