from __future__ import annotations

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from saunet.data.kitti.files import lidar_depth, read_calibration
from saunet.data.lidar import read_scan
from saunet.errors import ConfigError, DataError


def calibration(arrays, prefix):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = arrays[f"{prefix}velo_to_cam_R"], arrays[f"{prefix}velo_to_cam_T"]
    width, height = arrays[f"{prefix}size_wh"]
    return arrays[f"{prefix}P_rect_02"], arrays[f"{prefix}R_rect_00"], T, (int(height), int(width))


def expected_map(arrays, case, kind):
    expected = np.zeros(arrays[f"{case}_shape"])
    key = f"{case}_{kind}"
    expected[arrays[f"{key}_rows"], arrays[f"{key}_cols"]] = arrays[f"{key}_values"]
    for change, value in (("quirk", "plain"), ("behind", "dropped")):
        rows, columns = arrays[f"{key}_{change}_rows"], arrays[f"{key}_{change}_cols"]
        expected[rows, columns] = arrays[f"{key}_{change}_{value}_values"]
    return expected


@pytest.mark.parametrize("case", ["frame0", "frame10", "synthetic"])
@pytest.mark.parametrize(("kind", "short"), [("camera_z", "cam"), ("lidar_x", "vel")])
def test_maps_are_those_of_the_field(reference, case, kind, short):
    arrays = reference("lidar_depth")
    points = arrays[f"{case}_points"]
    ours = lidar_depth(points, *calibration(arrays, "synthetic_" if case == "synthetic" else ""), kind)
    expected = expected_map(arrays, case, short)
    assert np.array_equal(ours > 0, expected > 0)
    assert np.abs(ours - expected).max() < 2e-5


@pytest.mark.parametrize(("kind", "short"), [("camera_z", "cam"), ("lidar_x", "vel")])
@pytest.mark.parametrize("frame", [0, 10])
def test_whole_real_scans_give_the_same_maps(reference, kitti_mini, kind, short, frame):
    date = kitti_mini / "raw" / "2011_09_26"
    day = read_calibration(date)
    points = read_scan(date / "2011_09_26_drive_9015_sync" / "velodyne_points" / "data" / f"{frame:010d}.bin")
    ours = lidar_depth(points, day.projections[2], day.rectification, day.T_cam_velo, day.sizes[2], kind)
    expected = expected_map(reference("lidar_depth"), f"frame{frame}", short)
    assert np.array_equal(ours > 0, expected > 0)
    assert np.abs(ours - expected).max() < 2e-5


def project(points, kind="camera_z"):
    T = np.eye(4)
    T[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    K = np.array([[50.0, 0, 30, 0], [0, 50, 10, 0], [0, 0, 1, 0]])
    return lidar_depth(np.array(points, np.float32), K, np.eye(3), T, (20, 60), kind)


def test_a_point_lands_one_pixel_before_where_the_one_based_calibration_says():
    depth = project([[10, 0, 0]])
    assert depth[9, 29] == 10
    assert np.count_nonzero(depth) == 1


def test_the_nearest_point_stays_and_points_behind_are_dropped():
    depth = project([[10, 0, 0], [5, 0, 0], [20, 0, 0], [-5, 0, 0], [0, 0, 0]])
    assert depth[9, 29] == 5
    assert np.count_nonzero(depth) == 1


def test_no_point_in_view_gives_an_empty_map():
    assert project([[1, 50, 0]]).sum() == 0


def test_unknown_kind_is_refused():
    with pytest.raises((ConfigError, TypeCheckError), match=r"depth kind is 'z'|parameter kind="):
        project([[1, 0, 0]], "z")


def test_broken_scans_are_named(tmp_path):
    (tmp_path / "a.bin").write_bytes(b"x" * 20)
    with pytest.raises(DataError, match=r"a.bin has 20 bytes, not a multiple of 16"):
        read_scan(tmp_path / "a.bin")
    (tmp_path / "b.bin").touch()
    with pytest.raises(DataError, match=r"b.bin is empty"):
        read_scan(tmp_path / "b.bin")


def test_points_that_are_no_numbers_are_counted_and_said(tmp_path):
    points = np.array([[10, 0, 0, 0.5], [np.nan, 1, 1, 0.5], [20, np.inf, 1, 0.5]], np.float32)
    points.tofile(tmp_path / "scan.bin")
    with pytest.warns(UserWarning, match=r"scan\.bin: 2 of 3 points"):
        assert read_scan(tmp_path / "scan.bin").tolist() == [[10, 0, 0]]
    points[1:].tofile(tmp_path / "scan.bin")
    with pytest.raises(DataError, match=r"scan\.bin contains only points"):
        read_scan(tmp_path / "scan.bin")
