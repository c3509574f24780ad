"""KITTI-360: its true calibration; numbers that kitti360Scripts 1.0.0 gives on the same files."""

from __future__ import annotations

import shutil

import cv2
import numpy as np
import pytest
import set_trees

from saunet.data.sets import kitti_360
from saunet.errors import ConfigError, DataError
from saunet.metrics.protocols import protocol
from saunet.registry import datamodules

OFFICIAL_POSE = [  # CameraPerspective(...).cam2world[4.0] of image_00
    [-0.705111042, -0.02610952, 0.708616083, 3644.276622304],
    [-0.70909704, 0.024700339, -0.70467846, 1707.084148154],
    [0.000896077, -0.999354116, -0.035929914, 122.80910326],
    [0, 0, 0, 1],
]
OFFICIAL_DEPTH = {  # project_vertices: (row, column) -> depth
    "perspective_left": {(229, 696): 11.222011156, (174, 867): 28.620468319},
    "perspective_right": {(225, 658): 11.213523697, (170, 845): 28.748605784},
}


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return set_trees.kitti_360(tmp_path_factory.mktemp("kitti_360"), fisheye=True)


def module(root, **options):
    small = {"height": 32, "width": 96, "workers": 0, "batch_size": 2, "train_sequences": ["0003"]}
    return datamodules.build("kitti_360", root=str(root), **{**small, **options})


def test_the_sequences_are_those_with_poses():
    """Of the 11 sequences 0008 and 0018 are the benchmarks' test set, without poses (cvlibs.net/datasets/kitti-360)."""
    sequences = (*kitti_360.TRAIN, *kitti_360.VAL, *kitti_360.TEST)
    assert sorted(sequences) == ["0000", "0002", "0003", "0004", "0005", "0006", "0007", "0009", "0010"]


def test_windows_and_poses_of_some_frames(root):
    data = module(root)
    data.setup()
    assert {split: len(dataset) for split, dataset in data.datasets.items()} == {
        "train": 4,
        "val": 1,
        "test": 3,
        "predict": 3,
    }
    (drive,) = data.datasets["train"].drives
    assert drive.name == "2013_05_28_drive_0003_sync l"
    assert list(drive.indices) == [2, 3, 4, 5, 6, 7]
    assert [drive.pose(index) is None for index in drive.indices] == [True, False, False, False, False, True]
    posed = module(root, with_pose=True)
    posed.setup("fit")
    assert [frame for _, frame in posed.datasets["train"].windows] == [4, 5]
    assert "4 without pose" in posed.summary("train")
    assert drive.fps == pytest.approx(10)
    assert drive.time(3) - drive.time(2) == pytest.approx(0.1, abs=1e-6)
    assert protocol(data.protocol).accepts(data.ground_truth)


def test_poses_are_those_of_the_rectified_camera(root):
    data = module(root)
    data.setup("fit")
    drive = data.datasets["train"].drives[0]
    np.testing.assert_allclose(drive.pose(4), OFFICIAL_POSE, atol=1e-6)  # printed with nine digits, R_rect with six
    K = np.array([[552.554261, 0, 682.049453], [0, 552.554261, 238.769549], [0, 0, 1]])
    K[:2, 2] += 0.5
    K[:2] /= 4  # images a quarter as large
    K[:2, 2] -= 0.5
    np.testing.assert_allclose(drive.intrinsics(4), K)


@pytest.mark.parametrize("camera", ["perspective_left", "perspective_right"])
def test_scans_become_depth(root, camera):
    data = module(root, cameras=[camera])
    data.setup("fit")
    depth = data.datasets["train"].drives[0].depth(4)
    assert depth.shape == (376, 1408)
    assert {tuple(place): depth[tuple(place)] for place in np.argwhere(depth).tolist()} == pytest.approx(
        OFFICIAL_DEPTH[camera], rel=1e-6
    )


def test_the_pair_is_rectified(root):
    data = module(root, stereo=True)
    data.setup("fit")
    T = data.datasets["train"][0]["T_stereo_tgt"].numpy()
    np.testing.assert_allclose(T, set_trees.motion(np.eye(3), (-328.318735 / 552.554261, 0, 0)), atol=1e-7)


def test_fisheye_images_are_straightened_and_their_depth_is_z(root):
    data = module(root, cameras=["fisheye_left"], val_sequences=["0006"], height=32, width=32)
    data.setup("fit")
    drive = data.datasets["train"].drives[0]
    K = drive.intrinsics(4)
    assert np.degrees(np.arctan(drive.frame_size[1] / 2 / K[0, 0])) == pytest.approx(60, abs=0.1)  # 120 of 180 degrees
    # CameraFisheye sees one of the points inside the picture, at [2.8696, 0.2259, 8.3736] in the camera's frame, and
    # calls its distance of 8.8545 m depth
    point = np.array([2.869569989, 0.225937008, 8.373619829])
    u, v, _ = np.round(K @ point / point[2]).astype(int)
    depth = drive.depth(4)
    assert np.argwhere(depth).tolist() == [[v, u]]
    assert depth[v, u] == pytest.approx(point[2])
    assert np.linalg.norm(point) == pytest.approx(8.854546204)


def test_a_straight_fisheye_pixel_shows_what_the_lens_saw_there(root):
    data = module(root, cameras=["fisheye_left"], height=32, width=32)
    data.setup("fit")
    drive = data.datasets["train"].drives[0]
    # CameraFisheye puts that point at (854.081, 716.558) of 1400 pixels, without p1 and p2; these are a tenth as large
    shown = drive.image(4)[71, 85].astype(int)
    recorded = cv2.cvtColor(cv2.imread(str(drive.path(4))), cv2.COLOR_BGR2RGB)
    column, row = (854.08 + 0.5) / 10 - 0.5, (716.56 + 0.5) / 10 - 0.5
    seen = cv2.getRectSubPix(recorded, (1, 1), (column, row))[0, 0].astype(int)
    assert np.abs(shown - seen).max() <= 6  # the pixel's ray passes 0.2 pixels from that point


def test_what_is_missing_is_said(root, tmp_path):
    with pytest.warns(UserWarning, match=r"6 of 7 train sequences are missing, the first .*drive_0000_sync"):
        module(root, train_sequences=kitti_360.TRAIN).setup("fit")
    with pytest.raises(DataError, match=r"1 of 1 test sequences are missing.*name existing ones"):
        module(root, test_sequences=["0018"]).setup("test")
    with pytest.raises(ConfigError, match=r"cameras is 'left'"):
        module(root, cameras=["left"])
    shutil.copytree(root / "data_2d_raw", tmp_path / "data_2d_raw")
    with pytest.raises(DataError, match=r"no calibration at .*calib_cam_to_pose.txt"):
        module(tmp_path).setup("fit")
    shutil.copytree(root / "calibration", tmp_path / "calibration")
    with pytest.raises(DataError, match=r"'train' has no usable frame .*without pose"):
        module(tmp_path, with_pose=True).setup("fit")
    with pytest.raises(DataError, match=r"'test' has no usable frame .*3 without ground truth"):
        module(tmp_path).setup("test")
    with pytest.raises(DataError, match=r"target_depth is true but no training frame"):
        module(tmp_path, target_depth=True).setup("fit")
    (tmp_path / "calibration" / "calib_cam_to_velo.txt").write_text("1 2 3\n")
    with pytest.raises(DataError, match=r"calib_cam_to_velo.txt, line 1: expected the numbers T\[0,0\] .* got '1 2 3'"):
        module(tmp_path).setup("fit")
