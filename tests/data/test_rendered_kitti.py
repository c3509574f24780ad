"""A rendered drive written in KITTI's layouts comes back through the KITTI readers with its exact truth."""

from __future__ import annotations

import numpy as np
import pytest

from saunet.data.kitti.odometry import OdometrySequence
from saunet.data.kitti.raw import KittiRaw
from saunet.registry import datamodules
from saunet.synthetic import SyntheticDrive, write_odometry, write_raw


@pytest.fixture(scope="module")
def rendered():
    return SyntheticDrive(seed=4, frames=6, height=60, width=180)


@pytest.fixture(scope="module")
def root(rendered, tmp_path_factory):
    root = tmp_path_factory.mktemp("kitti") / "raw"
    write_raw(root, [rendered], right=[rendered.stereo()], ground_truth=True)
    return root


def test_images_intrinsics_and_speed_come_back(rendered, root):
    raw = KittiRaw(root)
    (name,) = raw.drives
    for camera, truth in (("left", rendered), ("right", rendered.stereo())):
        drive = raw.drive(name, camera)
        assert list(drive.indices) == list(rendered.indices)
        assert np.array_equal(drive.image(2), truth.image(2))
        assert drive.intrinsics(2) == pytest.approx(truth.intrinsics(2), abs=1e-4)
    step = np.linalg.norm(rendered.pose(3)[:3, 3] - rendered.pose(2)[:3, 3])
    assert raw.drive(name).speed(2) == pytest.approx(10 * step, rel=0.1)


@pytest.mark.parametrize("camera", ["left", "right"])
def test_lidar_depth_is_the_rendered_depth(rendered, root, camera):
    raw = KittiRaw(root)
    truth = (rendered if camera == "left" else rendered.stereo()).depth(1)
    measured = raw.drive(next(iter(raw.drives)), camera).depth(1)
    hit = (measured > 0) & (truth > 0)
    assert hit.sum() > 300
    # from the left camera the scan was made; the right one does not see all of it
    error = np.abs(measured[hit] / truth[hit] - 1)
    assert np.quantile(error, 1.0 if camera == "left" else 0.5) < (1e-3 if camera == "left" else 0.02)


def test_improved_depth_is_the_rendered_depth(rendered, root):
    raw = KittiRaw(root)
    read = raw.drive(next(iter(raw.drives)), depth_kind="improved").depth(0)
    truth = rendered.depth(0)
    near = (truth > 0) & (truth < 100)
    assert np.abs(read - truth)[near].max() <= 0.5 / 256 + 1e-4


def test_the_data_module_trains_on_it(root):
    data = datamodules.build(
        "kitti",
        root=str(root),
        split="all",
        val_share=0.2,
        height=32,
        width=96,
        batch_size=2,
        workers=0,
        static="speed",
    )
    data.setup()
    batch = data.on_after_batch_transfer(next(iter(data.train_dataloader())), 0)
    assert batch["target"].shape == (2, 3, 32, 96)
    assert len(data.datasets["test"]) == 4


def test_odometry_poses_come_back(rendered, tmp_path):
    write_odometry(tmp_path / "odometry", [rendered], right=[rendered.stereo()])
    for camera, truth in (("color_left", rendered), ("color_right", rendered.stereo())):
        drive = OdometrySequence(tmp_path / "odometry", "00", camera)
        assert drive.intrinsics(0) == pytest.approx(truth.intrinsics(0), abs=1e-4)
        for index in (1, 4):
            motion = np.linalg.inv(drive.pose(index)) @ drive.pose(0)
            expected = np.linalg.inv(truth.pose(index)) @ truth.pose(0)
            assert motion == pytest.approx(expected, abs=1e-5)
