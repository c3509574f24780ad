"""Grids of named pictures."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from saunet.errors import ConfigError
from saunet.prediction.panel import depth_panel, fit, label, label_height, panel


def test_grid_places_each_picture_under_its_name(picture: NDArray[np.uint8]) -> None:
    tiles = {name: np.full((20, 60, 3), level, np.uint8) for name, level in (("one", 50), ("two", 100), ("three", 200))}
    grid = panel(tiles, columns=2, tile_width=60, gap=2)
    strip = label_height(60)
    assert grid.shape == (2 * (20 + strip) + 6, 2 * 60 + 6, 3)
    assert (grid[2 + strip : 22 + strip, 2:62] == 50).all()
    assert (grid[2 + strip : 22 + strip, 64:124] == 100).all()
    assert (grid[4 + 20 + 2 * strip : 4 + 40 + 2 * strip, 2:62] == 200).all()
    assert grid[2 : 2 + strip, 2:62].max() > 150, "a name is drawn"
    assert grid[4 + 20 + strip :, 64:].max() < 50, "the last cell is empty"


def test_more_columns_than_pictures(picture: NDArray[np.uint8]) -> None:
    assert panel({"x": picture}, columns=5, tile_width=90, gap=0).shape == (40 + label_height(90), 90, 3)


def test_long_names_fit_and_tiny_tiles_work() -> None:
    for width in (1, 20, 640):
        strip = label("a very long name that does not fit into a narrow strip at all", width)
        assert strip.shape == (label_height(width), width, 3)
        if width == 640:
            assert strip.max() > 200
    assert panel({"x": np.zeros((1, 1, 3), np.uint8)}, tile_width=1).ndim == 3


def test_enlarging_much_keeps_pixels_sharp() -> None:
    small = np.zeros((2, 2, 3), np.uint8)
    small[0, 0] = 255
    assert set(np.unique(fit(small, 20, 20))) == {0, 255}


def test_depth_panel_without_and_with_truth(picture: NDArray[np.uint8]) -> None:
    y = np.linspace(0.02, 0.5, 40, dtype=np.float32)[:, None]
    disparity = np.repeat(y, 90, axis=1)
    plain = depth_panel(picture, disparity, tile_width=90)
    assert plain.shape[0] == 2 * (40 + label_height(90)) + 3 * 4
    truth = 3 / disparity  # right up to scale: no error
    full = depth_panel(picture, disparity, truth, tile_width=90, columns=2)
    assert full.shape == (2 * (40 + label_height(90)) + 12, 2 * 90 + 12, 3)
    strip = label_height(90)
    error = full[8 + 40 + 2 * strip : 8 + 80 + 2 * strip, 98:188]
    shown = full[4 + strip : 44 + strip, 98:188].astype(int)
    expected = full[8 + 40 + 2 * strip : 8 + 80 + 2 * strip, 4:94].astype(int)
    assert error.max() < 8, "error of a right prediction is painted dark"
    assert np.abs(shown - expected).max() <= 2, "prediction and truth have the same colors"


def test_depth_panel_at_other_sizes_and_with_sparse_truth(picture: NDArray[np.uint8]) -> None:
    disparity = np.full((16, 32), 0.1, np.float32)
    truth = np.zeros((80, 180), np.float32)
    truth[40::8, ::8] = 12.0
    tiles = depth_panel(picture, disparity, truth, tile_width=90)
    assert tiles.shape[1] == 98
    assert depth_panel(picture, disparity, np.zeros((80, 180), np.float32), tile_width=90).shape[0] < tiles.shape[0]


def test_nothing_to_show() -> None:
    with pytest.raises(ConfigError, match="at least one picture"):
        panel({})
    with pytest.raises(ConfigError, match="columns is 0"):
        panel({"x": np.zeros((2, 2, 3), np.uint8)}, columns=0)
