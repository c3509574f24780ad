"""What the public data sets share: motions from quaternions, pairs by time, depth from points, roots."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from saunet.data.lidar import points_to_depth
from saunet.data.sets.base import FilesDrive, associate, find_root, transform
from saunet.errors import DataError

K = np.array([[50.0, 0, 30], [0, 50, 10], [0, 0, 1]])


def test_a_quaternion_is_read_in_the_order_that_is_said() -> None:
    half = np.sqrt(0.5)  # a quarter turn about z: x becomes y
    T = transform([half, 0, 0, half], [1, 2, 3], "wxyz", "here")
    np.testing.assert_allclose(T @ [1, 0, 0, 1], [1, 3, 3, 1], atol=1e-12)
    np.testing.assert_allclose(transform([0, 0, half, half], [1, 2, 3], "xyzw", "here"), T, atol=1e-12)
    # [w, x, y, z] = [half, half, 0, 0] is a quarter turn about x; in the other order it is a half turn about (1, 1, 0)
    turned = transform([half, half, 0, 0], [0, 0, 0], "wxyz", "here")[:3, :3]
    np.testing.assert_allclose(turned @ [0, 1, 0], [0, 0, 1], atol=1e-12)
    turned = transform([half, half, 0, 0], [0, 0, 0], "xyzw", "here")[:3, :3]
    np.testing.assert_allclose(turned @ [1, 0, 0], [0, 1, 0], atol=1e-12)


@pytest.mark.parametrize("quaternion", [[0, 0, 0, 0], [1, 1, 0, 0], [np.nan, 0, 0, 1]])
def test_a_quaternion_that_is_none_is_named(quaternion) -> None:
    with pytest.raises(DataError, match=r"poses.txt, line 3 .*quaternion"):
        transform(quaternion, [0, 0, 0], "wxyz", "poses.txt, line 3")


def test_times_are_paired_one_to_one_nearest_first() -> None:
    first, second = np.array([0.0, 0.1, 0.2, 1.0]), np.array([0.08, 0.11, 0.5, 1.05])
    # 0.08 is nearest to 0.1 but 0.11 is nearer, so it goes to 0.0, and 0.2 gets none
    assert associate(first, second, 0.1) == [(0, 0), (1, 1), (3, 3)]
    assert associate(first, second, 0.02) == [(1, 1)]
    assert associate(first, np.array([]), 1.0) == []


def test_points_become_depth_at_pixel_centers() -> None:
    points = np.array([[0.0, 0, 10], [0, 0, 5], [0.19, 0, 10], [0, 0, -5], [100, 0, 1], [-6, -2, 10]])
    depth = points_to_depth(points, K, (20, 60))
    assert depth[10, 30] == 5  # the nearest of two
    assert depth[10, 31] == 10  # u = 30.95
    assert depth[0, 0] == 10
    assert np.count_nonzero(depth) == 3


def test_a_root_is_found_around_the_folder_given(tmp_path) -> None:
    home = tmp_path / "a" / "b"
    (home / "calibration").mkdir(parents=True)
    for given in (home, home / "calibration", tmp_path / "a", tmp_path):
        assert find_root(given, "calibration", "what it is") == home.resolve()
    with pytest.raises(DataError, match=r"no 'scenes' at .*; set data.root to what it is"):
        find_root(home, "scenes", "what it is")
    with pytest.raises(DataError, match=r"no data root at .*gone"):
        find_root(tmp_path / "gone", "scenes", "what it is")


def test_images_scaled_as_a_whole_scale_k(tmp_path) -> None:
    cv2.imwrite(str(tmp_path / "7.png"), np.zeros((10, 30, 3), np.uint8))
    drive = FilesDrive("one", {7: tmp_path / "7.png"}, K, tmp_path / "calib.json", (20, 60))
    assert drive.intrinsics(7)[0].tolist() == [25, 0, (30 + 0.5) / 2 - 0.5]
    assert (drive.frame_size, drive.native_size) == ((10, 30), (20, 60))
    drive = FilesDrive("one", {7: tmp_path / "7.png"}, K, tmp_path / "calib.json", (60, 60))
    with pytest.raises(DataError, match=r"7.png has 10x30 .*calib.json is for 60x60"):
        drive.intrinsics(7)
