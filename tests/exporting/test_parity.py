"""Exported files are compared with the network they come from, in numbers that nothing slips past."""

from __future__ import annotations

import math

import numpy as np
import pytest

from saunet.exporting.parity import Run, compare, timed

IMAGES = [np.full((1, 3, 4, 6), value, np.float32) for value in (0.2, 0.8)]


def disparity(images: np.ndarray) -> np.ndarray:
    return 0.5 + images[:, :1]


def test_the_largest_difference_of_all_images_counts() -> None:
    found = compare("file", disparity, lambda images: disparity(images) + 0.1 * (images[:, :1] > 0.5), IMAGES, (), 10.0)
    assert found.difference == pytest.approx(0.01)
    assert found.depth_difference == pytest.approx(0.1 / 1.4)
    assert (found.random, found.real) == (2, 0)


def test_every_file_is_timed_against_one_and_the_same_original() -> None:
    calls: list[str] = []

    def named(name: str) -> Run:
        return lambda images: calls.append(name) or disparity(images)

    reports = [compare(name, disparity, disparity, IMAGES, (), 10.0) for name in "ab"]
    found = timed(reports, named("eager"), [named("a"), named("b")], IMAGES[0], repeats=3)
    assert calls == ["eager", "a", "b"] * 5  # two rounds to warm up
    assert [report.file for report in found] == ["a", "b"]
    assert found[0].eager_ms == found[1].eager_ms
    assert [report.difference for report in found] == [0, 0]


@pytest.mark.parametrize("place", [0, 1])
def test_what_is_not_a_number_is_no_agreement(place: int) -> None:
    def broken(images: np.ndarray) -> np.ndarray:
        return np.where(images[:, :1] == IMAGES[place][0, 0, 0, 0], np.nan, disparity(images))

    assert math.isnan(compare("file", disparity, broken, IMAGES, (), 10.0).difference)
