"""Pose files: round trips, the layout other tools expect, and broken files."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from saunet.errors import DataError
from saunet.io.trajectories import read_kitti, write_kitti, write_tum


def poses(n=5):
    made = np.tile(np.eye(4), (n, 1, 1))
    made[:, :3, :3] = Rotation.random(n, random_state=0).as_matrix()
    made[:, :3, 3] = np.random.default_rng(0).normal(size=(n, 3)) * 100
    return made


def test_kitti_round_trip(tmp_path):
    path = tmp_path / "deep" / "00.txt"
    write_kitti(path, poses())
    np.testing.assert_array_equal(read_kitti(path), poses())
    assert np.loadtxt(path).shape == (5, 12)
    np.testing.assert_array_equal(np.loadtxt(path)[0, [3, 7, 11]], poses()[0, :3, 3])


def test_tum_round_trip(tmp_path):
    path = tmp_path / "path.tum"
    times = np.arange(5) * 0.1037
    write_tum(path, poses(), times)
    table = np.loadtxt(path)
    np.testing.assert_allclose(table[:, 1:4], poses()[:, :3, 3], atol=1e-12)
    np.testing.assert_allclose(Rotation.from_quat(table[:, 4:]).as_matrix(), poses()[:, :3, :3], atol=1e-12)
    np.testing.assert_array_equal(table[:, 0], times)


def test_tum_columns(tmp_path):
    turned = np.eye(4)[None].copy()
    turned[0, :3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    turned[0, :3, 3] = [1.0, 2.0, 3.0]
    write_tum(tmp_path / "t", turned, np.array([7.0]))
    half = np.sqrt(0.5)
    np.testing.assert_allclose(np.loadtxt(tmp_path / "t"), [7, 1, 2, 3, 0, 0, half, half], atol=1e-15)


def test_real_poses(kitti_mini):
    path = kitti_mini / "odometry" / "poses" / "06.txt"
    real = read_kitti(path)
    assert real.shape == (51, 4, 4)
    np.testing.assert_allclose(
        real[:, :3, :3] @ real[:, :3, :3].transpose(0, 2, 1), np.eye(3)[None].repeat(51, 0), atol=1e-5
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"poses.txt has no pose; expected lines of 12 finite numbers \(a 3 x 4 pose, row by row\)"),
        ("\n\n", "has no pose"),
        ("1 2 3\n", r"poses.txt, line 1: expected 12 finite numbers \(a 3 x 4 pose, row by row\), got '1 2 3'"),
        ("\n" + " ".join(["x"] * 12), "line 2: expected 12 finite numbers"),
        (" ".join(["nan"] * 12), "line 1: expected 12 finite numbers"),
    ],
)
def test_broken_kitti_files(tmp_path, text, message):
    path = tmp_path / "poses.txt"
    path.write_text(text)
    with pytest.raises(DataError, match=message):
        read_kitti(path)


def test_other_bad_input(tmp_path):
    with pytest.raises(DataError, match="cannot read"):
        read_kitti(tmp_path / "missing")
    (tmp_path / "picture").write_bytes(b"\x89PNG\xff")
    with pytest.raises(DataError, match=r"cannot read .*picture as text"):
        read_kitti(tmp_path / "picture")
    with pytest.raises(DataError, match="5 poses come with 4 times"):
        write_tum(tmp_path / "t", poses(), np.arange(4.0))


def test_a_comment_is_no_frame_of_a_kitti_file(tmp_path):
    """Frames are counted by lines: a line passed over would give every later frame its neighbor's pose."""
    path, row = tmp_path / "00.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n"
    path.write_text(f"{row}# {row}{row}")
    with pytest.raises(DataError, match="line 2: expected 12 finite numbers"):
        read_kitti(path)


def test_tum_wants_true_times(tmp_path):
    for times in ([0.0, 1.0, 1.0], [0.0, 2.0, 1.0], [0.0, 1.0, np.nan]):
        with pytest.raises(DataError, match="do not ascend"):
            write_tum(tmp_path / "a.tum", poses(3), np.array(times))
    assert list(tmp_path.iterdir()) == []
