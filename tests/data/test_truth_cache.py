"""Cached ground truth is the drive's own, and never that of another scan or calibration."""

from __future__ import annotations

import dataclasses
import os
import pickle

import numpy as np
import pytest

from saunet.data.drive import Drive
from saunet.data.kitti.raw import KittiRaw
from saunet.data.loading.stored import CachedTruth, cache_truths
from saunet.errors import DataError
from saunet.synthetic import SyntheticDrive
from saunet.synthetic.kitti_writer import write_raw


@pytest.fixture
def drive(tmp_path):
    write_raw(tmp_path / "raw", [SyntheticDrive(seed=1, frames=3, height=64, width=96)])
    raw = KittiRaw(tmp_path / "raw")
    return raw.drive(next(iter(raw.drives)))


def test_the_same_depth_from_the_scan_and_from_the_folder(drive, tmp_path, monkeypatch):
    cached = CachedTruth(drive, tmp_path / "cache")
    expected = drive.depth(1)
    np.testing.assert_array_equal(cached.depth(1), expected)
    assert cached.truth_path(1).is_file()
    monkeypatch.setattr(type(drive), "depth", lambda self, index: pytest.fail("projected again"))
    again = cached.depth(1)
    np.testing.assert_array_equal(again, expected)
    assert again.dtype == np.float32


def test_it_is_the_drive_in_everything_else(drive, tmp_path):
    cached = pickle.loads(pickle.dumps(CachedTruth(drive, tmp_path / "cache")))
    assert isinstance(cached, Drive)
    assert (cached.name, list(cached.indices)) == (drive.name, list(drive.indices))
    np.testing.assert_array_equal(cached.image(0), drive.image(0))
    assert (cached.fps, cached.camera_height, cached.folder) == (drive.fps, drive.camera_height, drive.folder)


def test_a_frame_without_scan_has_none(drive, tmp_path):
    drive.depth_file(2).unlink()
    assert CachedTruth(drive, tmp_path / "cache").depth(2) is None


def test_whatever_the_depth_depends_on_changes_the_name(drive, tmp_path, monkeypatch):
    cached = CachedTruth(drive, tmp_path / "cache")
    names = {cached.truth_path(0), cached.truth_path(1)}
    drive.depth_kind = "lidar_x"
    names.add(cached.truth_path(0))
    drive.calibration = dataclasses.replace(drive.calibration, rectification=drive.calibration.rectification + 1e-9)
    names.add(cached.truth_path(0))
    scan = drive.depth_file(0)
    os.utime(scan, ns=(scan.stat().st_atime_ns, scan.stat().st_mtime_ns + 1))
    names.add(cached.truth_path(0))
    scan.write_bytes(scan.read_bytes()[:-16])
    os.utime(scan, ns=(scan.stat().st_atime_ns, 10**18))
    shorter = cached.truth_path(0)
    scan.write_bytes(scan.read_bytes()[:-16])
    os.utime(scan, ns=(scan.stat().st_atime_ns, 10**18))
    names |= {shorter, cached.truth_path(0)}
    calibration = drive.calibration
    moved = {number: P + 1e-9 for number, P in calibration.projections.items()}
    drive.calibration = dataclasses.replace(calibration, projections=moved)
    names.add(cached.truth_path(0))
    drive.calibration = dataclasses.replace(calibration, T_cam_velo=calibration.T_cam_velo + 1e-9)
    names.add(cached.truth_path(0))
    monkeypatch.setattr(type(drive), "native_size", (64, 98))
    names.add(cached.truth_path(0))
    monkeypatch.setattr("saunet.data.kitti.raw.PROJECTION", 99)
    names.add(cached.truth_path(0))
    assert len(names) == 11


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 half", b"junk"])
def test_a_damaged_file_is_made_anew(drive, tmp_path, content):
    cached = CachedTruth(drive, tmp_path / "cache")
    cached.depth(0)
    cached.truth_path(0).write_bytes(content)
    np.testing.assert_array_equal(cached.depth(0), drive.depth(0))
    assert cached.truth_path(0).stat().st_size > 100
    assert [path.name for path in cached.truth_path(0).parent.iterdir()] == [cached.truth_path(0).name]


def test_a_folder_that_cannot_be_written_is_named(drive, tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(DataError, match=r"cannot write .*truth_cache=null"):
        CachedTruth(drive, tmp_path / "file").depth(0)


def test_only_projected_truth_is_cached(drive, tmp_path):
    improved = KittiRaw(tmp_path / "raw").drive(drive.name.split()[0], depth_kind="improved")
    drives = [drive, SyntheticDrive(seed=1, frames=1, height=64, width=96), improved]
    cache_truths(drives, tmp_path / "cache")
    assert [each.truth_path(0) is None for each in drives] == [False, True, True]
    np.testing.assert_array_equal(drives[1].depth(0), SyntheticDrive(seed=1, frames=1, height=64, width=96).depth(0))
