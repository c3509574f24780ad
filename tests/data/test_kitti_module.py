from __future__ import annotations

import pytest
import torch
from jaxtyping import TypeCheckError
from kitti_tree import make_drive, name

from saunet.data.loading.windows import fingerprint
from saunet.errors import ConfigError, DataError
from saunet.registry import datamodules


def module(root, **options):
    small = {"height": 10, "width": 30, "batch_size": 2, "workers": 0, "split": "all"}
    return datamodules.build("kitti", root=str(root), **{**small, **options})


def names(data, split):
    dataset = data.datasets[split]
    return [dataset.name(index) for index in range(len(dataset))]


def test_everything_found_is_divided_without_overlap(tmp_path):
    for number in range(3):
        make_drive(tmp_path, number, frames=range(20), scans=number == 1)
    data = module(tmp_path)
    data.setup()
    assert len(names(data, "train")) == 3 * 2 * 15  # 1 to 15; 16 and 17 are the gap, 18 and 19 the held-out tail
    assert len(names(data, "val")) == 3 * 2 * 1
    assert len(names(data, "test")) == 2 * 2  # one drive has scans
    assert len(names(data, "predict")) == 3 * 2 * 2
    assert "left out: 12 between training and validation, 6 without neighbor" in data.summary("train")
    assert "left out: 8 without ground truth" in data.summary("test")
    shared = {n[:-2] for n in names(data, "train")} & {n[:-2] for n in names(data, "val")}
    assert not shared


def test_named_drives_are_held_out(tmp_path):
    for number in range(3):
        make_drive(tmp_path, number)
    data = module(tmp_path, val_drives=["2011_09_26_drive_0001_sync"], cameras=["left"])
    data.setup()
    assert {n.split()[0] for n in names(data, "val")} == {name(1)}
    assert {n.split()[0] for n in names(data, "train")} == {name(0), name(2)}
    assert len(names(data, "test")) == 6


def test_named_split_uses_what_is_there(tmp_path):
    make_drive(tmp_path, 1, frames=range(6))  # an Eigen training drive
    make_drive(tmp_path, 2, frames=range(7))  # an Eigen test drive
    make_drive(tmp_path, 5, frames=range(6))  # an Eigen training drive that is held out
    data = module(tmp_path, split="eigen_zhou_by_drive")
    data.setup("fit")
    data.setup("test")
    assert len(names(data, "train")) == len(names(data, "val")) == 2 * 4
    assert names(data, "test") == [f"{name(2)} {number:010d} l" for number in (3, 0, 6)]  # in the list's order
    assert data.fingerprints()["test"] == fingerprint(names(data, "test"))


def test_users_lists(tmp_path):
    make_drive(tmp_path / "raw", 1)
    (tmp_path / "lists").mkdir()
    for part, frames in {"train": [1, 2], "val": [3, 9], "test": [0, 5]}.items():
        (tmp_path / "lists" / f"{part}_files.txt").write_text("".join(f"{name(1)} {frame} l\n" for frame in frames))
    data = module(tmp_path / "raw", split=str(tmp_path / "lists"))
    data.setup()
    assert len(names(data, "train")) == 2
    assert names(data, "val") == [f"{name(1)} 0000000003 l"]
    assert "left out: 1 missing" in data.summary("val")
    assert len(names(data, "test")) == 2
    single = module(tmp_path / "raw", split=str(tmp_path / "lists" / "train_files.txt"), val_share=0.5, offsets=[1])
    single.setup("validate")
    assert names(single, "val") == [f"{name(1)} 0000000002 l"]


def test_batches_carry_truth_and_target_depth(tmp_path):
    make_drive(tmp_path, 1, frames=range(20))
    data = module(tmp_path, target_depth=True, test_split="all", depth="lidar_x")
    assert data.protocol == "eigen_lidar_x"
    data.setup()
    train = data.on_after_batch_transfer(next(iter(data.train_dataloader())), 0)
    assert train["target_depth"].shape == (2, 1, 10, 30)
    assert train["target_depth"].max() > 9
    assert data.datasets["train"].drives[0].depth_kind == "camera_z"
    test = data.on_after_batch_transfer(next(iter(data.test_dataloader())), 0)
    assert test["depth"].shape == (2, 1, 20, 60)
    assert len(names(data, "test")) == 40


def test_speed_becomes_the_way_traveled(tmp_path):
    make_drive(tmp_path, 1, frames=range(12))
    with pytest.raises(DataError, match=r"with_speed is true but no training frame .* has an OXTS record"):
        module(tmp_path, with_speed=True).setup("fit")
    records = tmp_path / name(1) / "oxts" / "data"
    records.mkdir(parents=True)
    for frame in range(12):
        (records / f"{frame:010d}.txt").write_text(" ".join(["0"] * 8 + ["8"] + ["0"] * 21))
    data = module(tmp_path, with_speed=True)
    data.setup("fit")
    batch = data.on_after_batch_transfer(next(iter(data.train_dataloader())), 0)
    torch.testing.assert_close(batch["distance"], torch.full((2, 2), 8 * 0.1037))


@pytest.mark.parametrize(
    ("depth", "protocol"),
    [("camera_z", "eigen_camera_z"), ("lidar_x", "eigen_lidar_x"), ("improved", "eigen_improved")],
)
def test_ground_truth_names_its_protocol(tmp_path, depth, protocol):
    from saunet.metrics.protocols import protocol as named

    data = module(tmp_path, depth=depth)
    assert data.protocol == protocol
    assert named(protocol).accepts(data.ground_truth)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        (
            {"split": "eigen_zohu_by_drive"},
            ConfigError,
            r"split is .*did you mean 'eigen_zhou_by_drive'.*existing file",
        ),
        ({"test_split": "eigen_tset"}, ConfigError, r"test_split is .*did you mean 'eigen_test'"),
        ({"cameras": ["center"]}, ConfigError, r"cameras is 'center'"),
        ({"cameras": []}, ConfigError, r"cameras is empty"),
        ({"depth": "stereo"}, ConfigError, r"depth is 'stereo'|parameter depth="),
        ({"val_share": 1.5}, ConfigError, r"val_share is 1.5"),
        ({"split": "eigen_full"}, DataError, r"none of the 27 drives of the train split is below .*data.split=all"),
        ({"val_drives": ["x"]}, ConfigError, r"no drive 'x' to hold out"),
        ({"offsets": [-9, 9]}, DataError, r"split 'train' has no usable frame"),
        ({"target_depth": True, "depth": "improved"}, DataError, r"target_depth is true but no training frame"),
        ({"root": "/nowhere"}, DataError, r"no data root at /nowhere"),
    ],
)
def test_wrong_settings_are_one_sentence(tmp_path, options, error, message):
    make_drive(tmp_path, 9100, frames=range(12))
    with pytest.raises((error, TypeCheckError), match=message):
        module(**{"root": tmp_path, **options}).setup()


def test_drives_without_images_are_named(tmp_path):
    make_drive(tmp_path, 1, frames=[])
    with pytest.raises(DataError, match=r"hold no images, such as .*drive_0001_sync"):
        module(tmp_path).setup("fit")


def test_truth_that_nobody_has_is_named(tmp_path):
    make_drive(tmp_path, 1, frames=range(12), scans=False)
    with pytest.raises(DataError, match=r"split 'test' has no usable frame .*without ground truth"):
        module(tmp_path).setup("test")


def test_a_broken_frame_is_named_when_it_is_read(tmp_path):
    make_drive(tmp_path, 1, frames=range(20), sides=(2,))
    (tmp_path / name(1) / "image_02" / "data" / "0000000005.png").write_bytes(b"")
    data = module(tmp_path)
    data.setup("fit")
    with pytest.raises(DataError, match=r"0000000005.png is empty"):
        list(data.train_dataloader())


def test_a_bad_first_frame_is_skipped_and_no_other(tmp_path):
    for number in (1, 2):
        drive = make_drive(tmp_path, number)
        (drive / "image_02" / "data" / "0000000000.png").write_bytes(b"")
    data = module(tmp_path, val_drives=[name(2)], cameras=["left"], on_error="skip")
    with pytest.warns(UserWarning, match=r"frame left out: .*0000000000\.png is empty"):
        data.setup("fit")
    with pytest.warns(UserWarning, match=r"sample skipped: .*0000000000\.png is empty"):
        list(data.train_dataloader())
    assert data.skipped() == [f"{name(1)} 0000000001 l"]
    assert names(data, "val") == [f"{name(2)} {number:010d} l" for number in (2, 3, 4)]


def test_real_frames(kitti_mini):
    data = module(kitti_mini, height=96, width=320, test_split="all", target_depth=True)
    data.setup()
    assert len(names(data, "train")) == 58
    assert len(names(data, "val")) == 6
    assert len(names(data, "test")) == 24  # one of the two drives has scans
    train = data.on_after_batch_transfer(next(iter(data.train_dataloader())), 0)
    assert train["K"][0, 0, 0] == pytest.approx(721.5377 * round(320 * 1.05) / 1242, rel=1e-5)
    test = data.on_after_batch_transfer(next(iter(data.test_dataloader())), 0)
    assert test["target"].shape == (2, 3, 96, 320)
    assert test["K"][0, 0, 2] == pytest.approx((608.5593 + 0.5) * 320 / 1242 - 0.5)
    assert test["K"][0, 1, 1] == pytest.approx(721.5377 * 96 / 375)
    depth = test["depth"]
    assert depth.shape == (2, 1, 375, 1242)
    known = depth[depth > 0]
    assert 0.02 < known.numel() / depth.numel() < 0.06
    assert known.min() > 1
    assert 5 < known.median() < 25
    assert known.max() < 125
    assert (depth[:, :, :100] > 0).sum() < 0.02 * known.numel()  # the scanner hardly looks up
    lower, middle = depth[:, :, 300:], depth[:, :, 170:200]
    assert lower[lower > 0].median() < middle[middle > 0].median()  # the road is near below, the scene far above


def test_real_drive_held_out(kitti_mini):
    data = module(kitti_mini, val_drives=["2011_09_26_drive_9015_sync"])
    data.setup()
    assert [len(names(data, split)) for split in ("train", "val", "test")] == [46, 22, 24]
    assert torch.equal(data.datasets["val"][0]["frames"], data.datasets["val"][0]["frames"])
