"""DDAD: scenes in DGP's json files; depth moved from the scan's moment to the image's; masks of the own car."""

from __future__ import annotations

import json
import shutil

import cv2
import numpy as np
import pytest
import set_trees

from saunet.data.sets.ddad import SPLITS
from saunet.errors import ConfigError, DataError
from saunet.metrics.protocols import protocol
from saunet.registry import datamodules


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return set_trees.ddad(tmp_path_factory.mktemp("ddad"))


def module(root, **options):
    small = {"height": 40, "width": 64, "workers": 0, "batch_size": 2}
    return datamodules.build("ddad", root=str(root), **{**small, **options})


def test_scenes_cameras_and_windows(root):
    data = module(root, cameras=["CAMERA_05", "camera_01"])
    data.setup()
    assert [drive.name for drive in data.datasets["train"].drives] == ["000000/camera_05", "000000/camera_01"]
    assert [drive.name for drive in data.datasets["test"].drives] == ["000150/camera_01"]
    assert len(data.datasets["train"]) == 2 * 3
    assert len(data.datasets["test"]) == 5
    assert protocol(data.protocol).accepts(data.ground_truth)
    # TRI's README: 150 scenes to train and 50 to validate; 0 is train and 1 is val in ddad.json (dgp's dataset.proto)
    assert SPLITS == {"train": "0", "val": "1", "test": "1", "predict": "1"}


def test_intrinsics_poses_and_times_come_back(root):
    data = module(root)
    data.setup("fit")
    (drive,) = data.datasets["train"].drives
    np.testing.assert_array_equal(drive.intrinsics(0), set_trees.DDAD_K)
    assert drive.image(3)[0, 0].tolist() == [3, 0, 0]
    T_first_second = np.linalg.inv(drive.pose(1)) @ drive.pose(2)
    np.testing.assert_allclose(T_first_second, set_trees.motion(np.eye(3), (0, 0, 1)), atol=1e-12)
    assert drive.distance(0, 2) == pytest.approx(2)
    np.testing.assert_allclose(np.diff(drive.timestamps), 1)
    assert drive.timestamps[0] == pytest.approx(1568232900.3, abs=1e-6)  # 2019-09-11 20:15:00.3 UTC
    assert drive.camera_height == pytest.approx(1.5)


def test_depth_is_that_of_the_moment_of_the_image(root):
    data = module(root, target_depth=True, with_pose=True)
    data.setup()
    depth = data.datasets["test"].drives[0].depth(2)
    # scanned 12 m ahead of the car's origin; the camera is 1.7 m ahead of it, and 0.3 m farther when its image is taken
    assert np.argwhere(depth).tolist() == [[21, 31], [24, 13]]
    assert depth[21, 31] == pytest.approx(10)
    assert depth[24, 13] == pytest.approx(10)  # 3 m to the left, half a meter below the camera
    batch = data.on_after_batch_transfer(next(iter(data.train_dataloader())), 0)
    assert batch["target_depth"].max() == pytest.approx(10)
    assert batch["T_src_tgt"][:, :, 2, 3].abs().ravel().tolist() == pytest.approx([1] * 4, rel=1e-5)


def test_masks_hide_the_own_car(root, tmp_path):
    mask = np.full((20, 32), 255, np.uint8)
    mask[:, :8] = 0  # a quarter of the width, of a mask half as large
    for name in ("CAMERA_05_mask.png", "000150/CAMERA_05_mask.png", "CAMERA_05/000150/mask.png"):
        masks = tmp_path / name.replace("/", "_")
        (masks / name).parent.mkdir(parents=True)
        cv2.imwrite(str(masks / name), mask)
        data = module(root, masks=str(masks), test_cameras=["camera_05", "camera_01"])
        data.setup("test")
        hidden, front = data.datasets["test"].drives
        assert np.argwhere(hidden.depth(0)).tolist() == [[21, 31]]
        assert np.count_nonzero(front.depth(0)) == 2
        assert hidden.depth_key(0) != front.depth_key(0)
    everywhere = str(tmp_path / "CAMERA_05_mask.png")
    data = module(root, masks=everywhere, cameras=["camera_01", "camera_05"], flip_prob=1.0, crop_margin=0.0)
    data.setup("fit")
    assert data.datasets["val"].with_mask is False  # the front camera alone
    batch = data.on_after_batch_transfer(next(iter(data.train_dataloader())), 0)
    assert batch["target_mask"].shape == (2, 1, 40, 64)
    for name, shown in zip(batch["name"], batch["target_mask"], strict=True):
        columns = shown[0].mean(0).tolist()  # mirrored, so that the car is at the right
        assert columns == [1.0] * 48 + [0.0 if "camera_05" in name else 1.0] * 16
    with pytest.raises(DataError, match=r"no mask of CAMERA_05 in scene 000150"):
        module(root, masks=str(tmp_path), test_cameras=["camera_05"]).setup("test")


def test_what_is_missing_is_said(root, tmp_path):
    with pytest.raises(ConfigError, match=r"cameras is 'camera_1'"):
        module(root, cameras=["camera_1"])
    shutil.copytree(root, tmp_path, dirs_exist_ok=True)
    index = json.loads((tmp_path / "ddad.json").read_text())
    index["scene_splits"]["0"]["filenames"] += ["000001/scene_a.json", "000002/scene_b.json"]
    (tmp_path / "ddad.json").write_text(json.dumps(index))
    with pytest.warns(UserWarning, match=r"2 of 3 scenes that ddad.json lists for train are missing"):
        module(tmp_path).setup("fit")
    (tmp_path / "000150" / "rgb" / "CAMERA_01" / "4.png").unlink()
    data = module(tmp_path)
    data.setup("test")
    assert "1 missing" in data.summary("test")
    shutil.rmtree(tmp_path / "000150")
    with pytest.raises(DataError, match=r"1 of 1 scenes that ddad.json lists for test .*unpack DDAD.tar"):
        module(tmp_path).setup("test")


def test_a_broken_scene_is_named(tmp_path):
    root = set_trees.ddad(tmp_path, ("CAMERA_01",))
    scene = root / "000000" / "scene_beef.json"
    scene.write_text(scene.read_text().replace('"qw"', '"w"'))
    with pytest.raises(DataError, match=r"scene_beef.json: lidar of sample 0 has rotation .*unit quaternion"):
        module(root).setup("fit")
    scene.write_text(scene.read_text().replace('"pose"', '"position"'))
    with pytest.raises(DataError, match=r"scene_beef.json is not a scene of DDAD .*'pose'"):
        module(root).setup("fit")
