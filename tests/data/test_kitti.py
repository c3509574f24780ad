from __future__ import annotations

import pickle

import cv2
import numpy as np
import pytest
from kitti_tree import DATE, make_drive, name

from saunet.data.drive import Drive
from saunet.data.kitti.raw import KittiRaw
from saunet.data.kitti.splits import read_split
from saunet.data.loading.selecting import Frame
from saunet.errors import ConfigError, DataError


@pytest.mark.parametrize("where", ["..", ".", DATE, f"{DATE}/{DATE}_drive_0001_sync"])
def test_layout_is_found_at_above_and_below_the_date(tmp_path, where):
    make_drive(tmp_path / "raw", 1)
    raw = KittiRaw(tmp_path / "raw" / where)
    assert list(raw.drives) == [name(1)]
    assert len(raw.drive(name(1)).indices) == 6


def test_a_relative_root_and_foreign_folders(tmp_path, monkeypatch):
    make_drive(tmp_path, 1)
    (tmp_path / DATE / f"{DATE}_drive_0002_extract").mkdir()
    (tmp_path / "notes").mkdir()
    monkeypatch.chdir(tmp_path / DATE)
    assert list(KittiRaw(".").drives) == [name(1)]


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_drive(tmp_path, suffix):
    make_drive(tmp_path, 1, frames=[0, 1, 3], suffix=suffix)
    drive = KittiRaw(tmp_path).drive(name(1), "right")
    assert isinstance(drive, Drive)
    assert drive.name == f"{name(1)} r"
    assert list(drive.indices) == [0, 1, 3]
    assert drive.image(3).shape == (20, 60, 3)
    assert np.abs(drive.image(3).astype(int) - [3, 3, 0]).max() <= 2  # red is the frame, green the camera
    assert drive.intrinsics(0)[0].tolist() == [55, 0, 30]
    assert drive.pose(0) is None
    assert drive.depth(0).shape == (20, 60)
    assert pickle.loads(pickle.dumps(drive)).indices == drive.indices


def test_png_comes_before_jpeg(tmp_path):
    make_drive(tmp_path, 1, frames=[0])
    folder = tmp_path / name(1) / "image_02" / "data"
    (folder / "0000000000.jpg").write_bytes(b"")
    assert KittiRaw(tmp_path).drive(name(1)).path(0).suffix == ".png"


def test_depth_kinds(tmp_path):
    make_drive(tmp_path, 1)
    raw = KittiRaw(tmp_path)
    assert sorted(set(raw.drive(name(1)).depth(0).ravel())) == [0, 10, 20]
    assert raw.drive(name(1), depth_kind="improved").depth(0) is None
    truth = tmp_path / name(1) / "proj_depth" / "groundtruth" / "image_02"
    truth.mkdir(parents=True)
    cv2.imwrite(str(truth / "0000000000.png"), np.full((20, 60), 512, np.uint16))
    assert (raw.drive(name(1), depth_kind="improved").depth(0) == 2).all()


@pytest.mark.parametrize("where", ["raw", "raw/data_depth_annotated", "depth", "."])
def test_annotated_depth_is_found_in_its_archives_layout(tmp_path, where):
    for number, split in ((1, "train"), (2, "val")):
        make_drive(tmp_path / "raw", number, scans=False)
        folder = tmp_path / where / split / name(number).split("/")[1] / "proj_depth" / "groundtruth" / "image_03"
        folder.mkdir(parents=True)
        cv2.imwrite(str(folder / "0000000005.png"), np.full((20, 60), 256 * number, np.uint16))
    raw = KittiRaw(tmp_path / "raw")
    for number in (1, 2):
        drive = raw.drive(name(number), "right", "improved")
        assert [drive.has_depth(index) for index in (4, 5)] == [False, True]
        assert (drive.depth(5) == number).all()
        assert drive.stereo().depth(5) is None
        assert pickle.loads(pickle.dumps(drive)).has_depth(5)


def test_annotated_depth_may_lie_anywhere_and_is_named_if_it_does_not(tmp_path):
    make_drive(tmp_path / "a" / "raw", 1, scans=False)
    folder = tmp_path / "b" / "train" / name(1).split("/")[1] / "proj_depth" / "groundtruth" / "image_02"
    folder.mkdir(parents=True)
    cv2.imwrite(str(folder / "0000000003.png"), np.full((20, 60), 512, np.uint16))
    assert KittiRaw(tmp_path / "a" / "raw").drive(name(1), depth_kind="improved").depth(3) is None
    assert (KittiRaw(tmp_path / "a" / "raw", tmp_path / "b").drive(name(1), depth_kind="improved").depth(3) == 2).all()
    with pytest.raises(DataError, match=r"no annotated depth maps at .*data_depth_annotated\.zip"):
        KittiRaw(tmp_path / "a" / "raw", tmp_path / "a").drive(name(1), depth_kind="improved")


def test_files_with_a_byte_order_mark_are_read(tmp_path):
    drive = make_drive(tmp_path / "raw", 1)
    (drive / "oxts" / "data").mkdir(parents=True)
    (drive / "oxts" / "data" / "0000000000.txt").write_text(" ".join(["1"] * 8 + ["3", "4", "0"] + ["1"] * 19))
    (drive / "image_02" / "timestamps.txt").write_text("2011-09-26 13:02:25.5\n2011-09-26 13:02:25.6\n")
    (tmp_path / "list.txt").write_text(f"{name(1)} 0000000002 l\n")
    calibration = drive.parent / "calib_cam_to_cam.txt"
    calibration.write_text(calibration.read_text().partition("\n")[2].partition("\n")[2])  # S_rect_00 comes first
    for path in (*drive.rglob("*.txt"), calibration, tmp_path / "list.txt"):
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    read = KittiRaw(tmp_path / "raw").drive(name(1))
    assert (read.speed(0), read.time(1) - read.time(0)) == (5, pytest.approx(0.1))
    assert set(read.calibration.sizes) == {0, 2, 3}
    assert read_split(tmp_path / "list.txt") == [Frame(name(1), 2, "l")]


def test_missing_scans_and_scanner_are_no_depth(tmp_path):
    make_drive(tmp_path, 1, scans=False)
    make_drive(tmp_path, 2)
    raw = KittiRaw(tmp_path)
    assert raw.drive(name(1)).depth(0) is None
    assert raw.drive(name(2)).has_depth(0)
    (tmp_path / DATE / "calib_velo_to_cam.txt").unlink()
    assert KittiRaw(tmp_path).drive(name(2)).depth(0) is None


def test_images_made_smaller_scale_the_intrinsics_but_not_the_truth(tmp_path):
    make_drive(tmp_path, 1, size=(10, 30))
    drive = KittiRaw(tmp_path).drive(name(1))
    assert drive.intrinsics(0)[0].tolist() == pytest.approx([25, 0, 29.5 / 2 - 0.5])
    assert drive.depth(0).shape == (20, 60)


def test_images_of_another_shape_are_refused(tmp_path):
    make_drive(tmp_path, 1, size=(20, 50))
    with pytest.raises(DataError, match=r"0000000000.png has 20x50 .* but .*calib_cam_to_cam.txt is for 20x60"):
        KittiRaw(tmp_path).drive(name(1)).intrinsics(0)


def test_images_made_smaller_need_the_size_of_the_originals(tmp_path):
    make_drive(tmp_path, 1, size=(10, 30))
    calibration = tmp_path / DATE / "calib_cam_to_cam.txt"
    lines = calibration.read_text().splitlines()
    calibration.write_text("\n".join(line for line in lines if not line.startswith("S_rect")))
    with pytest.raises(DataError, match=r"P_rect_02 \(without S_rect\) has .* center 30, 10 for an image of 10x30"):
        KittiRaw(tmp_path).drive(name(1)).intrinsics(0)


@pytest.mark.parametrize("with_size", [True, False])
@pytest.mark.parametrize("first", [b"", (8, 12)])
def test_a_bad_first_frame_decides_nothing(tmp_path, first, with_size):
    make_drive(tmp_path, 1)
    path = tmp_path / name(1) / "image_02" / "data" / "0000000000.png"
    if first:
        cv2.imwrite(str(path), np.zeros((*first, 3), np.uint8))
    else:
        path.write_bytes(first)
    if not with_size:
        calibration = tmp_path / DATE / "calib_cam_to_cam.txt"
        calibration.write_text(calibration.read_text().replace("S_rect", "s_rect"))
    drive = KittiRaw(tmp_path).drive(name(1))
    assert drive.intrinsics(1)[0].tolist() == [50, 0, 29]
    assert drive.native_size == drive.frame_size == (20, 60)


def test_an_absent_drive_has_no_frames(tmp_path):
    make_drive(tmp_path, 1)
    raw = KittiRaw(tmp_path)
    assert list(raw.drive(name(7)).indices) == []
    assert list(raw.drive("2011_10_03/2011_10_03_drive_0001_sync").indices) == []


def test_missing_root_and_no_drives_are_named(tmp_path):
    with pytest.raises(DataError, match=r"no data root at .*gone; set data.root"):
        KittiRaw(tmp_path / "gone")
    with pytest.raises(DataError, match=r"no KITTI drives found at .*expected folders such as"):
        KittiRaw(tmp_path)


def test_unknown_words_are_refused(tmp_path):
    make_drive(tmp_path, 1)
    with pytest.raises(ConfigError, match="camera is 'middle'"):
        KittiRaw(tmp_path).drive(name(1), "middle")


def test_lidar_and_intrinsics_agree_on_where_a_point_is(tmp_path):
    make_drive(tmp_path, 1)
    drive = KittiRaw(tmp_path).drive(name(1), "left")
    K, depth = drive.intrinsics(0), drive.depth(0)
    for point in ([0, 0, 10], [2, -1.2, 20]):  # the scan's points, x right, y down, z forward
        seen = point + np.array([3 / 50, 0, 0])  # camera 2 stands left of camera 0
        u, v, _ = np.round(K @ seen / seen[2]).astype(int)
        assert depth[v, u] == point[2]
