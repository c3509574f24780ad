"""Errors of a path in one line, its files and its picture; whole-path numbers against the evo package."""

from __future__ import annotations

import csv
import io
import json
import math

import cv2
import numpy as np
import pytest
from drives import NumberDrive
from rich.console import Console
from scipy.spatial.transform import Rotation

from saunet.errors import ConfigError
from saunet.evaluation import paths
from saunet.evaluation.paths import (
    STRAIGHT,
    OdometryOptions,
    Path3d,
    draw_path,
    path_errors,
    path_of,
    path_table,
    straight_ahead,
    write_errors,
    write_path,
)
from saunet.io.trajectories import read_kitti
from saunet.registry import Spec


def winding(frames=120, step=2.0):
    """A path that needs no random numbers, so that other programs can be given the same."""
    poses = [np.eye(4)]
    for i in range(frames - 1):
        motion = np.eye(4)
        motion[:3, :3] = Rotation.from_euler("yx", [0.03 * math.sin(0.1 * i), 0.004 * math.cos(0.3 * i)]).as_matrix()
        motion[:3, 3] = [0.0, 0.0, step]
        poses.append(poses[-1] @ motion)
    return np.stack(poses)


def predicted(frames=120):
    """Another scale and world, and a little wrong everywhere."""
    poses = [np.eye(4)]
    for i in range(frames - 1):
        motion = np.eye(4)
        motion[:3, :3] = Rotation.from_euler("yx", [0.032 * math.sin(0.1 * i + 0.1), 0.0]).as_matrix()
        motion[:3, 3] = [0.0, 0.001, 0.05 * (1 + 0.2 * math.sin(0.05 * i))]
        poses.append(poses[-1] @ motion)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0.2, -0.5, 0.1]).as_matrix()
    return turn @ np.stack(poses)


def a_path(frames=120):
    return Path3d("odometry/99 l", predicted(frames), np.arange(frames) * 0.1, winding(frames))


def test_whole_path_numbers_are_those_of_evo():
    """``align(correct_scale=True)`` and the APE of translations of evo 1.38.1 on the same two paths."""
    errors = path_errors(a_path())
    assert errors.ate == pytest.approx(5.328228703138327, rel=1e-9)
    assert errors.scale == pytest.approx(39.336091266249255, rel=1e-9)


def test_a_scaled_and_moved_truth_has_no_error():
    true = winding()
    turn = np.eye(4)
    turn[:3, :3], turn[:3, 3] = Rotation.from_rotvec([0.3, 0.2, -1.0]).as_matrix(), [3.0, -2.0, 9.0]
    other = turn @ true
    other[:, :3, 3] *= 0.03
    errors = path_errors(Path3d("x", other, np.arange(120.0), true))
    assert errors.scale == pytest.approx(1 / 0.03)
    assert max(errors.snippet_ate, errors.ate, errors.t_rel) < 1e-9
    assert errors.r_rel < 1e-4
    assert (errors.frames, errors.meters, errors.snippet) == (120, pytest.approx(238.0), 5)
    assert errors.lengths == (100, 200, 300, 400, 500, 600, 700, 800)


def test_a_short_path_gets_shorter_segments_and_says_so():
    errors = path_errors(a_path(31))
    assert errors.meters == pytest.approx(60.0)
    assert errors.lengths == (12.0, 24.0, 36.0, 48.0)
    assert errors.segments > 10
    assert math.isfinite(errors.t_rel)
    assert path_errors(a_path(31), lengths=[100.0]).segments == 0
    stream = Console(width=100, record=True, file=io.StringIO())
    stream.print(path_table([errors]).rich())
    text = stream.export_text()
    assert "segments of 12 to 48 m" in text
    assert "odometry/99 l" in text


class Recording(NumberDrive):
    def __init__(self, times, poses):
        super().__init__("odometry/99 l", (4, 5, 6))
        self.times, self.poses = times, poses

    def time(self, index):
        return self.times.get(index)

    def pose(self, index):
        return self.poses.get(index)


def test_a_path_takes_truth_and_times_where_the_recording_has_them_all():
    poses = dict(zip((4, 5, 6), winding(3), strict=True))
    path = path_of(Recording({4: 0.5, 5: 0.6, 6: 0.75}, poses), predicted(3))
    assert path.times.tolist() == [0.5, 0.6, 0.75]
    np.testing.assert_array_equal(path.true, winding(3))
    path = path_of(Recording({4: 0.5}, {4: np.eye(4)}), predicted(3))
    assert path.times is None
    assert path.true is None


def test_files_are_read_back(tmp_path):
    path = a_path(20)
    write_path(path, tmp_path)
    for kind, poses in (("predicted", path.predicted), ("aligned", path.aligned), ("true", path.true)):
        np.testing.assert_allclose(read_kitti(tmp_path / f"{kind}_kitti.txt"), poses, atol=1e-12)
        table = np.loadtxt(tmp_path / f"{kind}_tum.txt")
        np.testing.assert_allclose(table[:, 1:4], poses[:, :3, 3], atol=1e-12)
        np.testing.assert_array_equal(table[:, 0], path.times)
    write_path(Path3d("no truth", path.predicted, path.times), tmp_path / "alone")
    assert sorted(file.name for file in (tmp_path / "alone").iterdir()) == ["predicted_kitti.txt", "predicted_tum.txt"]
    write_path(Path3d("no times", path.predicted), tmp_path / "timeless")
    assert [file.name for file in (tmp_path / "timeless").iterdir()] == ["predicted_kitti.txt"]


def test_errors_as_json_and_csv(tmp_path):
    rows = [path_errors(a_path(31)), path_errors(a_path(31), lengths=[100.0])]
    write_errors(rows, tmp_path, {"checkpoint": "x.ckpt"})
    content = json.loads((tmp_path / "odometry.json").read_text())
    assert content["settings"] == {"checkpoint": "x.ckpt"}
    assert content["results"][0]["ate"] == rows[0].ate
    assert content["results"][1]["t_rel"] is None
    with (tmp_path / "odometry.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert [row["lengths"] for row in table] == ["12.0 24.0 36.0 48.0", "100.0"]


@pytest.mark.parametrize("known", [True, False])
def test_the_picture_shows_a_path(tmp_path, known):
    pytest.importorskip("matplotlib")
    path = a_path(40) if known else Path3d("no truth", predicted(40), np.arange(40.0))
    draw_path(path, tmp_path / "deep" / "path.png")
    picture = cv2.imread(str(tmp_path / "deep" / "path.png"))
    assert picture.shape[0] > 400
    blue, green, red = (picture[..., k].astype(int) for k in range(3))
    assert ((red - green > 100) & (red - blue > 100)).sum() > 500  # the predicted path is drawn in red


def test_the_title_says_the_root_mean_square_distance(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    drawn = []
    monkeypatch.setattr(paths, "save", lambda figure, file: drawn.append(figure))
    path = a_path(40)
    draw_path(path, tmp_path / "path.png")
    off = [float(np.linalg.norm((ours - true)[:3, 3])) for ours, true in zip(path.aligned, path.true, strict=True)]
    expected = sum(each**2 for each in off) / len(off)
    assert f"{expected**0.5:.2f}" != f"{sum(off) / len(off):.2f}"
    assert drawn[0].axes[1].get_title() == f"off by {expected**0.5:.2f} m (root mean square)"


def table_text(*errors):
    stream = Console(width=160, record=True, file=io.StringIO())
    stream.print(path_table(errors).rich())
    return " ".join(stream.export_text().split())


def straight_road(frames=31, step=2.0):
    true = np.tile(np.eye(4), (frames, 1, 1))
    true[:, 2, 3] = np.arange(frames) * step
    return true


def test_sideways_on_a_straight_road_is_found_out():
    sideways = np.tile(np.eye(4), (31, 1, 1))
    sideways[:, 0, 3] = np.arange(31.0)
    path = Path3d("x", sideways, np.arange(31.0), straight_road())
    model, straight = path_errors(path), path_errors(straight_ahead(path))
    assert model.ate == pytest.approx(0, abs=1e-9)  # after an alignment
    assert model.turn == pytest.approx(90)
    assert model.snippet_ate > 1
    assert model.t_rel > 100
    assert (straight.predictor, straight.scale) == (STRAIGHT, pytest.approx(2.0))
    assert max(straight.snippet_ate, straight.t_rel, straight.turn) < 1e-6
    text = table_text(model, straight)
    assert STRAIGHT in text
    assert " 90 " in text


def test_a_world_of_its_own_is_no_turn():
    """However the first cameras are turned, only what remains once they coincide counts, and a roll does not."""
    other = np.eye(4)
    other[:3, :3] = Rotation.from_rotvec([0.3, 2.0, -1.0]).as_matrix()
    for true in (winding(), straight_road()):
        assert Path3d("x", other @ true, np.arange(float(len(true))), true).turn == pytest.approx(0, abs=1e-4)
    bent = winding()
    bent[:, :3, 3] = bent[:, :3, 3] @ Rotation.from_rotvec([0, np.radians(20), 0]).as_matrix().T
    assert Path3d("x", bent, np.arange(120.0), winding()).turn == pytest.approx(20, abs=0.1)
    assert Path3d("x", winding(), np.arange(120.0)).turn == 0
    standing = np.tile(np.eye(4), (5, 1, 1))
    assert Path3d("x", standing, np.arange(5.0), straight_road(5)).turn == 0


def test_only_snippets_of_five_frames_are_as_published():
    assert "5-frame ATE: own scale per snippet, as published;" in table_text(path_errors(a_path(31)))
    text = table_text(path_errors(a_path(31), snippet=100))
    assert "100-frame ATE: own scale per snippet, published numbers use 5 frames;" in text
    assert "as published" not in text


def test_a_segment_that_does_not_fit_is_said():
    text = table_text(path_errors(a_path(31), lengths=[1000.0]))
    assert "odometry/99 l is only 60.0 m long, too short for a segment of 1000 m" in text
    assert "nan" not in text


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"snippet": 0}, "snippet is 0; it counts frames and must be at least 2"),
        ({"snippet": 1}, "snippet is 1"),
        ({"lengths": (10.0, -5.0)}, "lengths is -5.0; it must be greater than 0"),
        ({"lengths": (math.inf,)}, "lengths is inf"),
    ],
)
def test_settings_without_sense_are_refused(options, words):
    with pytest.raises(ConfigError, match=words):
        OdometryOptions(checkpoint="best.ckpt", data=Spec({}), **options)


def test_the_errors_stand_in_the_picture(tmp_path):
    pytest.importorskip("matplotlib")
    path = a_path(40)
    draw_path(path, tmp_path / "bare.svg")
    draw_path(path, tmp_path / "path.svg", [path_errors(each) for each in (path, straight_ahead(path))])
    bare, told = ((tmp_path / name).read_text() for name in ("bare.svg", "path.svg"))
    for words in ("pose network: 5-frame ATE", "constant motion straight ahead: 5-frame ATE"):
        assert words in told  # Matplotlib keeps a text beside its outlines
        assert words not in bare
