"""When frames were taken: stamps of KITTI, of videos and in names; what is measured by them; gaps between them."""

from __future__ import annotations

import pickle
import re

import cv2
import numpy as np
import pytest
from clip_tree import CAMERA, frames, make_clip, make_video, texture
from drives import NumberDrive
from kitti_tree import make_drive, name
from PIL import Image

import saunet
from saunet.data.kitti.files import read_timestamps
from saunet.data.kitti.raw import KittiRaw
from saunet.data.loading.windows import Selection, find_windows
from saunet.data.video.clips import find_clips, frame_paths, read_clip
from saunet.data.video.drive import ClipDrive
from saunet.errors import DataError
from saunet.io.images import name_times
from saunet.io.times import frame_times
from saunet.io.video import VideoReader
from saunet.prediction.sources import Recording


def kitti(root, steps=(), speed=10.0):
    """Return a drive whose car goes at 10 m/s and whose frames come after these steps, in seconds."""
    folder = make_drive(root, 1, scans=False, frames=range(len(steps) + 1) if steps else range(6))
    (folder / "oxts" / "data").mkdir(parents=True)
    for index in range(len(steps) + 1 if steps else 6):
        record = ["0"] * 8 + [str(speed), "0", "0"] + ["0"] * 19
        (folder / "oxts" / "data" / f"{index:010d}.txt").write_text(" ".join(record))
    if steps:
        start = np.datetime64("2011-09-26T13:02:25.964389445", "ns")
        stamps = start + (1e9 * np.cumsum([0, *steps])).astype("timedelta64[ns]")
        lines = [str(stamp).replace("T", " ") for stamp in stamps]
        (folder / "image_02" / "timestamps.txt").write_text("\n".join(lines) + "\n")
    return KittiRaw(root).drive(name(1))


def test_kittis_distance_goes_by_its_own_clock(tmp_path):
    drive = kitti(tmp_path, [0.1031, 0.1042, 0.1037, 0.1033])
    assert drive.time(1) - drive.time(0) == pytest.approx(0.1031, abs=1e-6)
    assert drive.distance(0, 4) == pytest.approx(10 * 0.4143, abs=1e-4)  # 4.0 with the nominal 0.1 s
    assert drive.distance(3, 1) == pytest.approx(10 * 0.2079, abs=1e-4)
    assert drive.fps == pytest.approx(1 / 0.1035, rel=1e-3)
    again = pickle.loads(pickle.dumps(drive))
    np.testing.assert_array_equal(again.timestamps, drive.timestamps)


def test_without_a_clock_the_mean_of_kitti_is_used_and_said(tmp_path):
    drive = kitti(tmp_path)
    with pytest.warns(UserWarning, match=r"timestamps\.txt is missing.*0\.1037 s"):
        assert drive.distance(0, 5) == pytest.approx(10 * 5 * 0.1037)
    assert drive.timestamps is None


@pytest.mark.parametrize("line", ["yesterday", "2011-09-26 25:02:25.9", ""])
def test_a_broken_clock_is_named_with_its_line(tmp_path, line):
    (tmp_path / "timestamps.txt").write_text(f"2011-09-26 13:02:25.964389445\n{line}\n2011-09-26 13:02:26.07\n")
    with pytest.raises(DataError, match=r"timestamps\.txt, line 2: expected a time"):
        read_timestamps(tmp_path / "timestamps.txt")


def test_no_window_bridges_a_gap_in_time():
    class Timed(NumberDrive):
        def time(self, index):
            return 0.1 * index + (0.06 if index > 3 else 0) + (2.0 if index > 5 else 0)

    drive = Timed(indices=range(10))
    assert drive.gaps == {3, 5}
    windows, usage = find_windows([Selection(drive, drive.indices)], (-1, 1))
    assert [frame for _, frame in windows] == [1, 2, 7, 8]
    assert usage[0].left_out == {"without neighbor": 2, "across a gap in time": 4}
    assert len(find_windows([Selection(drive, drive.indices)], ())[0]) == 10
    assert NumberDrive().gaps == frozenset()


@pytest.mark.parametrize(
    ("names", "times"),
    [
        (["1403636579.5", "1403636579.55"], [1403636579.5, 1403636579.55]),
        (["1403636579763555584", "1403636579813555584"], [1403636579.763555584, 1403636579.813555584]),
        (["cam0_1403636579763555", "cam0_1403636579813555"], [1403636579.763555, 1403636579.813555]),
        (["1403636579763", "1403636579813"], [1403636579.763, 1403636579.813]),
        (["0.05", "0.1", "12.35"], [0.05, 0.1, 12.35]),
        *(([first, second], None) for first, second in (("0000000012", "0000000013"), ("frame_1", "frame_2"))),
        *(([first, second], None) for first, second in (("1.1", "1.10"), ("2024050312", "2024050313"), ("a", "1"))),
    ],
)
def test_stamps_in_names(names, times):
    assert name_times(names) == (times if times is None else pytest.approx(times, abs=1e-6))


def stamped(root, stamps, camera=CAMERA):
    root.mkdir()
    for picture, stamp in zip(frames(len(stamps)), stamps, strict=True):
        cv2.imwrite(str(root / f"{stamp}.png"), picture)
    (root / "camera.yaml").write_text(camera)
    return find_clips(root)[0]


def test_frames_are_in_order_of_their_stamps_and_keep_them(tmp_path):
    stamps = ["1403636579.5", "1403636579.55", "1403636579.6", "1403636579.7", "1403636579.75", "1403636580.75"]
    clip = stamped(tmp_path / "clip", stamps, CAMERA.replace("fps: 10\n", ""))
    assert [path.stem for path in frame_paths(clip.path)] == stamps  # by numbers .5 came before .55, .6 before .55
    recording = read_clip(clip, None, tmp_path, 1280)
    assert recording.times == tuple(map(float, stamps))
    drive = ClipDrive(clip, recording)
    assert drive.time(2) == 1403636579.6
    assert drive.gaps == {2, 4}
    chosen = read_clip(clip, 10.0, tmp_path, 1280)
    assert [round(10 * (time - chosen.times[0])) for time in chosen.times] == [0, 1, 2, 2, 12]
    assert chosen.passed_over == 1


def test_a_rate_in_the_camera_file_gives_times(tmp_path):
    make_clip(tmp_path, "clip")
    clip = find_clips(tmp_path)[0]
    drive = ClipDrive(clip, read_clip(clip, None, tmp_path, 1280))
    assert drive.time(3) == pytest.approx(0.3)
    assert drive.gaps == frozenset()


def test_speeds_of_another_clock_are_refused_and_aligned_by_the_flow(tmp_path, capsys):
    """A logger that began 41.3 s before the camera and counts Unix time; 1.5 px at 320 width are one m/s at 5 fps."""
    at = np.arange(0, 90, 0.2)
    knots = [0, 8, 11, 17, 19, 33, 36, 48, 49, 60, 66, 75, 78, 90]
    speed = np.interp(at, knots, [2, 2, 10, 10, 5, 5, 12, 12, 8, 8, 0, 0, 7, 7])
    world = np.tile(texture(), (1, 3, 1))
    folder = make_clip(tmp_path, "clip", [], CAMERA.replace("fps: 10", "fps: 5"))
    for number, place in enumerate(np.cumsum(1.5 * speed).astype(int) % 3000):
        cv2.imwrite(str(folder / f"{number:04d}.jpg"), world[:200, place : place + 320])
    ticks = np.arange(-41, 99, 0.5)
    rows = zip(ticks + 1_700_000_041.3, np.interp(ticks, at, speed), strict=True)
    (folder / "speeds.csv").write_text("\n".join(["time,speed", *(f"{tick:.2f},{value:.3f}" for tick, value in rows)]))
    common = {"root": str(tmp_path), "fps": None, "workers": 0, "frames_cache": str(tmp_path / "cache")}
    data = saunet.build("data", "video", with_speed=True, **common)
    with pytest.raises(DataError, match=r"speeds of 'clip' are from 1700000000\.30 .*set data\.align_speeds=true"):
        data.drives()
    data = saunet.build("data", "video", with_speed=True, align_speeds=True, **common)
    (drive,) = data.drives()
    found = re.search(r"speeds\.csv: its clock is \+(\S+) s off", capsys.readouterr().err)
    assert float(found[1]) == pytest.approx(1_700_000_041.3, abs=0.4)
    middle = drive.indices[len(drive.indices) // 3]
    assert drive.speed(middle) == pytest.approx(np.interp(drive.time(middle), at, speed), abs=1)
    (folder / "speeds.csv").write_text("frame,speed\n1000,8\n1010,8\n")
    with pytest.raises(DataError, match=r"are of the frames 1000 to 1010, but it has the frames 0 to 449; number them"):
        saunet.build("data", "video", with_speed=True, **common).drives()
    (tmp_path / "camera.yaml").write_text(CAMERA.replace("fps: 10\n", ""))
    with pytest.raises(DataError, match=r"its frames have no times; give fps in its camera\.yaml"):
        saunet.build("data", "video", with_speed=True, **common).drives()
    (folder / "speeds.csv").unlink()
    with pytest.raises(DataError, match=r"no speeds\.csv to align"):
        saunet.build("data", "video", align_speeds=True, **common).drives()


def test_a_table_of_times_orders_a_clip_and_gives_its_clock(tmp_path):
    """A camera's counter that wraps, and steps of 0.1 and 0.2 s."""
    folder = make_clip(tmp_path, "clip", [], CAMERA.replace("fps: 10\n", ""))
    seconds = {"IMG_9998": 7.0, "IMG_9999": 7.1, "IMG_0001": 7.2, "IMG_0002": 7.4, "IMG_0003": 7.5, "IMG_0004": 7.6}
    for stem, picture in zip(seconds, frames(6), strict=True):
        cv2.imwrite(str(folder / f"{stem}.png"), picture)
    rows = [f"{stem}{'.png' if stem < 'IMG_1' else ''}, {seconds[stem]}" for stem in sorted(seconds)]
    (folder / "times.csv").write_text("\n".join(["file, time", *rows]))
    clip = find_clips(tmp_path)[0]
    assert [path.stem for path in frame_paths(folder)] == list(seconds)
    recording = read_clip(clip, None, tmp_path, 1280)
    assert recording.times == tuple(seconds.values())
    assert recording.fps == pytest.approx(10)
    assert ClipDrive(clip, recording).gaps == {2}
    assert read_clip(clip, 5.0, tmp_path, 1280).times == (7.0, 7.2, 7.4, 7.6)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("file,time\na.png,1\n", r"times\.csv has no time for 1 of 2 images, such as b\.png"),
        ("file,time\na.png,1\nb.png,soon\n", r"times\.csv, line 3: 'soon' is not a time"),
        ("file,time\na.png,1\nb.png\n", r"times\.csv, line 3: '' is not a time"),
        ("file,time\na.png,1\nb.png,1\n", r"only 1 different times for 2 images"),
        ("frame,time\n0,1\n", r"has the columns frame, time; expected the columns 'file'"),
        ("", r"has the columns none; expected"),
        ("file,time\n\xff,1\n", r"is not a CSV file of text"),
    ],
)
def test_a_wrong_table_of_times_is_refused(tmp_path, text, words):
    (tmp_path / "times.csv").write_bytes(text.encode("latin1"))
    with pytest.raises(DataError, match=words):
        frame_times(tmp_path, ["a.png", "b.png"])


def exif_jpeg(path, original, fraction=None, offset=None):
    image = Image.fromarray(frames(1)[0])
    exif = Image.Exif()
    block = exif.get_ifd(0x8769)
    block |= {tag: text for tag, text in ((0x9003, original), (0x9291, fraction), (0x9011, offset)) if text}
    image.save(path, exif=exif)


def test_exif_gives_the_times_of_photographs(tmp_path):
    folder = make_clip(tmp_path, "clip", [], CAMERA.replace("fps: 10\n", ""))
    for number, original, fraction in (("0002", "59", "05"), ("0003", "59", "55"), ("0001", "58", "550")):
        exif_jpeg(folder / f"DSC_{number}.JPG", f"2024:05:03 12:00:{original}", fraction, "+02:00")
    recording = read_clip(find_clips(tmp_path)[0], None, tmp_path, 1280)
    noon = np.datetime64("2024-05-03T10:00:58").astype(int)
    assert recording.times == pytest.approx((noon + 0.55, noon + 1.05, noon + 1.55), abs=1e-6)
    assert recording.fps == pytest.approx(2)
    (frame, *_, last) = Recording(str(folder))
    assert last.time - frame.time == pytest.approx(1)
    exif_jpeg(folder / "DSC_0004.jpg", "2024:05:03 12:01:00")  # whole seconds are too coarse
    assert frame_times(folder, [path.name for path in frame_paths(folder)]) is None
    exif_jpeg(folder / "DSC_0004.jpg", "2024:05:03 12:00:58", "55", "+02:00")  # copied from another image
    assert frame_times(folder, [path.name for path in frame_paths(folder)]) is None


@pytest.mark.parametrize("damage", [slice(30, 36), slice(36, 38), slice(40, 44), slice(46, 400)])
def test_a_damaged_exif_block_means_no_time(tmp_path, damage):
    exif_jpeg(tmp_path / "a.jpg", "2024:05:03 12:00:58", "5")
    assert frame_times(tmp_path, ["a.jpg"]) is not None
    data = bytearray((tmp_path / "a.jpg").read_bytes())
    start = data.find(b"Exif") - 30
    data[start + damage.start : start + damage.stop] = b"\xff" * (damage.stop - damage.start)
    (tmp_path / "a.jpg").write_bytes(data)
    assert frame_times(tmp_path, ["a.jpg"]) is None


SECONDS = [100.0, 100.1, 100.3, 100.4, 100.5, 100.9]
"""Of the frames of a video that states 10 frames per second."""


def timed_video(root, rows):
    make_video(root / "a.mp4", frames(6))
    (root / "a.times.csv").write_text("\n".join(["frame, time", *rows]) + "\n")
    return root / "a.mp4"


def test_a_table_beside_a_video_goes_before_its_own_times(tmp_path):
    (clip,) = find_clips(timed_video(tmp_path, [f"{number}, {each}" for number, each in enumerate(SECONDS)][::-1]))
    taken = read_clip(clip, None, tmp_path / "cache", 1280)
    np.testing.assert_allclose(taken.times, np.array(SECONDS) - 100)
    assert taken.fps == pytest.approx(5 / 0.9)
    assert read_clip(clip, 5.0, tmp_path / "cache", 1280).numbers == (0, 2, 3, 4, 5)  # (0, 2, 4) by its own
    with VideoReader(clip.path) as reader:
        assert [frame.time for frame in reader.frames()] == pytest.approx([each - 100 for each in SECONDS])
        assert reader.declared == 6
    (tmp_path / "a.times.csv").unlink()
    assert read_clip(clip, None, tmp_path / "cache", 1280).times == pytest.approx(np.arange(6) / 10)  # decoded anew


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (["0, 1", "1, 2"], "has the times of 2 frames, but .*a.mp4 has more"),
        (
            [f"{each}, {each}" for each in range(8)],
            "of 8 frames, but .*a.mp4 has only 6; check whether the table belongs to another",
        ),
        (["0, 1", "2, 2"], "has 2 frames, but none of them is 1; number them all from 0"),
        (["0, 1", "1, 1"], "has frame 1 at 1 s, not after 1 s; times must ascend"),
        (["0, soon"], "line 2: 'soon' is not a time; expected the columns 'frame'"),
        ([], "contains no time"),
    ],
)
def test_a_table_that_does_not_fit_its_video_is_refused(rows, message, tmp_path):
    video = timed_video(tmp_path, rows)
    with pytest.raises(DataError, match=message), VideoReader(video) as reader:
        list(reader)
