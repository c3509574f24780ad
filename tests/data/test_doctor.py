from __future__ import annotations

import re

import cv2
import numpy as np
import pytest
from campus_tree import CAMERA, frames, make_clip
from kitti_tree import make_drive, name

from saunet.data.doctor import diagnose, draw_sheet, manifest_of, survey
from saunet.data.manifest import read_manifest, write_manifest
from saunet.registry import datamodules


def kitti(root, **options):
    small = {"height": 10, "width": 30, "workers": 0, "split": "all", "cameras": ["left"], "val_share": 0.3}
    return datamodules.build("kitti", root=str(root), **{**small, **options})


def campus(root, **options):
    cache = str(root.parent / "cache")
    return datamodules.build("campus", root=str(root), workers=0, frames_cache=cache, val_share=0.3, **options)


def look(data, **options):
    found = survey(data, **options)
    findings = diagnose(found)
    return found, findings, "\n".join(map(str, findings))


def test_a_good_clip_is_described_and_drawn(tmp_path):
    make_clip(tmp_path / "r", "ä", frames(16, 5))
    found, findings, text = look(campus(tmp_path / "r"))
    assert "error" not in text
    assert re.search(r"motion between frames 1 apart: median (4\.9|5\.\d) px", text)
    assert "(recorded at 10.0 frames a second)" in text
    assert "camera height 1.4 m" in text
    assert "horizontal field of view 65 degrees" in text
    assert "no ground-truth depth" in text
    assert "only 8 training samples" in text
    sheet = draw_sheet(found, findings, "title")
    assert sheet.shape[1:] == (1312, 3)
    assert sheet.shape[0] > 400
    assert 0.05 < (sheet < 200).mean() < 0.6
    assert manifest_of(found, findings, "m.json").leave_out == {}


def test_bad_frames_are_found_and_left_out(tmp_path):
    drive = make_drive(tmp_path, 1, frames=range(20), sides=(2,))
    pictures = frames(20, [4] * 8 + [0] * 2 + [4] * 10, size=(20, 60))
    for number, picture in enumerate(pictures):
        cv2.imwrite(str(drive / "image_02" / "data" / f"{number:010d}.png"), picture)
    images = drive / "image_02" / "data"
    cv2.imwrite(str(images / "0000000003.png"), np.zeros((20, 60, 3), np.uint8))
    (images / "0000000012.png").write_bytes(b"")
    cv2.imwrite(str(images / "0000000006.png"), pictures[6][:10])
    found, findings, text = look(kitti(tmp_path))
    assert "error: 1 of " in text
    assert "0000000012.png is empty" in text
    assert "mixes frame sizes" in text
    assert "1 frames are almost black" in text
    assert "are the same picture as their neighbour" in text
    assert findings[0].level == "error"
    manifest = manifest_of(found, findings, tmp_path / "m.json")
    write_manifest(tmp_path / "m.json", manifest)
    reasons = read_manifest(tmp_path / "m.json").leave_out[f"{name(1)} l"]
    assert reasons["dark"] == [3]
    assert reasons["unreadable"] == [12]
    assert {8, 9} <= set(reasons["doubled"])
    data = kitti(tmp_path, manifest=str(tmp_path / "m.json"), on_error="skip")
    data.setup("fit")
    kept = {data.datasets["train"].windows[place][1] for place in range(len(data.datasets["train"]))}
    assert not kept & {3, 8, 9, 11, 12, 13}


def test_cameras_that_cannot_be_right_are_named(tmp_path):
    make_clip(tmp_path / "r", "a", frames(16), camera=CAMERA.replace("K: [250, 252", "K: [1100, 252"))
    assert "means a field of view of 17 degrees, which no driving camera has" in look(campus(tmp_path / "r"))[2]
    (tmp_path / "r" / "camera.yaml").write_text(CAMERA.replace("158.0, 101.0", "60.0, 101.0"))
    assert "the centre is far from the middle" in look(campus(tmp_path / "r"))[2]
    (tmp_path / "r" / "camera.yaml").write_text(CAMERA.replace("250, 252", "250, 300"))
    assert "the focal lengths differ" in look(campus(tmp_path / "r"))[2]
    (tmp_path / "r" / "camera.yaml").write_text("image_size: [640, 360]\nK: [500, 504, 316, 182]\n")
    found, findings, text = look(campus(tmp_path / "r"))
    assert "error: " in text
    assert "is for 640x360" in text
    assert draw_sheet(found, findings, "x").shape[1] == 1312  # also with nothing readable


def test_a_bonnet_is_seen(tmp_path):
    bonnet = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (50, 320, 3), dtype=np.uint8), (0, 0), 2)
    make_clip(tmp_path / "r", "a", [np.concatenate([picture[:150], bonnet]) for picture in frames(16, 6)])
    text = look(campus(tmp_path / "r"))[2]
    assert "of the picture do not move: the car's bonnet" in text
    share = float(re.search(r"data.crop=\[0,([\d.]+),0,0\]", text)[1])
    assert 0.15 < share < 0.29
    assert "do not move" not in look(campus(tmp_path / "r", crop=[0.0, 0.27, 0.0, 0.0]))[2]


@pytest.mark.parametrize(("step", "words"), [(1, "too little to tell depths apart"), (0, "nothing moves")])
def test_too_little_motion_is_told(tmp_path, step, words):
    make_clip(tmp_path / "r", "a", [frame + np.uint8(place % 2) for place, frame in enumerate(frames(12, step))])
    assert words in look(campus(tmp_path / "r", static="keep"))[2]


def test_a_split_that_cannot_be_used_is_a_finding(tmp_path):
    make_drive(tmp_path, 1, frames=range(6), scans=False)
    text = look(kitti(tmp_path))[2]
    assert "error: the test split cannot be used" in text
    nothing = look(kitti(tmp_path / "gone"))[2]
    assert nothing.count("no data root") == 1


def test_ground_truth_and_reading_are_told(tmp_path):
    make_drive(tmp_path, 1, frames=range(12))
    found, _, text = look(kitti(tmp_path), frames=4)
    assert len(found.frames) == 4
    assert "ground truth in 4 of 4 frames asked: 0.2% of the pixels, 10.0 to 20.0 m" in text
    assert "MB/s" in text
