from __future__ import annotations

import cv2
import numpy as np
import pytest
from drives import NumberDrive
from kitti_tree import make_drive, name

from saunet.data.kitti.files import oxts_speed
from saunet.data.kitti.raw import KittiRaw
from saunet.data.loading.selecting import median_flow, static_by_flow
from saunet.errors import DataError
from saunet.registry import datamodules


def texture(shift=0):
    noise = np.random.default_rng(0).integers(0, 256, (40, 120, 3), dtype=np.uint8)
    picture = cv2.GaussianBlur(cv2.resize(noise, (360, 120), interpolation=cv2.INTER_CUBIC), (0, 0), 2)
    return np.roll(picture, shift, 1)[:, 20:340].copy()


@pytest.mark.parametrize("shift", [0, 1, 3])
def test_median_flow_is_the_shift(shift):
    assert median_flow(texture(), texture(shift)) == pytest.approx(shift, abs=0.2)


def test_flow_is_measured_at_one_width():
    double = [cv2.resize(texture(shift), None, fx=2, fy=2) for shift in (0, 3)]
    assert median_flow(*double) == pytest.approx(3, abs=0.3)


def test_standing_frames_are_found():
    drive = NumberDrive(indices=range(8))
    place = [0, 0, 3, 6, 6, 6, 9, 12]
    drive.image = lambda index: texture(place[index])
    assert static_by_flow(drive, range(8), 0.5) == {0, 1, 4, 5}
    assert static_by_flow(drive, [4, 7], 0.5) == {4}


def record(path, vf):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(" ".join(map(str, [49.0, 8.4, 116, 0, 0, 0, 1, 1, vf, 0.0, 0.0, *[0] * 19])))


def test_speed_comes_from_the_record(tmp_path):
    record(tmp_path / "a.txt", -3.5)
    assert oxts_speed(tmp_path / "a.txt") == 3.5
    (tmp_path / "b.txt").write_text("49.0 8.4 nothing")
    with pytest.raises(DataError, match=r"b.txt: expected the 30 numbers of an OXTS record"):
        oxts_speed(tmp_path / "b.txt")
    with pytest.raises(DataError, match="cannot read"):
        oxts_speed(tmp_path / "gone.txt")


@pytest.mark.parametrize(("static", "used"), [("keep", 10), ("speed", 7), ("flow", 0)])
def test_static_frames_are_dropped_and_counted(tmp_path, static, used):
    make_drive(tmp_path, 1, frames=range(12), sides=(2,))  # every frame is of one color: no flow anywhere
    for frame in range(12):
        record(tmp_path / name(1) / "oxts" / "data" / f"{frame:010d}.txt", 0.1 if 3 <= frame < 6 else 8.0)
    assert KittiRaw(tmp_path).drive(name(1)).speed(4) == pytest.approx(0.1)
    data = datamodules.build(
        "kitti", root=str(tmp_path), split="all", static=static, val_share=0.0, batch_size=2, workers=0
    )
    if used == 0:
        with pytest.raises(DataError, match=r"split 'train' has no usable frame .*12 static"):
            data.setup("fit")
        return
    data.setup("fit")
    assert len(data.datasets["train"]) == used
    assert data.usage["train"][0].left_out.get("static", 0) == 10 - used


def test_without_records_flow_decides(tmp_path):
    make_drive(tmp_path, 1, frames=range(4), sides=(2,))
    assert KittiRaw(tmp_path).drive(name(1)).speed(0) is None
    data = datamodules.build("kitti", root=str(tmp_path), split="all", static="speed", val_share=0.0, workers=0)
    with pytest.raises(DataError, match="4 static"):
        data.setup("fit")


def test_a_frame_that_cannot_be_read_is_named_or_passed_over(tmp_path):
    drive = NumberDrive(indices=range(8))
    place = [0, 0, 3, 6, None, 6, 6, 12]

    def image(index):
        if place[index] is None:
            raise DataError("4 is empty")
        return texture(place[index])

    drive.image = image
    with pytest.raises(DataError, match="4 is empty"):
        static_by_flow(drive, range(8), 0.5)
    assert static_by_flow(drive, range(8), 0.5, skip_unreadable=True) == {0, 1, 5, 6}


@pytest.mark.parametrize("broken", ["empty", "small"])
def test_static_frames_are_found_beside_a_bad_one(tmp_path, broken):
    drive = make_drive(tmp_path, 1, frames=range(12), sides=(2,))
    for frame in range(12):
        picture = texture(3 * frame if frame != 4 else 9)[:20, :60]  # frame 4 is frame 3 again
        cv2.imwrite(str(drive / "image_02" / "data" / f"{frame:010d}.png"), picture)
    bad = drive / "image_02" / "data" / "0000000008.png"
    bad.write_bytes(b"")
    if broken == "small":
        cv2.imwrite(str(bad), texture()[:7, :30])
    options = {"root": str(tmp_path), "split": "all", "val_share": 0.0, "cameras": ["left"], "static": "flow"}
    options |= {"height": 10, "width": 30, "batch_size": 2, "workers": 0}
    with pytest.raises(DataError, match=r"0000000008\.png is (empty|30x7)"):
        datamodules.build("kitti", **options).setup("fit")
    data = datamodules.build("kitti", **options, on_error="skip")
    data.setup("fit")
    assert data.usage["train"][0].left_out["static"] == 1
    with pytest.warns(UserWarning, match=r"sample skipped: .*0000000008\.png is (empty|30x7)"):
        list(data.train_dataloader())
    assert [each.split()[1] for each in data.skipped()] == [f"{frame:010d}" for frame in (7, 8, 9)]


def test_a_broken_record_is_named_or_its_speed_unknown(tmp_path):
    make_drive(tmp_path, 1, frames=range(12), sides=(2,))
    records = tmp_path / name(1) / "oxts" / "data"
    for frame in range(12):
        record(records / f"{frame:010d}.txt", 8.0)
    (records / "0000000000.txt").write_text("49.0 8.4")
    options = {"root": str(tmp_path), "split": "all", "val_share": 0.0, "cameras": ["left"], "with_speed": True}
    options |= {"height": 10, "width": 30, "batch_size": 2, "workers": 0, "static": "speed"}
    with pytest.raises(DataError, match=r"0000000000\.txt: expected the 30 numbers"):
        datamodules.build("kitti", **options).setup("fit")
    data = datamodules.build("kitti", **options, on_error="skip")
    with pytest.warns(UserWarning, match=r"speed unknown: .*0000000000\.txt"):
        data.setup("fit")
    assert len(data.datasets["train"]) == 10


def test_a_real_moving_drive_is_not_static(kitti_mini):
    drive = KittiRaw(kitti_mini).drive("2011_09_26/2011_09_26_drive_9005_sync")
    assert static_by_flow(drive, range(6), 0.5) == set()
    assert median_flow(drive.image(0), drive.image(0)) == 0
