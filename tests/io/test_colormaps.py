"""Numbers as pictures and as KITTI's 16-bit PNG."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from saunet.errors import ConfigError
from saunet.io.colormaps import COLORMAPS, colorize, depth_to_png16, value_range


@pytest.mark.parametrize("colormap", COLORMAPS)
def test_near_is_bright_in_every_colormap_but_turbo(colormap: str) -> None:
    painted = colorize(np.linspace(0, 1, 50, dtype=np.float32)[None], (0.0, 1.0), colormap)
    assert painted.shape == (1, 50, 3)
    if colormap != "turbo":
        assert (np.diff(painted.sum(axis=2)[0].astype(int)[::7]) > 0).all()
    assert len(np.unique(painted[0], axis=0)) > 40


def test_outliers_do_not_stretch_the_range() -> None:
    values = np.linspace(1, 2, 1000, dtype=np.float32).reshape(20, 50)
    values[0, 0] = 1e6
    low, high = value_range(values)
    assert low == pytest.approx(1.005, abs=0.01)
    assert high < 2


def test_fixed_limits_give_the_same_color_to_the_same_value() -> None:
    near = colorize(np.array([[0.5, 0.9]], np.float32), (0.0, 1.0))
    far = colorize(np.array([[0.5, 0.1]], np.float32), (0.0, 1.0))
    assert np.array_equal(near[0, 0], far[0, 0])


def test_constant_nan_and_masked_maps() -> None:
    assert colorize(np.full((2, 2), 3.0, np.float32)).shape == (2, 2, 3)
    assert value_range(np.array([np.nan, np.inf])) == (0.0, 1.0)
    values = np.array([[np.nan, np.inf, 0.9, 0.9]], np.float32)
    painted = colorize(values, (0.0, 1.0), mask=np.array([[True, True, True, False]]))
    assert painted.sum(axis=2)[0].astype(bool).tolist() == [False, False, True, False]


def test_bad_limits_and_colormap() -> None:
    values = np.ones((2, 2), np.float32)
    with pytest.raises(ConfigError, match=r"limits are 1\.0 to 1\.0"):
        colorize(values, (1.0, 1.0))
    with pytest.raises(ConfigError, match="did you mean 'magma'"):
        colorize(values, colormap="magna")


def test_png16_of_known_depths() -> None:
    depth = np.array([[0.0, -1.0, np.nan, np.inf, 1e-4, 1.0, 80.0, 255.996, 1000.0]], np.float32)
    assert depth_to_png16(depth)[0].tolist() == [0, 0, 0, 0, 1, 256, 20480, 65535, 65535]


@given(st.floats(0.015625, 255.5, width=32))
def test_png16_round_trip_is_within_half_a_step(meters: float) -> None:
    depth = np.full((1, 1), meters, np.float32)
    assert abs(float(depth_to_png16(depth)[0, 0] / 256) - meters) <= 0.5 / 256 + 1e-5
