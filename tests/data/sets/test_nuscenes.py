"""nuScenes: tables to recordings; pixels and depth that nuscenes-devkit 1.2.0 gives on the same tables."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
import set_trees

from saunet.data.sets.nuscenes import MINI_VAL, VAL
from saunet.errors import ConfigError, DataError
from saunet.metrics.protocols import protocol
from saunet.registry import datamodules

OFFICIAL = {  # NuScenesExplorer.map_pointcloud_to_image of scene-0103: frame -> its points (x, y, depth)
    0: [(863.608847246, 580.14737871, 13.393335), (659.040558702, 471.726619123, 24.40673)],
    6: [(865.228585018, 580.19347597, 13.387073), (659.879252651, 471.724078097, 24.400457)],
}


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return set_trees.nuscenes(tmp_path_factory.mktemp("nuscenes"))


def module(root, **options):
    small = {"height": 36, "width": 64, "workers": 0, "batch_size": 2}
    return datamodules.build("nuscenes", root=str(root), **{**small, **options})


def names(data, split):
    return [drive.name for drive in data.datasets[split].drives]


def test_the_division_is_the_official_one(tmp_path):
    # nuscenes-devkit 1.2.0, nuscenes.utils.splits: 700 train, 150 val (and 150 test, in a version of its own)
    assert len(VAL) == 150
    assert sum(VAL) == 88_948
    assert {3, 12, 110, 221, 555, 638, 802, 916, 1073} < VAL
    assert not {1, 61, 112, 639, 757, 803, 918, 1094} & VAL
    assert sorted(MINI_VAL) == [103, 916]
    data = module(set_trees.nuscenes(tmp_path, "v1.0-trainval"))
    data.setup("fit")
    assert names(data, "train") == ["scene-0061/CAM_FRONT", "scene-1077/CAM_FRONT"]


def test_sweeps_train_and_key_frames_are_scored(root):
    data = module(root)
    data.setup()
    drive = data.datasets["train"].drives[0]
    steps = np.diff(drive.timestamps)
    assert steps == pytest.approx([0.1, 0.1, 0.05, 0.1, 0.1, 0.05, 0.1, 0.25, 0.1], abs=1e-5)
    assert drive.gaps == {7}
    assert [frame for place, frame in data.datasets["train"].windows if place == 0] == [1, 2, 3, 4, 5, 6]
    assert [frame for place, frame in data.datasets["val"].windows if place == 0] == [6]  # 0 has no frame before it
    assert [frame for place, frame in data.datasets["test"].windows if place == 0] == [0, 6]
    slow = module(root, frames="key_frames", offsets=[-1])
    slow.setup()
    assert [frame for place, frame in slow.datasets["train"].windows if place == 0] == [1]
    assert slow.datasets["train"].drives[0].fps == pytest.approx(2)
    assert slow.datasets["train"].drives[0].numbering != drive.numbering
    assert protocol(data.protocol).accepts(data.ground_truth)


def test_conditions_come_from_descriptions(root):
    data = module(root, conditions=["night"], test_cameras=["CAM_BACK"])
    data.setup_split("train")
    assert names(data, "train") == ["scene-1077/CAM_FRONT"]
    assert data.datasets["train"].drives[0].condition == "night"
    data = module(root, conditions=["rain", "clear"], test_cameras=["CAM_BACK"])
    data.setup("test")
    assert {drive.name: drive.condition for drive in data.datasets["test"].drives} == {
        "scene-0103/CAM_BACK": "clear",
        "scene-0916/CAM_BACK": "rain",
    }


def test_intrinsics_and_poses_come_back(root):
    data = module(root)
    data.setup("test")
    drive = data.datasets["test"].drives[0]
    K = np.array(set_trees.NUSCENES_K)
    K[:2, 2] += 0.5
    K[:2] /= 10  # images a tenth as large
    K[:2, 2] -= 0.5
    np.testing.assert_allclose(drive.intrinsics(0), K)
    assert drive.path(6).name == "scene-0103__CAM_FRONT__1532402987500000.jpg"
    assert drive.image(6).shape == (90, 160, 3)
    assert drive.distance(0, 6) == pytest.approx(2.5, abs=0.2)  # 5 m/s for half a second, and the turn of the car
    assert drive.camera_height == pytest.approx(1.51095763913)
    # the car heads 0.3 rad to the left, and its front camera within a degree of that
    assert drive.pose(0)[:3, 2] == pytest.approx([np.cos(0.3), np.sin(0.3), 0], abs=0.02)


@pytest.mark.parametrize("frame", [0, 6])
def test_depth_is_the_scan_seen_from_where_the_image_was_taken(root, frame):
    data = module(root)
    data.setup("test")
    depth = data.datasets["test"].drives[0].depth(frame)
    assert depth.shape == (900, 1600)
    expected = {(round(y), round(x)): z for x, y, z in OFFICIAL[frame]}
    found = {tuple(place): depth[tuple(place)] for place in np.argwhere(depth).tolist()}
    assert found == pytest.approx(expected, rel=1e-6)
    assert data.datasets["test"].drives[0].depth(1) is None  # sweeps have none


def test_what_is_missing_is_said(root, tmp_path):
    with pytest.raises(ConfigError, match=r"cameras is 'front'"):
        module(root, cameras=["front"])
    with pytest.raises(DataError, match=r"no 'v1.0-trainval/scene.json' at"):
        module(root, version="v1.0-trainval").setup("fit")
    shutil.copytree(root / "v1.0-mini", tmp_path / "v1.0-mini")
    with pytest.raises(DataError, match=r"none of the images of the 2 train scenes .*blobs"):
        module(tmp_path).setup("fit")
    shutil.copytree(root / "samples", tmp_path / "samples")
    with pytest.raises(DataError, match=r"no sweeps.*data.frames=key_frames"):
        module(tmp_path).setup("fit")
    data = module(tmp_path)
    data.setup("test")
    next((tmp_path / "samples" / "CAM_FRONT").glob("scene-0103*")).unlink()
    data = module(tmp_path)
    data.setup("test")
    assert "1 missing" in data.summary("test")
    shutil.rmtree(tmp_path / "samples" / "LIDAR_TOP")
    with pytest.raises(DataError, match=r"'test' has no usable frame .*without ground truth"):
        module(tmp_path).setup("test")
    table = tmp_path / "v1.0-mini" / "ego_pose.json"
    table.write_text(table.read_text()[:-40])
    with pytest.raises(DataError, match=r"ego_pose.json cannot be read as a JSON list"):
        module(tmp_path).setup("test")
    table.write_text(json.dumps([]))
    with pytest.raises(DataError, match=r"ego_pose.json lacks 48 of the 48 poses"):
        module(tmp_path).setup("test")
