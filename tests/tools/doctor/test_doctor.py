from __future__ import annotations

import os
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from clip_tree import CAMERA, frames, make_clip, make_video
from kitti_tree import make_drive, name
from tiny import Wall

import saunet
from saunet.data.kitti import splits
from saunet.data.loading.module import DepthDataModule
from saunet.data.loading.selecting import read_manifest, write_manifest
from saunet.data.loading.stored import CacheSettings
from saunet.data.loading.windows import Selection
from saunet.data.video.focal import FocalEstimate
from saunet.errors import ConfigError
from saunet.io.video import VideoReader
from saunet.registry import datamodules
from saunet.tools.doctor.findings import diagnose, manifest_of
from saunet.tools.doctor.sheet import draw_sheet
from saunet.tools.doctor.survey import CameraFacts, Survey, Timeline, survey
from saunet.tools.prepare.cache import build_cache
from saunet.tools.prepare.tool import kitti_recordings


def kitti(root, **options):
    small = {"height": 10, "width": 30, "workers": 0, "split": "all", "cameras": ["left"], "val_share": 0.3}
    return datamodules.build("kitti", root=str(root), **{**small, **options})


def campus(root, **options):
    cache = str(root.parent / "cache")
    return datamodules.build("video", root=str(root), workers=0, frames_cache=cache, val_share=0.3, **options)


def look(data, **options):
    found = survey(data, **options)
    findings = diagnose(found)
    return found, findings, "\n".join(map(str, findings))


@pytest.mark.parametrize(
    ("given", "told", "agreement"),
    [
        ((0.9,), None, "from the turns of 1 of 1 drives; K agrees with it there"),
        ((1.08,), "'d0': K's focal length is 20% too long: it is 108.0 pixels, and", "K contradicts it there"),
        ((0.72,), "'d0': K's focal length is 20% too short: it is 72.0 pixels", "K contradicts it there"),
        ((0.9, 0.9), None, "from the turns of 2 of 2 drives; K agrees with it in all of them"),
        ((0.9, 1.08, 0.9), "'d1': K's focal length is 20% too long", "agrees with it in 2 and contradicts it in 1"),
    ],
)
def test_a_focal_length_is_compared_with_that_of_the_turns(given, told, agreement):
    estimate = FocalEstimate(0.9, 0.007, 5)
    K = np.array([[100.0, 0, 49.5], [0, 100.0, 29.5], [0, 0, 1]])
    cameras = [CameraFacts(f"d{i}", K, (60, 100), 10.0, None, focal, estimate) for i, focal in enumerate(given)]
    findings = [str(each) for each in diagnose(Survey(cameras=cameras))]
    assert any(agreement in each for each in findings), findings
    wrong = [each for each in findings if "too long" in each or "too short" in each]
    assert bool(wrong) == (told is not None)
    assert all(told in each and "turns in the pictures give 90.0, known to within 0.7%" in each for each in wrong)


def test_a_good_clip_is_described_and_drawn(tmp_path):
    make_clip(tmp_path / "r", "ä", frames(16, 5))
    found, findings, text = look(campus(tmp_path / "r"))
    assert "error" not in text
    assert re.search(r"motion between frames 1 apart: median (4\.9|5\.\d) px", text)
    assert "(recorded at 10.0 frames per second)" in text
    assert "camera height 1.4 m" in text
    assert "horizontal field of view 65 degrees" in text
    assert "no ground-truth depth" in text
    assert "protocols=" not in text  # it is this data set's own
    assert "protocols=[campus]" in "\n".join(map(str, diagnose(replace(found, protocol="eigen_camera_z"))))
    assert "only 8 training samples" in text
    sheet = draw_sheet(found, findings, "title")
    assert sheet.shape[1:] == (1312, 3)
    assert sheet.shape[0] > 400
    assert 0.05 < (sheet < 200).mean() < 0.6
    assert manifest_of(found, findings, "m.json").leave_out == {}


def test_cuts_are_counted_whoever_reads_the_frames(tmp_path):
    one, other = frames(10, 1), frames(10, 1, seed=1)
    make_clip(tmp_path / "r", "a", [*one, *other])
    text = look(campus(tmp_path / "r"))[2]
    assert "note: positions where the picture changes completely (cuts, loops, recordings in one folder): 1" in text
    assert "hardly resemble" not in text  # no sample reaches across
    images = make_drive(tmp_path / "k", 1, frames=range(20), sides=(2,)) / "image_02" / "data"
    for number, picture in enumerate([*one, *other]):
        cv2.imwrite(str(images / f"{number:010d}.png"), cv2.resize(picture, (60, 20)))
    assert "warning: frames that hardly resemble their neighbor: 1, such as 10 of" in look(kitti(tmp_path / "k"))[2]


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
    assert "are identical to their neighbor" in text
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


@pytest.mark.parametrize("hole", ["zeros", "cut"])
def test_a_picture_with_a_hole_and_a_whole_end_is_noticed(tmp_path, capfd, hole):
    folder = make_clip(tmp_path / "r", "a", frames(10, 1), suffix=".jpg")
    assert "partly damaged" not in look(campus(tmp_path / "r"))[2]
    file = folder / "frame_4.jpg"
    data = bytearray(file.read_bytes())
    middle = len(data) * 2 // 3
    data[middle : middle + 200] = bytes(200) if hole == "zeros" else b""
    file.write_bytes(data)
    found, _, text = look(campus(tmp_path / "r"))
    assert "warning: 1 frames are partly damaged, such as 4 of" in text
    assert "Corrupt JPEG data" in text
    assert [frame.index for frame in found.frames if frame.damage] == [4]
    os.write(2, b"as before\n")
    assert "as before" in capfd.readouterr().err


def test_cameras_that_cannot_be_right_are_named(tmp_path):
    make_clip(tmp_path / "r", "a", frames(16), camera=CAMERA.replace("K: [250, 252", "K: [1100, 252"))
    assert "means a field of view of 17 degrees, which no driving camera has" in look(campus(tmp_path / "r"))[2]
    (tmp_path / "r" / "camera.yaml").write_text(CAMERA.replace("158.0, 101.0", "60.0, 101.0"))
    assert "the center is far from the middle" in look(campus(tmp_path / "r"))[2]
    (tmp_path / "r" / "camera.yaml").write_text(CAMERA.replace("250, 252", "250, 300"))
    assert "the focal lengths differ" in look(campus(tmp_path / "r"))[2]
    (tmp_path / "r" / "camera.yaml").write_text("image_size: [640, 360]\nK: [500, 504, 316, 182]\n")
    found, findings, text = look(campus(tmp_path / "r"))
    assert "error: " in text
    assert text.count("is for 640x360") == 1
    assert "copy them again" not in text  # the frames are fine
    assert draw_sheet(found, findings, "x").shape[1] == 1312  # also with nothing readable


@pytest.mark.parametrize(("focal", "level"), [(250, "note"), (500, "warning")])
def test_a_field_of_view_that_was_not_checked_is_told(tmp_path, focal, level):
    make_clip(tmp_path / "r", "a", frames(16), camera=CAMERA.replace("K: [250, 252", f"K: [{focal}, {focal}"))
    text = look(campus(tmp_path / "r"))[2]
    assert f"{level}: K was not checked, because the focal length cannot be estimated" in text
    assert ("car cameras usually have 60 to 120" in text) == (level == "warning")


def test_a_clip_that_stands_is_named_as_the_cause_and_no_manifest_is_advised(tmp_path):
    make_clip(tmp_path / "r", "a", [frames(1)[0]] * 16)
    settings = {"root": str(tmp_path / "r"), "workers": 0, "frames_cache": str(tmp_path / "cache")}
    data = saunet.Spec.of("data", "video", **settings)
    found = saunet.doctor(saunet.DoctorOptions(data=data, output_dir=tmp_path / "out"))
    assert not found.usable
    assert (
        "show no motion (duplicates or a standing car): give longer clips with motion, or set data.static=keep"
        in str(found)
    )
    assert "train with data.manifest" not in str(found)


def test_focal_lengths_that_are_not_positive_are_an_error(tmp_path):
    folder = tmp_path / "sequences" / "00"
    (folder / "image_2").mkdir(parents=True)
    for number, picture in enumerate(frames(12, size=(40, 120))):
        cv2.imwrite(str(folder / "image_2" / f"{number:06d}.png"), picture)
    options = {"root": str(tmp_path), "train_sequences": ["00"], "test_sequences": ["00"], "val_share": 0.3}
    for K in ("-50 0 9000 0 0 50 20", "50 0 60 0 0 -50 20"):
        (folder / "calib.txt").write_text(f"P2: {K} 0 0 0 1 0\n")
        data = datamodules.build("kitti_odometry", workers=0, **options)
        found, findings, text = look(data)
        assert re.search(r"error: .*calib\.txt.* has focal lengths .*; the lengths must be positive", text)
        assert "horizontal field of view" not in text
        assert draw_sheet(found, findings, "x").shape[1] == 1312


def test_frame_rate_and_camera_height_of_kitti_are_told(tmp_path):
    make_drive(tmp_path / "raw", 1, frames=range(12), sides=(2,))
    for number, picture in enumerate(frames(12, 2, size=(20, 60))):
        cv2.imwrite(str(tmp_path / "raw" / name(1) / "image_02" / "data" / f"{number:010d}.png"), picture)
    sequence = tmp_path / "sequences" / "00"
    (sequence / "image_2").mkdir(parents=True)
    (sequence / "calib.txt").write_text("P2: 50 0 30 0 0 50 10 0 0 0 1 0\n")
    (sequence / "times.txt").write_text("".join(f"{0.2 * number:e}\n" for number in range(12)))
    for number, picture in enumerate(frames(12, 2, size=(20, 60))):
        cv2.imwrite(str(sequence / "image_2" / f"{number:06d}.png"), picture)
    odometry = datamodules.build(
        "kitti_odometry", root=str(tmp_path), train_sequences=["00"], test_sequences=["00"], val_share=0.3, workers=0
    )
    mixture = datamodules.build("mixed", sources={"town": kitti(tmp_path / "raw")}, height=10, width=30, workers=0)
    for data, rate in ((kitti(tmp_path / "raw"), "9.64"), (odometry, "5.0"), (mixture, "9.64")):
        text = look(data)[2]
        assert f"(recorded at {rate} frames per second)" in text
        assert "camera height 1.65 m: depth can be made metric" in text


def test_a_bonnet_is_seen(tmp_path):
    bonnet = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (50, 320, 3), dtype=np.uint8), (0, 0), 2)
    make_clip(tmp_path / "r", "a", [np.concatenate([picture[:150], bonnet]) for picture in frames(16, 6)])
    text = look(campus(tmp_path / "r"))[2]
    assert "of the picture does not move: the car's hood" in text
    share = float(re.search(r"data.crop=\[0,([\d.]+),0,0\]", text)[1])
    assert 0.15 < share < 0.29
    assert "does not move" not in look(campus(tmp_path / "r", crop=[0.0, 0.27, 0.0, 0.0]))[2]


@pytest.mark.parametrize(("step", "words"), [(1, "too little to tell depths apart"), (0, "nothing moves")])
def test_too_little_motion_is_told(tmp_path, step, words):
    make_clip(tmp_path / "r", "a", [frame + np.uint8(place % 2) for place, frame in enumerate(frames(12, step))])
    assert words in look(campus(tmp_path / "r", static="keep"))[2]


def test_a_split_that_cannot_be_used_is_a_finding(tmp_path):
    make_drive(tmp_path, 1, frames=range(6), scans=False)
    text = look(kitti(tmp_path))[2]
    assert "error: the test split cannot be used" in text
    assert re.search(r"'test' has no usable frame \(.* without ground truth\); check the data root and the split", text)
    nothing = look(kitti(tmp_path / "gone"))[2]
    assert nothing.count("no data root") == 1
    assert "error: the train, val and test splits cannot be used: no data root" in nothing
    assert "on_error" not in nothing


def test_a_part_of_a_split_is_told_from_gaps(tmp_path):
    kept = "2011_09_26_drive_0001_sync"
    make_drive(tmp_path, 1, frames=range(90))
    data = kitti(tmp_path, split="eigen_zhou_by_drive", test_split="all", cameras=["left", "right"])
    found, _, text = look(data, frames=10)
    listed = {split: [frame for frame in part if kept in frame.drive] for split, part in zip(
        ("train", "val"), splits.training_split("eigen_zhou_by_drive", 0), strict=True
    )}  # fmt: skip
    assert found.windows["train"] == sum(0 < frame.number < 89 for frame in listed["train"]) > 0
    assert not listed["val"]
    assert re.search(r"warning: \d+ of \d+ recordings of the train split are missing, with \d{5} of its \d{5} ", text)
    assert "consecutive" not in text
    assert re.search(r"error: the val split cannot be used: none of the \d+ drives of the val split is below", text)
    assert "the train split cannot be used" not in text
    assert "nothing is held out" not in text
    assert "on_error" not in text


def test_files_that_break_the_set_up_are_counted_with_on_error(tmp_path):
    drive = make_drive(tmp_path, 1, frames=range(6), sides=(2,))
    (drive / "image_02" / "data" / "0000000002.png").write_bytes(b"")
    text = look(kitti(tmp_path, static="flow"))[2]
    assert "0000000002.png is empty" in text
    assert "data.on_error=skip counts all broken files" in text


def test_a_video_that_cannot_be_decoded_to_its_end_is_a_finding(tmp_path):
    video = make_video(tmp_path / "r" / "a.avi", frames(48))
    whole = video.read_bytes()
    video.write_bytes(whole[: len(whole) * 2 // 3])
    with VideoReader(video) as reader:
        lost = reader.declared - sum(1 for _ in reader)
    assert lost > 5
    text = look(campus(tmp_path / "r"))[2]
    assert f"warning: {lost} frames that videos claim to have cannot be decoded and are left out" in text


def test_the_manifest_says_how_much_was_judged_and_what_only_tests_read(tmp_path):
    for number in (1, 2):
        make_drive(tmp_path, number, frames=range(12), sides=(2,))
    (tmp_path / "test.txt").write_text("".join(f"{name(2)} {number} l\n" for number in range(12)))
    (tmp_path / "train.txt").write_text("".join(f"{name(1)} {number} l\n" for number in range(12)))
    options = {"split": str(tmp_path / "train.txt"), "test_split": str(tmp_path / "test.txt")}
    found, findings, _ = look(kitti(tmp_path, **options), frames=6)
    assert (found.judged, found.known) == (6, 24)
    manifest = manifest_of(found, findings, tmp_path / "m.json")
    assert manifest.facts["read"].startswith("6 of 24 frames read")
    assert manifest.test_only == {f"{name(2)} l"}  # one color: each frame is static
    write_manifest(manifest.path, manifest)
    assert read_manifest(manifest.path).test_only == manifest.test_only


def test_reading_a_cache_is_measured_by_its_files_and_offered_where_there_is_one(tmp_path):
    make_drive(tmp_path / "raw", 1, frames=range(12), sides=(2,))
    build_cache(kitti_recordings(tmp_path / "raw", ["left"]), tmp_path / "cache", CacheSettings(10, 30))
    cached = kitti(tmp_path / "raw", cache=str(tmp_path / "cache"))
    sizes = {path.stat().st_size for path in (tmp_path / "cache").rglob("*.jpg")}
    assert {frame.file_bytes for frame in survey(cached, splits=["train"]).frames} <= sizes
    mixture = datamodules.build("mixed", sources={"a": kitti(tmp_path / "raw")}, height=10, width=30, workers=0)
    for data, offered in ((kitti(tmp_path / "raw"), True), (cached, False), (mixture, False)):
        found = survey(data)
        found.frames = [replace(frame, seconds=0.1) for frame in found.frames]
        text = "\n".join(map(str, diagnose(found)))
        assert "one core reads 10 images per second" in text
        assert f"of {found.samples} samples needs {3 * found.samples} images" in text
        assert found.samples == data.batch_size
        assert ("make a cache of small images once" in text) == offered


class _TwoFolders(DepthDataModule):
    """A module whose training and validation recordings are called the same."""

    ground_truth = "exact"
    protocol = "synthetic"

    def select(self, split):
        count = 8 if split == "train" else 4
        return [Selection(Wall("clip", frames=count, seed=count), range(count))]


class _WithoutTruth(_TwoFolders):
    """A data set without depth, whose author said nothing about neighbors."""

    ground_truth = "none"
    protocol = "campus"


class _WithoutMaps(_TwoFolders):
    """A data set that may have depth, here without any."""

    def select(self, split):
        class Blind(Wall):
            def depth(self, index):
                return None

        return [Selection(Blind("clip", frames=4, seed=len(split)), range(4))]


def test_the_doctor_counts_the_test_frames_that_are_evaluated():
    small = {"height": 32, "width": 48, "batch_size": 2, "workers": 0}
    _, _, text = look(_TwoFolders(**small))
    assert "views" not in text  # depth is compared, and every frame has it
    own = _WithoutTruth(**small)
    found, _, text = look(own)
    assert (found.windows["test"], found.left_out["test"]) == (2, {"without neighbor": 2})
    assert (sum(len(batch["name"]) for batch in own.batches("test", "cpu")), found.compared_views) == (2, None)
    _, _, text = look(_WithoutMaps(**small))
    assert "with protocols=[campus] compares views of neighboring frames, which 2 of the 4 test frames have" in text
    evaluated = _WithoutMaps(**small)
    evaluated.neighbors = (*evaluated.neighbors, "test")  # as that protocol does
    evaluated.setup("test")
    assert len(evaluated.datasets["test"]) == 2
    mixture = datamodules.build("mixed", sources={"a": _TwoFolders(**small), "b": _WithoutTruth(**small)}, **small)
    assert "note: evaluation also compares views of neighboring frames, which 4 of the 8 test" in look(mixture)[2]


def test_camera_files_are_named(tmp_path):
    root = tmp_path / "r"
    for number in range(3):
        make_clip(root, str(number), frames(6, 5, seed=number))
    assert f"note: camera: {root / 'camera.yaml'}" in look(campus(root))[2]
    (root / "2" / "camera.yaml").write_text(CAMERA)
    several = f"cameras: 2 files: {root / 'camera.yaml'} (2 clips), {root / '2' / 'camera.yaml'} (1 clip)"
    assert f"note: {several}" in look(campus(root))[2]
    assert not look(campus(root, camera="unknown", guess_camera=True))[0].camera_files.startswith("camera: unknown")
    assert "camera: " not in look(_TwoFolders(height=32, width=48, batch_size=2, workers=0))[2]


def test_speeds_are_told_and_those_that_do_not_fit(tmp_path):
    root = tmp_path / "r"
    for number in range(4):
        make_clip(root, str(number), frames(10, 5, seed=number))
    assert "distance traveled" not in look(campus(root))[2]
    (root / "0" / "speeds.csv").write_text("time,speed\n0,9\n1,9\n")
    (root / "1" / "speeds.csv").write_text("frame,speed\n0,12\n5,12\n")
    (root / "2" / "speeds.csv").write_text("time,speed\n100,9\n101,9\n")
    (root / "3" / "speeds.csv").write_text("drive,time,speed\n3,0,9\n3,1,9\n")
    (root / "3.speeds.csv").write_text("time,speed\n0,9\n1,9\n")
    (root / "other.csv").write_text("a,b\n")
    found, _, text = look(campus(root))
    assert "note: the distance traveled is known in 2 of 4 recordings (typically 10.5 m/s, 38 km/h)" in text
    assert "data.with_speed=true with +objective.extra.velocity.weight=0.1 trains depth in meters; scale.method" in text
    partly = next(facts for facts in found.speeds if facts.drive == "1")
    assert 0.4 < partly.known < 0.8
    assert f"known in 1 of them only partly, such as {partly.known:.0%} of the steps of '1'" in text
    assert "warning: the speeds of '2' are from 100.00 to 101.00 s, and its frames from 0.00" in text
    assert "warning: " + str(root / "3" / "speeds.csv") + " has speeds of the drives 3, which are not needed" in text
    assert f"warning: {root / '3.speeds.csv'} is not read: the speeds of a folder of frames are expected in it" in text
    assert "other.csv" not in text
    mixture = datamodules.build("mixed", sources={"a": campus(root)}, workers=0)
    assert "warning: a: the speeds of '2' are from" in look(mixture)[2]
    for number in (2, 3):
        (root / str(number) / "speeds.csv").unlink()
    assert "; +objective.extra.velocity.weight=0.1 trains" in look(campus(root, with_speed=True))[2]
    (root / "0" / "speeds.csv").write_text("speed\n")
    assert "warning: " + str(root / "0" / "speeds.csv") + " has the columns speed" in look(campus(root))[2]


def test_speeds_beside_a_video_are_those_of_its_name(tmp_path):
    video = make_video(tmp_path / "r" / "a.avi", frames(10, 5))
    (tmp_path / "r" / "a_speed.csv").write_text("time,speed\n0,9\n1,9\n")
    (tmp_path / "r" / "b.speeds.csv").write_text("time,speed\n0,9\n1,9\n")
    _, _, text = look(campus(video))
    assert "a_speed.csv is not read" in text
    assert "b.speeds.csv" not in text  # it may be another video's
    (tmp_path / "r" / "a_speed.csv").rename(tmp_path / "r" / "a.speeds.csv")
    _, _, text = look(campus(video))
    assert "not read" not in text
    assert "known in 1 of 1 recordings" in text


class _Own(_TwoFolders):
    """Somebody's data set: one key holds drives out, and by default nothing is."""

    def __init__(self, *, val_drives=(), **loading):
        super().__init__(**loading)
        self.val_drives = tuple(val_drives)

    def select(self, split):
        return super().select(split) if split == "train" else []


def test_advice_on_what_to_hold_out_names_the_keys_that_there_are():
    _, _, text = look(_Own(height=32, width=48, batch_size=2, workers=0))
    assert "warning: nothing is held out for validation; set data.val_drives" in text
    assert "nothing is held out for it: set data.val_drives" in text
    assert "val_share" not in text
    assert "check the data root" not in text


def test_different_recordings_of_one_name_are_kept_apart(tmp_path):
    found, findings, text = look(_TwoFolders(height=32, width=48, batch_size=2, workers=0), splits=["train", "val"])
    assert {frame.drive for frame in found.frames} == {"clip", "clip (val)"}
    assert len(found.frames) == found.known == 12
    assert "error: 'clip' names different recordings" in text
    assert not manifest_of(found, findings, tmp_path / "m.json").leave_out


def test_inspect_writes_nothing_and_takes_a_folder_a_name_or_a_spec(tmp_path, monkeypatch):
    make_clip(tmp_path / "r", "a", frames(6, 5))
    monkeypatch.chdir(tmp_path)
    settings = {"workers": 0, "frames_cache": str(tmp_path / "cache"), "val_share": 0.3}
    found = saunet.inspect(tmp_path / "r", frames=4, **settings)
    assert found.survey.judged == 4
    assert found.usable
    assert found._repr_png_().startswith(b"\x89PNG")
    assert "manifest" not in str(found)
    spec = saunet.Spec.of("data", "video", root=str(tmp_path / "r"), **settings)
    assert saunet.inspect(spec, frames=4).survey.fingerprints == found.survey.fingerprints
    with pytest.raises(ConfigError, match="did you mean 'synthetic_tiny'"):
        saunet.inspect("synthetic_tyny")
    assert not list(tmp_path.glob("*.json"))
    assert not list(tmp_path.glob("*.png"))


def test_gaps_duplicates_and_rates_are_told_and_drawn_as_a_timeline(tmp_path):
    """20 frames a second, then 10; two pictures come twice; two seconds and half a second are lost."""
    root = tmp_path / "r"
    times = [*np.arange(20) / 20, *(1 + np.arange(10) / 10), *(4 + np.arange(10) / 10), *(5.5 + np.arange(5) / 10)]
    folder = make_clip(root, "uneven", [])
    for time, picture in zip(times, frames(45, [5] * 8 + [0] + [5] * 16 + [0] + [5] * 19), strict=True):
        cv2.imwrite(str(folder / f"{1700000000 + time:.3f}.png"), picture)
    make_clip(root, "even")
    (root / "camera.yaml").write_text(CAMERA.replace("fps: 10\n", ""))
    make_clip(root, "unknown")
    (root / "even" / "camera.yaml").write_text(CAMERA)
    found, findings, text = look(campus(root, fps=None))
    lines = {line.drive: line for line in found.timelines}
    uneven = lines["uneven"]
    assert uneven.gaps == (pytest.approx((1.9, 4.0), abs=1e-3), pytest.approx((4.9, 5.5), abs=1e-3))
    assert uneven.duplicates == pytest.approx([times[8], times[25]], abs=1e-3)
    assert uneven.rates == pytest.approx((10, 10, 20), rel=0.01)
    assert lines["even"].times == pytest.approx(np.arange(10) / 10)
    assert (lines["even"].gaps, lines["even"].duplicates, lines["unknown"].times.size) == ((), (), 0)
    assert "2 gaps in time in 1 of 3 recordings, the longest 2.10 s long, after 1.90 s of 'uneven'" in text
    assert "rate varies in 1 of 3 recordings, such as 'uneven' (10 to 20 frames per second)" in text
    assert "no times in 1 of 3 recordings, such as 'unknown'; give fps" in text
    sheet = draw_sheet(found, findings, "title")
    drawn = draw_sheet(replace(found, timelines=[]), findings, "title")
    rows = sheet[np.flatnonzero((sheet[: len(drawn)] != drawn).any((1, 2)))[0] :]
    red = (rows == (190, 30, 30)).all(2)[:, 640:].any(0)
    runs = np.flatnonzero(np.diff(np.concatenate([[0], red.astype(int), [0]]))).reshape(-1, 2) / (1312 - 8 - 640) * 5.9
    np.testing.assert_allclose(runs, uneven.gaps, atol=0.03)


def test_time_stamps_that_repeat_are_a_warning():
    same = Timeline("a", 3, np.array([0.0, 0.1, 0.1]), duplicates=(0.1,))
    back = Timeline("b", 3, np.array([0.0, 0.2, 0.1]), duplicates=(0.1,))
    good = Timeline("c", 3, np.array([0.0, 0.1, 0.2]))
    text = "\n".join(map(str, diagnose(Survey(timelines=[good, same, back]))))
    assert "warning: time stamps repeat or go back in 2 of 3 recordings, such as 'a'" in text
