from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from saunet.data.drive import Drive
from saunet.data.kitti.odometry import OdometrySequence, find_root
from saunet.errors import ConfigError, DataError
from saunet.registry import datamodules


@pytest.fixture
def root(tmp_path):
    """Two sequences of ten frames: the color camera stands 0.5 m right of camera 0, the car drives 1 m a frame."""
    for sequence in ("00", "09"):
        for camera in (0, 2):
            folder = tmp_path / "sequences" / sequence / f"image_{camera}"
            folder.mkdir(parents=True)
            for frame in range(10):
                cv2.imwrite(str(folder / f"{frame:06d}.png"), np.full((20, 60), 20 * frame, np.uint8))
        (tmp_path / "sequences" / sequence / "calib.txt").write_text(
            "P0: 50 0 30 0 0 50 10 0 0 0 1 0\nP2: 50 0 30 -25 0 50 10 0 0 0 1 0\n"
        )
    (tmp_path / "poses").mkdir()
    rows = [f"1 0 0 0 0 1 0 0 0 0 1 {frame}" for frame in range(10)]
    (tmp_path / "poses" / "00.txt").write_text("\n".join(rows) + "\n")
    return tmp_path


def module(root, **options):
    defaults = {"train_sequences": ["00"], "test_sequences": ["09"], "val_share": 0.2, "batch_size": 2, "workers": 0}
    return datamodules.build("kitti_odometry", root=str(root), height=10, width=30, **{**defaults, **options})


def test_sequence(root):
    drive = OdometrySequence(root, "00")
    assert isinstance(drive, Drive)
    assert drive.name == "odometry/00 l"
    assert list(drive.indices) == list(range(10))
    assert drive.image(3).shape == (20, 60, 3)
    assert drive.intrinsics(0).tolist() == [[50, 0, 29], [0, 50, 9], [0, 0, 1]]
    assert drive.depth(0) is None
    assert drive.pose(3)[:3, 3].tolist() == [0.5, 0, 3]  # right of camera 0
    assert OdometrySequence(root, "00", "gray_left").pose(3)[:3, 3].tolist() == [0, 0, 3]
    assert OdometrySequence(root, "09").pose(3) is None


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ("0 0 0 0 0 0 0 0 0 0 0 0", r"P2 has K .*; expected \[\[fx, skew, cx\]"),
        ("0 0 30 -25 0 0 10 0 0 0 1 0", "the lengths must be positive"),
        ("-50 0 300 -25 0 50 300 0 0 0 1 0", "the lengths must be positive"),
        ("100 0 60 -50 0 100 20 0 0 0 1 0", "the center must lie inside"),  # of images twice as large
    ],
)
def test_a_k_that_does_not_belong_to_the_images_is_named(root, numbers, message):
    calibration = root / "sequences" / "00" / "calib.txt"
    calibration.write_text(calibration.read_text().replace("50 0 30 -25 0 50 10 0 0 0 1 0", numbers))
    with pytest.raises(DataError, match=rf"sequences.00.calib\.txt: {message}" if "P2" in message else message):
        module(root).setup("fit")


def test_a_bad_first_frame_decides_nothing_and_odd_frames_are_named_or_skipped(root):
    images = root / "sequences" / "00" / "image_2"
    (images / "000000.png").write_bytes(b"")
    for number in (5, 6, 7):  # neighbors of one size, which is not that of the calibration
        cv2.imwrite(str(images / f"{number:06d}.png"), np.zeros((12, 30), np.uint8))
    data = module(root, val_share=0.0)
    data.setup("fit")
    with pytest.raises(DataError, match=r"image_2.00000\d\.png is (empty|30x12 .* the frames of 'odometry/00 l' are)"):
        list(data.train_dataloader())
    skipping = module(root, val_share=0.0, on_error="skip")
    skipping.setup("fit")
    with pytest.warns(UserWarning, match="sample skipped"):
        list(skipping.train_dataloader())
    assert len(skipping.skipped()) == 6  # 1; 4 to 8
    assert len(skipping.datasets["train"]) == 8


def test_root_is_found_around_the_sequences(root):
    for given in (root, root / "sequences", root.parent / root.name):
        assert find_root(given) == root
    with pytest.raises(DataError, match=r"no folder 'sequences' at"):
        find_root(root / "poses" / "x")


def test_batches_with_motion(root):
    data = module(root, with_pose=True, test_sequences=["00"])
    data.setup()
    batch = data.on_after_batch_transfer(next(iter(data.test_dataloader())), 0)
    assert batch["name"][0] == "odometry/00 0000000001 l"
    assert batch["sources"].shape == (2, 2, 3, 10, 30)
    assert batch["T_src_tgt"][0, :, 2, 3].tolist() == [1, -1]
    assert len(data.datasets["train"]) == 5  # 1 to 5; 6 and 7 are the gap
    assert len(data.datasets["val"]) == 1
    assert data.usage["train"][0].left_out == {
        "between training and validation": 2,
        "without pose": 0,
        "without neighbor": 1,
    }


def test_without_poses_motion_is_left_out_and_counted(root):
    data = module(root, with_pose=True)
    with pytest.raises(DataError, match=r"split 'test' has no usable frame .*10 without pose"):
        data.setup("test")
    (root / "poses" / "00.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 5)
    short = module(root, with_pose=True, val_share=0.0)
    short.setup("fit")
    assert len(short.datasets["train"]) == 3
    assert short.usage["train"][0].left_out == {
        "between training and validation": 0,
        "without pose": 6,
        "without neighbor": 1,
    }
    assert short.val_dataloader() == []


def test_without_motion_poses_are_not_needed(root):
    data = module(root)
    data.setup()
    assert len(data.datasets["test"]) == 8
    assert len(data.datasets["predict"]) == 10


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"test_sequences": ["21"]}, DataError, r"no sequence '21' at .*sequences there: 00, 09"),
        ({"camera": "color_right"}, DataError, r"image_3 holds no images; cameras .*: gray_left, color_left"),
        ({"val_share": 2.0}, ConfigError, r"val_share is 2.0"),
        ({"root": "/nowhere"}, DataError, r"no folder 'sequences' at /nowhere"),
    ],
)
def test_wrong_settings_are_one_sentence(root, options, error, message):
    with pytest.raises(error, match=message):
        module(**{"root": root, **options}).setup()


def test_malformed_files_are_named(root):
    (root / "poses" / "09.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n1 2 3\n")
    with pytest.raises(DataError, match=r"09.txt, line 2: expected 12 finite numbers \(a 3 x 4 .*\), got '1 2 3'"):
        OdometrySequence(root, "09")
    (root / "poses" / "09.txt").write_text("a " * 12)
    with pytest.raises(DataError, match=r"09.txt, line 1"):
        OdometrySequence(root, "09")
    (root / "poses" / "09.txt").write_text("\n")
    with pytest.raises(DataError, match=r"09.txt has no pose"):
        OdometrySequence(root, "09")
    (root / "sequences" / "00" / "calib.txt").write_text("P0: 50 0 30 0 0 50 10 0 0 0 1 0\n")
    with pytest.raises(DataError, match=r"calib.txt lacks P2"):
        OdometrySequence(root, "00")


def test_real_sequence(kitti_mini):
    data = module(
        kitti_mini / "odometry", train_sequences=["06"], test_sequences=["06"], camera="gray_left", with_pose=True
    )
    data.setup()
    assert len(data.datasets["test"]) == 49
    sample = data.datasets["test"][0]
    assert sample["T_src_tgt"][1, 2, 3] == pytest.approx(-1.185, abs=0.02)  # forward in 0.1 s
    assert sample["K"][0, 0] == pytest.approx(707.0912 * 30 / 1226)
    assert torch.equal(sample["frames"][0, 0], sample["frames"][0, 2])


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("3 0 0 0 0 3 0 0 0 0 3 1", "not a rotation"),
        ("0 0 0 0 0 0 0 0 0 0 0 1", "not a rotation"),
        ("-1 0 0 0 0 1 0 0 0 0 1 1", "reflection"),
    ],
)
def test_poses_whose_rotation_is_none_are_refused(root, row, message):
    (root / "poses" / "09.txt").write_text(f"1 0 0 0 0 1 0 0 0 0 1 0\n{row}\n")
    with pytest.raises(DataError, match=rf"09\.txt, line 2.*{message}"):
        OdometrySequence(root, "09")


def test_resized_copies_have_a_k_of_their_size_and_cropped_ones_are_refused(root):
    folder = root / "sequences" / "00"
    real = "718.856 0 607.1928 45.38 0 718.856 185.2157 -0.11 0 0 1 0.0038"
    (folder / "calib.txt").write_text(f"P0: {real}\nP2: {real}\n")
    images = sorted((folder / "image_2").iterdir())
    for path in images:
        cv2.imwrite(str(path), np.zeros((188, 620, 3), np.uint8))
    K = OdometrySequence(root, "00").intrinsics(0)
    assert K[0, 0] == pytest.approx(718.856 * 620 / 1241)
    assert K[1, 1] == pytest.approx(718.856 * 188 / 376)
    assert K[0, 2] == pytest.approx((606.1928 + 0.5) * 620 / 1241 - 0.5)
    for path in images:
        cv2.imwrite(str(path), np.zeros((188, 1241, 3), np.uint8))
    with pytest.raises(DataError, match=r"188x1241 .*calib\.txt is for 376x1241"):
        OdometrySequence(root, "00")


def test_copies_of_every_camera_and_real_size_scale_k_alike(root):
    folder = root / "sequences" / "00"
    for center, size in (
        ((607.1928, 185.2157), (376, 1241)),
        ((609.5593, 172.854), (375, 1242)),
        ((601.8873, 183.1104), (370, 1226)),
    ):
        real = f"700 0 {center[0]} 0 0 700 {center[1]} 0 0 0 1 0"
        (folder / "calib.txt").write_bytes(b"\xef\xbb\xbf" + f"P0: {real}\nP2: {real}\n".encode())  # with a BOM
        for camera in (0, 2):
            for path in (folder / f"image_{camera}").iterdir():
                cv2.imwrite(str(path), np.zeros((192, 640), np.uint8))
        for camera in ("gray_left", "color_left"):
            K = OdometrySequence(root, "00", camera).intrinsics(0)
            assert K[0].tolist() == pytest.approx([700 * 640 / size[1], 0, (center[0] - 0.5) * 640 / size[1] - 0.5])
            assert K[1].tolist() == pytest.approx([0, 700 * 192 / size[0], (center[1] - 0.5) * 192 / size[0] - 0.5])


def test_broken_times_are_named_with_their_line(root):
    (root / "sequences" / "00" / "times.txt").write_text("0.0\n0.1\nnan\n")
    with pytest.raises(DataError, match=r"times\.txt, line 3: expected seconds"):
        OdometrySequence(root, "00")
