from __future__ import annotations

import itertools
import json
import os
import pickle
import re
import shutil

import cv2
import numpy as np
import pytest
from clip_tree import CAMERA, frames, make_clip, make_video
from jaxtyping import TypeCheckError
from videos import write_video

from saunet.data.video.camera import Undistorter, read_camera
from saunet.data.video.clips import every, find_clips, frame_paths, read_clip
from saunet.data.video.focal import FocalEstimate
from saunet.data.video.motion import CUT, cuts, relative_change
from saunet.errors import ConfigError, DataError
from saunet.registry import datamodules


@pytest.fixture(autouse=True)
def _one_thread():
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    yield
    cv2.setNumThreads(before)


def module(root, **options):
    small = {"height": 32, "width": 64, "batch_size": 2, "workers": 0, "frames_cache": str(root.parent / "cache")}
    return datamodules.build("video", root=str(root), **{**small, **options})


def names(data, split):
    dataset = data.datasets[split]
    return [dataset.name(index) for index in range(len(dataset))]


def test_one_clip_finds_the_camera_file_beside_it(tmp_path):
    make_clip(tmp_path / "clips", "a", frames(14))
    data = module(tmp_path / "clips" / "a", camera=None)
    data.setup("fit")
    assert data.datasets["train"].drives[0].name == "a"
    (tmp_path / "clips" / "camera.yaml").unlink()
    with pytest.raises(DataError, match=r"no camera\.yaml for .*: put one beside it or at .*clips.camera\.yaml"):
        module(tmp_path / "clips" / "a").setup("fit")


def test_a_folder_of_frames_trains(tmp_path):
    make_clip(tmp_path / "öffentlich unterwegs", "a clip", frames(14))
    data = module(tmp_path / "öffentlich unterwegs", crop=[0.1, 0.2, 0.0, 0.0])
    data.setup()
    assert names(data, "train") == [f"a clip {number:010d}" for number in range(1, 10)]  # in natural order
    assert names(data, "val") == ["a clip 0000000012"]
    assert names(data, "test") == names(data, "val")
    batch = data.on_after_batch_transfer(next(iter(data.train_dataloader())), 0)
    assert batch["target"].shape == (2, 3, 32, 64)
    drive = data.drives()[0]
    assert drive.image(3).shape == (140, 320, 3)
    assert np.array_equal(drive.image(3), frames(14)[3][20:160])
    np.testing.assert_allclose(drive.intrinsics(3), [[250, 0, 158], [0, 252, 81], [0, 0, 1]])
    assert data.camera_height == 1.4
    assert pickle.loads(pickle.dumps(drive)).recorded(5) == 5
    assert (data.protocol, data.ground_truth) == ("campus", "none")
    test = data.prepare(next(iter(data.test_dataloader())))
    assert test["sources"].shape[1] == 2  # evaluation compares views


def test_a_video_is_decoded_once_and_like_its_frames(tmp_path):
    pictures = frames(12)
    make_video(tmp_path / "raw" / "dr ive.avi", pictures)
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "raw").rglob("*")}
    data = module(tmp_path / "raw")
    data.setup("fit")
    drive = data.drives()[0]
    assert drive.name == "dr ive.avi"
    assert list(drive.indices) == list(range(12))
    assert np.abs(drive.image(7).astype(int) - pictures[7]).mean() < 6  # two lossy encodings
    kept = sorted((tmp_path / "cache").rglob("*.jpg"))
    assert len(kept) == 12
    stamp = kept[3].stat().st_mtime_ns
    module(tmp_path / "raw").setup("fit")
    assert kept[3].stat().st_mtime_ns == stamp
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "raw").rglob("*")} == before
    smaller = module(tmp_path / "raw", max_width=160).drives()[0]
    assert smaller.image(0).shape == (100, 160, 3)
    np.testing.assert_allclose(smaller.intrinsics(0)[0], [125, 0, 78.75])


def test_frames_are_taken_by_time():
    taken = lambda recorded, wanted, count: [n for n, _ in zip(every(recorded, wanted), range(count), strict=False)]
    assert taken(30.0, 10.0, 4) == [0, 3, 6, 9]
    assert taken(25.0, 10.0, 5) == [0, 3, 5, 8, 10]
    assert taken(10.0, 30.0, 3) == taken(None, 10.0, 3) == taken(10.0, None, 3) == [0, 1, 2]


def test_stride_by_time_in_folders_and_videos(tmp_path):
    pictures = frames(20, 2)
    make_clip(tmp_path / "r", "b", pictures)
    make_video(tmp_path / "r" / "v.avi", pictures, fps=10)
    data = module(tmp_path / "r", fps=5.0, val_share=0.0)
    folder, video = data.drives()
    assert [drive.recorded(3) for drive in (folder, video)] == [6, 6]
    assert len(folder.indices) == len(video.indices) == 10
    assert np.array_equal(folder.image(3), pictures[6])
    data.setup("fit")
    assert [drive.left_out["passed over by fps"] for drive in (folder, video)] == [10, 10]
    assert "20 passed over by fps" in data.summary("train")
    facts = next((tmp_path / "cache").rglob("clip.json"))
    assert json.loads(facts.read_text())["times"] == pytest.approx([i / 5 for i in range(10)])
    facts.write_text(facts.read_text().replace('"numbers":', '"numbers": [], "n":'))
    with pytest.raises(DataError, match=r"clip\.json is damaged"):
        module(tmp_path / "r", fps=5.0).drives()


def test_a_folder_is_one_clip_however_many_links_lead_to_it(tmp_path):
    make_clip(tmp_path / "r", "a/b", frames(2))
    (tmp_path / "r" / "loop").symlink_to(".")
    (tmp_path / "r" / "a" / "0").symlink_to("b")
    make_clip(tmp_path / "elsewhere", "c", frames(2), camera=None)
    for link in ("x", "y"):
        (tmp_path / "r" / link).symlink_to(tmp_path / "elsewhere")
    (tmp_path / "elsewhere" / "back").symlink_to(tmp_path / "r")
    assert [clip.name for clip in find_clips(tmp_path / "r")] == ["a/b", "x/c"]


def test_doubled_and_static_frames_are_left_out_and_counted(tmp_path):
    moving = frames(12, [4] * 12)
    rng = np.random.default_rng(1)
    noisy = [np.clip(moving[5] + rng.normal(0, 4, moving[5].shape), 0, 255).astype(np.uint8) for _ in range(3)]
    make_clip(tmp_path / "r", "a", [*moving[:4], moving[3], moving[4], moving[5], *noisy, *moving[6:]])
    data = module(tmp_path / "r", val_share=0.0)
    data.setup("fit")
    drive = data.drives()[0]
    assert drive.left_out["doubled"] == 1
    assert [drive.recorded(index) for index in drive.indices] == [n for n in range(16) if n != 4]
    assert sorted(drive.static()) == [6, 7, 8]  # numbered without the doubled one
    assert "1 doubled" in data.summary("train")
    assert "3 static" in data.summary("train")
    kept = module(tmp_path / "r", static="keep", val_share=0.0)
    kept.setup("fit")
    assert len(names(kept, "train")) == 14


def test_a_clip_is_split_at_cuts_and_loops(tmp_path):
    one, other = frames(8, 1), frames(8, 1, seed=1)
    folder = make_clip(tmp_path / "r", "a", [*one, *other, *one])
    data = module(tmp_path / "r", val_share=0.0)
    data.setup("fit")
    drive = data.drives()[0]
    assert drive.left_out["split at cuts"] == 2
    assert list(drive.indices) == [*range(8), *range(9, 17), *range(18, 26)]
    assert [drive.recorded(index) for index in drive.indices] == list(range(24))  # nothing is lost
    assert len(names(data, "train")) == 3 * 6
    assert "2 split at cuts" in data.summary("train")
    assert len(list(folder.iterdir())) == 24


def test_fast_motion_is_no_cut():
    quick = frames(12, 12)  # farther than the texture's grain: no frame resembles the one before
    change = np.array([np.nan, *(relative_change(a, b) for a, b in itertools.pairwise(quick))])
    assert (change[1:] > CUT).all()
    assert not cuts(change).any()
    assert np.flatnonzero(cuts(np.array([np.nan, 0.3, 0.9, 0.3, 0.3, 0.9, 0.9, 0.9]))).tolist() == [2]


def test_frames_of_one_color_are_told(tmp_path):
    pictures = frames(8)
    black = [np.zeros_like(pictures[0])] * 3
    make_video(tmp_path / "r" / "v.avi", [*pictures[:4], *black, *pictures[4:]])
    data = module(tmp_path / "r", val_share=0.0)
    with pytest.warns(UserWarning, match=r"3 frames of .*v\.avi have one single color"):
        data.setup("fit")
    drive = data.drives()[0]
    assert drive.left_out["doubled"] == 2  # of the three, one is left, with no neighbor on either side
    assert drive.left_out["split at cuts"] == 2
    with pytest.warns(UserWarning, match="one single color"):  # also from the cache
        module(tmp_path / "r").drives()
    make_video(tmp_path / "b" / "v.avi", black)
    with pytest.raises(DataError, match=r"every one of the 3 frames of .* has one single color"):
        module(tmp_path / "b").drives()


def test_even_steps_of_parallax(tmp_path):
    make_clip(tmp_path / "r", "a", frames(24, [1] * 12 + [6] * 12))
    drive = module(tmp_path / "r", parallax=5.0).drives()[0]
    recorded = [drive.recorded(index) for index in drive.indices]
    steps = np.diff(recorded)
    assert set(steps[recorded.index(12) if 12 in recorded else -8 :]) == {1}
    assert steps[0] >= 5
    assert drive.left_out["closer than the parallax"] == 24 - len(recorded)


def test_clips_are_held_out_and_tested_by_name_and_condition(tmp_path):
    for number in range(3):
        make_clip(tmp_path / "r", f"day/{number}", frames(6, seed=number))
    make_clip(tmp_path / "r", "night", frames(6))
    (tmp_path / "r" / "night" / "camera.yaml").write_text(CAMERA + "condition: night\n")
    data = module(tmp_path / "r", val_clips=["day/0"], test_clips=["n*"])
    data.setup()
    clip = lambda split: {name.rpartition(" ")[0] for name in names(data, split)}
    assert clip("train") == {"day/1", "day/2"}
    assert (clip("val"), clip("test"), clip("predict")) == ({"day/0"}, {"night"}, {"night"})
    assert len(names(data, "predict")) == 6
    assert [drive.condition for drive in data.drives()] == [None, None, None, "night"]
    assert data.overlap() is None
    assert (
        "validation, which chooses best.ckpt, and test are the same frames"
        in module(tmp_path / "r", val_clips=["day/0"]).overlap()
    )
    share = module(tmp_path / "r", val_share=0.3).overlap()
    for words in (
        "validation share 'day/0', 'day/1'",
        "validation, which chooses best.ckpt, and test are the same",
        "data.val_clips=[NAME] and data",
        "to score more of these, raise data.val_share",
    ):
        assert words in share
    with pytest.raises(ConfigError, match=r"val_clips and test_clips both name night; name each in only one of them"):
        module(tmp_path / "r", val_clips=["day/0", "night"], test_clips=["n*"]).setup("fit")
    with pytest.raises(ConfigError, match=r"hold out all clips \(day/0, .*leave one to train on"):
        module(tmp_path / "r", val_clips=["day/*"], test_clips=["n*"]).setup("fit")
    only = module(tmp_path / "r", conditions=["night"])
    assert [drive.name for drive in only.drives()] == ["night"]
    with pytest.raises(ConfigError, match=r"conditions is 'nihgt'; did you mean 'night'"):
        module(tmp_path / "r", conditions=["nihgt"]).drives()
    with pytest.raises(ConfigError, match=r"val_clips names 'x', which matches no clip; clips: day/0, day/1"):
        module(tmp_path / "r", val_clips=["x"]).setup("fit")


def test_a_folder_of_frames_or_a_video_can_be_the_root(tmp_path):
    folder = make_clip(tmp_path, "clip", camera=None)
    (folder / "camera.yaml").write_text(CAMERA)
    video = make_video(tmp_path / "v" / "x.avi")
    assert [clip.name for clip in find_clips(folder)] == ["clip"]
    assert [clip.name for clip in find_clips(video)] == ["x.avi"]
    assert len(read_clip(find_clips(video)[0], None, tmp_path / "c", 1280).paths) == 10


def test_a_broken_frame_is_named_or_skipped_and_counted(tmp_path):
    folder = make_clip(tmp_path / "r", "a", frames(16))
    (folder / "frame_6.png").write_bytes(b"")
    with pytest.raises(DataError, match=r"frame_6.png is empty \(0 bytes\)"):
        module(tmp_path / "r").setup("fit")
    data = module(tmp_path / "r", on_error="skip", val_share=0.0)
    data.setup("fit")
    assert "1 unreadable" in data.summary("train")
    drive = data.drives()[0]
    assert drive.left_out["unreadable"] == 1
    assert 6 not in drive.indices  # a gap, so that frames 5 and 7 are no neighbors
    assert len(names(data, "train")) == 16 - 1 - 2 - 2


def test_what_is_left_out_is_said_of_the_clip_that_it_belongs_to(tmp_path):
    for name, count in (("a", 16), ("b", 20), ("c", 3)):
        make_clip(tmp_path / "r", name, frames(count))
    data = module(tmp_path / "r", static="keep")
    data.setup("fit")
    assert data.summary("train").splitlines()[1:] == [
        "  a: 11 frames used; left out: 2 between training and validation, 1 without neighbor",
        "  b: 15 frames used; left out: 2 between training and validation, 1 without neighbor",
        "  c: 0 frames used; left out: 2 between training and validation",
    ]
    assert "train (2 of 3 drives): 26 frames used; left out: 6 between" in data.summary("train")


@pytest.mark.parametrize("content", [b"", b"not a video", "half"])
def test_a_video_that_cannot_be_decoded_is_named(tmp_path, content):
    video = make_video(tmp_path / "r" / "dréve 1.avi")
    video.write_bytes(video.read_bytes()[:300] if content == "half" else content)
    with pytest.raises(DataError, match=r"dréve 1\.avi (is empty|is not a video|holds no frame)"):
        module(tmp_path / "r").setup("fit")
    assert not list((tmp_path / "cache").rglob("*"))


def test_a_video_that_cannot_be_decoded_is_left_out_and_counted(tmp_path):
    make_clip(tmp_path / "r", "a", frames(16))
    (tmp_path / "r" / "b.avi").write_bytes(b"not a video")
    with pytest.raises(DataError, match=r"b\.avi is not a video"):
        module(tmp_path / "r").setup("fit")
    data = module(tmp_path / "r", on_error="skip")
    with pytest.warns(UserWarning, match=r"clip left out: .*b\.avi is not a video"):
        data.setup("fit")
    assert [drive.name for drive in data.drives()] == ["a"]
    assert re.search(r"\n  clip left out: .*b\.avi is not a video", data.summary("train"))
    assert "clip left out" not in data.summary("val")
    with pytest.raises(DataError, match=r"hold no usable frame, such as .*b\.avi is not a video"), pytest.warns():
        module(tmp_path / "r" / "b.avi", on_error="skip", camera=str(tmp_path / "r" / "camera.yaml")).setup("fit")


def test_another_size_within_a_clip_and_a_camera_that_does_not_fit(tmp_path):
    pictures = frames(10)
    make_clip(tmp_path / "r", "a", [*pictures[:5], pictures[5][:100], *pictures[6:]])
    data = module(tmp_path / "r", static="keep", val_share=0.0)
    data.setup("fit")
    with pytest.raises(DataError, match=r"frame_5.png is 320x100 .* but other frames of its clip are 320x200"):
        list(data.train_dataloader())
    (tmp_path / "r" / "camera.yaml").write_text("image_size: [1920, 1080]\nK: [1500, 1512, 960, 540]\n")
    wrong = module(tmp_path / "r", static="keep", val_share=0.0)
    wrong.setup("fit")
    with pytest.raises(DataError, match=r"frames of 'a' \(frame_0.png\) are 320x200 .* is for 1920x1080"):
        list(wrong.train_dataloader())


def test_a_rotated_video_needs_the_calibration_of_the_upright_picture(tmp_path):
    """Phones turn by a tag: the sensor's picture is 128 x 96, and what is shown 96 x 128."""
    for name, size, K in (
        ("lying", "[128, 96]", "[110, 110, 63.5, 47.5]"),
        ("up", "[96, 128]", "[110, 110, 47.5, 63.5]"),
    ):
        root = tmp_path / name
        root.mkdir()
        write_video(root / "phone.mov", 12, rotation=90)
        (root / "camera.yaml").write_text(f"image_size: {size}\nK: {K}\n")
    data = module(tmp_path / "up", static="keep", val_share=0.0)
    (drive,) = data.drives()
    assert drive.image(0).shape == (128, 96, 3)
    assert drive.intrinsics(0)[0, 2] == 47.5
    (wrong,) = module(tmp_path / "lying", static="keep", val_share=0.0).drives()
    with pytest.raises(DataError, match=r"'phone\.mov' .* are 96x128 .* is for 128x96; the sides are swapped"):
        wrong.image(0)


def test_a_bare_stream_has_the_rate_of_the_camera_file(tmp_path):
    """comma.ai's logs are HEVC without container; this one does not state its rate."""
    silent = {"x265-params": "log-level=error:vui-timing-info=0"}
    (tmp_path / "r").mkdir()
    write_video(tmp_path / "r" / "video.hevc", 12, codec="libx265", form="hevc", options=silent)
    camera = "image_size: [128, 96]\nK: [110, 110, 63.5, 47.5]\n"
    (tmp_path / "r" / "camera.yaml").write_text(camera)
    with pytest.warns(
        UserWarning, match=r"frame rate of .*video\.hevc is unknown.*all frames are used.*fps in camera\.yaml"
    ):
        (drive,) = module(tmp_path / "r", static="keep", fps=10.0).drives()
    assert (len(drive.indices), drive.fps, drive.timestamps) == (12, None, None)
    (tmp_path / "r" / "camera.yaml").write_text(camera + "fps: 20\n")
    (drive,) = module(tmp_path / "r", static="keep", fps=10.0).drives()
    assert drive.timestamps == pytest.approx(np.arange(6) / 10)
    assert [drive.recorded(index) for index in drive.indices] == [0, 2, 4, 6, 8, 10]


@pytest.mark.parametrize("first", ["empty", "small"])
@pytest.mark.parametrize("static", ["keep", "drop"])
def test_a_bad_first_frame_is_skipped_and_no_other(tmp_path, first, static):
    pictures = frames(16)
    folder = make_clip(tmp_path / "r", "a", [pictures[0][:100], *pictures[1:]])
    if first == "empty":
        (folder / "frame_0.png").write_bytes(b"")
    data = module(tmp_path / "r", on_error="skip", static=static, val_share=0.25)
    data.setup()
    list(data.train_dataloader())
    measured = first == "empty" and static == "drop"  # then there is no frame 0, and without it no window
    assert data.skipped() == ([] if measured else ["a 0000000001"])
    assert len(names(data, "val")) >= 2
    assert all(usage.left_out["unreadable"] == 0 for usage in data.usage["val"])


def test_an_unknown_camera_is_estimated_once_from_all_its_clips(tmp_path, monkeypatch, caplog):
    """The estimate itself is tested with calibrate; here 0.7 widths of the cropped frames become pixels of K."""
    asked = []

    def estimate(windows, center):
        asked.append((len(list(windows)), center))
        return FocalEstimate(0.7, 0.004, 5, bend=-0.2)

    monkeypatch.setattr("saunet.data.video.module.estimate_focal", estimate)
    for name in ("a", "b"):
        make_clip(tmp_path / "clips", name, frames(14), camera="camera: unknown\nfps: 10\ncrop: [0, 0.1, 0.1, 0]\n")
    for _ in range(2):
        data = module(tmp_path / "clips", frames_cache=str(tmp_path / "cache"))
        with caplog.at_level("INFO"):
            data.setup("fit")
        drive = data.datasets["train"].drives[0]
        np.testing.assert_allclose(drive.lens.K, [[0.7 * 288, 0, 159.5 - 32], [0, 0.7 * 288, 99.5], [0, 0, 1]])
        assert (drive.lens.model, drive.lens.coefficients) == ("division", (pytest.approx(-0.2 * 0.7**2),))
    assert asked == [(2, (128 / 288, 100 / 288))]  # a window a clip; the second time it is known
    assert "known to within 0.40% from 5 windows" in caplog.text
    (kept,) = (tmp_path / "cache").glob("camera-*.yaml")  # for prediction, which takes no unknown camera
    assert f"{kept}; give it to saunet predict as undistort=" in caplog.text
    lens = Undistorter(read_camera(kept)).lens(200, 320)
    np.testing.assert_allclose(lens.K, drive.intrinsics(0), rtol=1e-6)
    np.testing.assert_array_equal(lens(frames(14)[3]), drive.image(3))


def test_a_frame_can_be_had_as_the_lens_showed_it(tmp_path):
    camera = "K: [300, 300, 160, 100]\nimage_size: [320, 200]\nfps: 10\ncrop: [0, 0.1, 0.1, 0]\n"
    make_clip(tmp_path / "bent", "a", frames(3), camera=f"{camera}distortion: [-0.1, 0, 0, 0]\n")
    make_clip(tmp_path / "straight", "a", frames(3), camera=camera)
    (drive,), (plain,) = (module(tmp_path / each, static="keep").drives() for each in ("bent", "straight"))
    np.testing.assert_array_equal(drive.recorded_image(1), plain.image(1))
    np.testing.assert_array_equal(plain.recorded_image(1), plain.image(1))
    assert (np.asarray(drive.image(1)) != plain.image(1)).any()
    assert plain.lens is None
    assert (drive.lens.model, drive.lens.coefficients) == ("pinhole", (-0.1, 0, 0, 0))
    np.testing.assert_allclose(drive.lens.K, plain.intrinsics(1))
    assert not np.allclose(drive.intrinsics(1), drive.lens.K)


def test_a_camera_called_unknown_keeps_what_its_file_says_beside_the_lens(tmp_path):
    lens = "K: [900, 900, 160, 100]\nimage_size: [320, 200]\ndistortion: [-0.1, 0, 0, 0]\n"
    camera = f"{lens}fps: 12\ncrop: [0, 0.1, 0.1, 0]\n"
    make_clip(tmp_path, "a", frames(14), camera=camera)
    data = module(tmp_path, camera="unknown", guess_camera=True)
    data.setup("fit")
    drive = data.datasets["train"].drives[0]
    assert drive.intrinsics(0)[0, 0] == pytest.approx(160 / np.tan(np.radians(30)))  # a guess, not 900
    assert drive.clip.camera.fps == 12
    assert drive.frame_size == (180, 288)
    assert drive.clip.camera.is_straight


def test_an_unknown_camera_that_nothing_tells_is_refused_or_guessed(tmp_path):
    make_clip(tmp_path, "a", frames(14), camera=None)
    data = module(tmp_path, camera="unknown")
    with pytest.raises(DataError, match=r"cannot be estimated .*film a minute with turns.*model\.intrinsics=learned"):
        data.setup("fit")
    data = module(tmp_path, camera="unknown", guess_camera=True)
    data.setup("fit")
    assert data.datasets["train"].drives[0].intrinsics(0)[0, 0] == pytest.approx(160 / np.tan(np.radians(30)))


def test_what_is_missing_is_one_sentence(tmp_path):
    with pytest.raises(DataError, match=r"no data root at .*gone; set data.root"):
        module(tmp_path / "gone").setup("fit")
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match=r"empty holds neither folders of images nor videos"):
        module(tmp_path / "empty").setup("fit")
    make_clip(tmp_path / "r", "a", camera=None)
    with pytest.raises(DataError, match=r"no camera.yaml for .*a: put one beside it or at .*r.camera.yaml"):
        module(tmp_path / "r").setup("fit")
    (tmp_path / "x.txt").write_text("x")
    with pytest.raises(DataError, match=r"x.txt is neither a folder nor a video"):
        find_clips(tmp_path / "x.txt")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"crop": [0.1]}, "crop is"),
        ({"crop": [0.5, 0.6, 0.0, 0.0]}, "crop is"),
        ({"fps": 0.0}, "fps is 0"),
        ({"parallax": -1.0}, "parallax is -1"),
        ({"static": "flow"}, "static is 'flow'|parameter static="),
        ({"on_error": "ignore"}, "on_error is 'ignore'|parameter on_error="),
        ({"val_share": 2.0}, "val_share is 2"),
    ],
)
def test_wrong_settings_are_one_sentence(tmp_path, options, message):
    with pytest.raises((ConfigError, TypeCheckError), match=message):
        module(tmp_path, **options)


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may write everywhere")
def test_a_read_only_root_is_enough(tmp_path):
    make_video(tmp_path / "r" / "x.avi")
    (tmp_path / "r").chmod(0o555)
    try:
        module(tmp_path / "r").setup("fit")
    finally:
        (tmp_path / "r").chmod(0o755)


def test_nothing_is_written_below_the_root(tmp_path):
    make_video(tmp_path / "r" / "x.avi")
    make_clip(tmp_path / "r", "a")
    before = sorted((path, path.stat().st_mtime_ns) for path in [tmp_path / "r", *(tmp_path / "r").rglob("*")])
    data = module(tmp_path / "r", val_share=0.3)
    data.setup()
    next(iter(data.train_dataloader()))
    assert sorted((path, path.stat().st_mtime_ns) for path in [tmp_path / "r", *(tmp_path / "r").rglob("*")]) == before


@pytest.mark.parametrize("on_error", ["raise", "skip"])
def test_a_cache_that_cannot_be_written_is_named(tmp_path, on_error):
    make_video(tmp_path / "r" / "x.avi")
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(DataError, match=r"cannot keep the frames of .*x.avi in .*file.*set data.frames_cache"):
        module(tmp_path / "r", frames_cache=str(tmp_path / "file" / "cache"), on_error=on_error).setup("fit")


def test_thumbnails_and_attributes_are_no_clips(tmp_path):
    make_clip(tmp_path / "r", "clip")
    make_clip(tmp_path / "r", "clip/@eaDir/000.png")
    make_clip(tmp_path / "r", "clip/.ipynb_checkpoints")
    make_clip(tmp_path / "r", "__MACOSX/clip")
    (tmp_path / "r" / "clip" / "._frame_1.png").write_bytes(b"\0\x05\x16\x07")
    clips = find_clips(tmp_path / "r")
    assert [clip.name for clip in clips] == ["clip"]
    assert len(frame_paths(clips[0].path)) == 10


def test_depth_beside_color_is_no_clip(tmp_path):
    folder = make_clip(tmp_path, "drive/rgb").parent
    (folder / "depth").mkdir()
    for index in range(3):
        cv2.imwrite(str(folder / "depth" / f"{index}.png"), np.full((200, 320), 5000, np.uint16))
    with pytest.warns(UserWarning, match=r"1 folders .*16-bit images of one channel.*depth"):
        assert [clip.name for clip in find_clips(tmp_path)] == ["drive/rgb"]
    shutil.rmtree(folder / "rgb")
    assert [clip.name for clip in find_clips(tmp_path)] == ["drive/depth"]  # a camera of 16 bits alone is one
