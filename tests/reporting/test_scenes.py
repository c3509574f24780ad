"""Curves, and the choice of what is enlarged."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from saunet.errors import ConfigError, DataError
from saunet.reporting import ReportOptions
from saunet.reporting.figures import curve, plot_curves
from saunet.reporting.scenes import View, edge_boxes, read_views, scene
from saunet.runs.run import Run
from saunet.tables.drawing import new_figure


def test_training_lies_within_epochs_and_validation_at_their_ends() -> None:
    history = [{"epoch": step // 4.0, "step": float(step), "train/loss": float(step)} for step in range(8)]
    history += [{"epoch": epoch, "step": 4 * epoch + 3, "val/a1": 0.5} for epoch in (0.0, 1.0)]
    assert curve(history, "train/loss") == ([(step + 1) / 4 for step in range(8)], [float(step) for step in range(8)])
    assert curve(history, "val/a1") == ([1, 2], [0.5, 0.5])
    assert curve(history, "val/none") == ([], [])


def test_a_validation_within_an_epoch_lies_where_it_was_made() -> None:
    history = [{"epoch": 0.0, "step": 3.0, "val/a1": 0.4}, {"epoch": 1.0, "step": 5.0, "val/a1": 0.5}]
    assert curve(history, "val/a1") == ([1, 1.5], [0.4, 0.5])
    assert curve(history, "val/a1", by_step=True) == ([4, 6], [0.4, 0.5])


@pytest.mark.parametrize(("epochs", "label", "places"), [(1, "step", [1, 2, 3]), (2, "epoch", [1 / 3, 2 / 3, 1])])
def test_a_first_epoch_is_drawn_by_steps_and_few_points_have_marks(epochs: int, label: str, places: Any) -> None:
    pytest.importorskip("matplotlib")
    rows = [{"epoch": step // 3.0, "step": float(step), "train/loss": 1.0} for step in range(3 * epochs)]
    _, (axis,) = new_figure(1, 5.0, 3.0)
    plot_curves([axis], {"a": Run(Path("a"), history=rows)}, [("train/loss", "loss")])
    (line,) = axis.lines
    assert (axis.get_xlabel(), line.get_marker()) == (label, "o")
    np.testing.assert_allclose(line.get_xdata()[:3], places)


def test_a_long_curve_is_thinned_by_means() -> None:
    history = [{"epoch": 0.0, "step": float(step), "train/loss": step % 2.0} for step in range(1000)]
    x, y = curve(history, "train/loss", points=100)
    assert len(x) == 100
    assert set(y) == {0.5}


def test_boxes_lie_on_depth_edges_within_the_image_and_apart() -> None:
    disparity = np.full((60, 240), 0.1, np.float32)
    disparity[20:40, 60:80] = 1.0
    disparity[30:50, 180:200] = 0.5
    first, second = edge_boxes([disparity], np.zeros((60, 240, 3), np.uint8), 2)
    for box, middle in ((first, 70), (second, 190)):
        assert box.left < middle < box.left + box.width
        assert 0 <= box.left <= 240 - box.width
        assert 0 <= box.top <= 60 - box.height


def test_a_scene_without_any_edge_has_no_boxes() -> None:
    assert edge_boxes([np.ones((50, 90), np.float32)], np.zeros((50, 90, 3), np.uint8), 2) == []


@pytest.mark.parametrize("size", [(4, 5), (9, 300), (300, 9)])
def test_odd_sizes_do_no_harm(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    view = View(Path("x.png"), rng.integers(0, 255, (*size, 3), dtype=np.uint8), "x", "kitti")
    made = scene(view, {"a": rng.random(size, dtype=np.float32) + 0.1}, "s", 3)
    assert [tile.label for tile in made.tiles] == ["input", "a"]
    for tile in made.tiles:
        for picture in (tile.picture, *tile.zooms):
            assert cv2.imdecode(np.frombuffer(picture.data, np.uint8), cv2.IMREAD_COLOR) is not None


def test_large_pictures_are_shrunk_for_the_page() -> None:
    view = View(Path("x.png"), np.zeros((375, 1242, 3), np.uint8), "x", "kitti")
    picture = scene(view, {}, "s", 0).tiles[0].picture
    shape = cv2.imdecode(np.frombuffer(picture.data, np.uint8), cv2.IMREAD_COLOR).shape
    assert shape == (266, 880, 3)


def test_a_folder_gives_images_spread_over_it(tmp_path: Path) -> None:
    for index in range(10):
        cv2.imwrite(str(tmp_path / f"{index}.png"), np.zeros((8, 8, 3), np.uint8))
    names = [view.path.stem for view in read_views({"kitti": str(tmp_path)}, 3)]
    assert len(set(names)) == 3
    assert names == sorted(names)
    both = read_views({"a": str(tmp_path / "1.png"), "b": [str(tmp_path / "2.png"), str(tmp_path / "3.png")]}, 5)
    assert [(view.condition, view.path.stem) for view in both] == [("a", "1"), ("b", "2"), ("b", "3")]


def test_scenes_that_cannot_be_shown_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"scenes\.a is empty"):
        read_views({"a": []}, 3)
    with pytest.raises(ConfigError, match="scenes_limit is 0"):
        ReportOptions(scenes_limit=0)
    with pytest.raises(DataError, match="no file or folder"):
        read_views({"a": str(tmp_path / "gone")}, 3)
