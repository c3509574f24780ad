"""Videos as cameras and phones write them: every frame once, at its time, in its colors, the right way up."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from videos import Picture, number_of, numbered, write_video

from saunet.errors import ConfigError, DataError
from saunet.io import video as module
from saunet.io.live import CameraReader
from saunet.io.video import VideoReader, VideoWriter, nearest_steps


def numbers(path: Path, **options: Any) -> list[int]:
    return [number_of(frame.image) for frame in VideoReader(path).frames(**options)]


def times(path: Path) -> list[float]:
    return [round(frame.time, 4) for frame in VideoReader(path).frames() if frame.time is not None]


def apart(image: Picture, wanted: Picture) -> float:
    return float(np.abs(image.astype(int) - wanted).mean())


QUIET = {"x265-params": "log-level=error"}


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("a.mp4", {}),
        ("a.mov", {}),
        ("a.mkv", {}),
        ("a.ts", {"form": "mpegts"}),
        ("00001.MTS", {"form": "mpegts"}),
        ("a.m2ts", {"form": "mpegts"}),
        ("a.3gp", {}),
        ("a.flv", {}),
        ("a.webm", {"codec": "libvpx"}),
        ("vp9.webm", {"codec": "libvpx-vp9"}),
        ("av1.mp4", {"codec": "libsvtav1"}),
        ("prores.mov", {"codec": "prores_ks", "pixels": "yuv422p10le"}),
        ("a.mpg", {"codec": "mpeg2video"}),
        ("a.wmv", {"codec": "wmv2"}),
        ("a.avi", {"codec": "mjpeg"}),
        ("ten_bits.mp4", {"codec": "libx265", "pixels": "yuv420p10le", "options": QUIET}),
        ("reordered.mp4", {"options": {"bf": "3"}}),
        ("sound.mp4", {"sound": 3.2}),
        ("sound.mkv", {"sound": 3.2}),
    ],
)
def test_every_frame_of_every_container(tmp_path: Path, name: str, options: dict[str, Any]) -> None:
    reader = VideoReader(write_video(tmp_path / name, 20, **options))
    frames = list(reader.frames())
    assert [number_of(frame.image) for frame in frames] == list(range(20))
    assert [frame.number for frame in frames] == list(range(20))
    assert [frame.time for frame in frames] == pytest.approx(np.arange(20) / 20, abs=1e-3)
    assert (reader.height, reader.width) == (96, 128)
    assert reader.fps == pytest.approx(20, rel=0.01)
    assert (reader.missing, reader.damaged, reader.plain) == (0, 0, 0)
    assert apart(frames[7].image, numbered(7)) < 14  # blocks of MPEG-2 and WMV; exact colors are another test's
    assert len(list(reader)) == 20  # again from the start
    assert Path(name).suffix.lower() in module.VIDEO_SUFFIXES


@pytest.mark.parametrize("suffix", [".mp4", ".mkv"])
def test_variable_rate_is_chosen_by_time(tmp_path: Path, suffix: str) -> None:
    """20 frames a second, then 10, then half a second is lost."""
    true = [i / 20 for i in range(10)] + [0.5 + i / 10 for i in range(5)] + [1.5 + i / 10 for i in range(5)]
    path = write_video(tmp_path / f"a{suffix}", 20, times=true)
    assert times(path) == pytest.approx(true, abs=1e-3)
    assert numbers(path, fps=10) == [0, 2, 4, 6, 8, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19]
    assert numbers(path, fps=5) == [0, 4, 8, 11, 13, 14, 15, 16, 18]  # steps of 0.2 s; 1.0 s is nearest to 14 at 0.9 s
    assert numbers(path, fps=1000) == list(range(20))


@pytest.mark.parametrize("wanted", [3.0, 7.0, 9.9, 10.0, 12.5, 15.0, 20.0])
def test_equal_steps_of_an_even_video_are_as_by_number(wanted: float) -> None:
    """For evenly spaced frames it is the rule that training on clips has always had."""
    from saunet.data.video.clips import every

    frames = [(i, i / 20, None) for i in range(53)]
    by_number = [n for n, _ in zip(every(20.0, wanted), range(99), strict=False) if n < 53]
    assert [number for number, _, _ in nearest_steps(frames, wanted)] == by_number


def test_bare_streams_have_no_times_of_their_own(tmp_path: Path) -> None:
    silent = {"x265-params": "log-level=error:vui-timing-info=0"}
    path = write_video(tmp_path / "video.hevc", 12, codec="libx265", form="hevc", options=silent)
    reader = VideoReader(path)
    assert (reader.fps, reader.declared) == (None, None)
    assert [(number_of(f.image), f.time) for f in reader.frames()] == [(i, None) for i in range(12)]
    assert [f.time for f in VideoReader(path, rate=20).frames()] == pytest.approx(np.arange(12) / 20)
    said = VideoReader(write_video(tmp_path / "a.h264", 12, form="h264"))  # x264 writes the rate
    assert said.fps == 20
    assert [number_of(image) for image in said] == list(range(12))


def gray(number: int) -> Picture:
    return np.repeat(numbered(number, shift=6).mean(2, keepdims=True).astype(np.uint8), 3, axis=2)


def woven(first: int) -> Picture:
    """Two moments in one picture, as an interlaced camera takes them; gray, since fields do not share their colors."""
    picture = gray(first)
    picture[17::2] = gray(first + 1)[17::2]
    return picture


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("a.mp4", {"options": {"x264opts": "tff=1", "crf": "5"}}),
        ("a.mts", {"options": {"x264opts": "tff=1", "crf": "5"}, "form": "mpegts"}),
        ("a.mpg", {"codec": "mpeg2video", "options": {"top": "1", "qscale": "2"}}),
    ],
)
def test_interlaced_frames_are_deinterlaced(tmp_path: Path, name: str, options: dict[str, Any]) -> None:
    pictures = [woven(2 * i) for i in range(12)]
    path = write_video(tmp_path / name, pictures, interlaced=True, **options)
    frames = list(VideoReader(path).frames())
    assert [number_of(frame.image) for frame in frames] == [2 * i for i in range(12)]
    assert [frame.time for frame in frames] == pytest.approx(np.arange(12) / 20, abs=1e-3)

    def combing(image: Picture) -> float:
        rows = image[20:].astype(int)
        return float(np.abs(2 * rows[1:-1] - rows[:-2] - rows[2:]).mean())

    assert combing(frames[5].image) < 0.4 * combing(pictures[5])
    assert min(apart(frames[5].image[16:], gray(number)[16:]) for number in (10, 11)) < 12


@pytest.mark.parametrize(("turn", "shape"), [(90, (128, 96)), (180, (96, 128)), (270, (128, 96))])
def test_rotation_is_applied(tmp_path: Path, turn: int, shape: tuple[int, int]) -> None:
    """As OpenCV turns it, which follows players."""
    path = write_video(tmp_path / "a.mov", 5, rotation=turn)
    reader = VideoReader(path)
    image = next(iter(reader))
    assert (reader.height, reader.width) == image.shape[:2] == shape
    capture = cv2.VideoCapture(str(path))
    assert apart(image, capture.read()[1][..., ::-1]) < 3
    capture.release()
    assert apart(np.rot90(image, -turn // 90), numbered(0)) < 5


@pytest.mark.parametrize("turn", [0, 90])
def test_frames_that_shrink_show_the_same_at_the_same_place(tmp_path: Path, turn: int) -> None:
    """As OpenCV's averaging of areas: no shift, which would move the principal point, and no aliasing."""
    rng = np.random.default_rng(0)
    fine = cv2.GaussianBlur(rng.integers(0, 256, (360, 480), dtype=np.uint8), (0, 0), 1.2)
    scene = cv2.cvtColor(cv2.normalize(fine, None, 0, 255, cv2.NORM_MINMAX), cv2.COLOR_GRAY2RGB)  # type: ignore[call-overload]
    path = write_video(tmp_path / "a.mov", [scene] * 3, rotation=turn, options={"crf": "1"})
    whole = list(VideoReader(path))[1]
    reader = VideoReader(path, max_width=300)
    assert (reader.height, reader.width) == ((225, 300) if turn == 0 else (400, 300))
    small = list(reader)[1][..., 1].astype(float)
    wanted = cv2.resize(whole, (300, reader.height), interpolation=cv2.INTER_AREA)[..., 1].astype(float)
    assert np.abs(small - wanted).mean() < 0.1 * wanted.std()
    down, across = np.gradient(wanted)
    slopes = np.stack([across.ravel(), down.ravel()])
    shift = np.linalg.solve(slopes @ slopes.T, slopes @ (small - wanted).ravel())  # of the whole picture, in pixels
    assert np.abs(shift).max() < 0.03
    assert next(iter(VideoReader(path, max_width=2000))).shape == whole.shape  # never larger


@pytest.mark.parametrize("matrix", ["ITU601", "ITU709"])
@pytest.mark.parametrize("full", [False, True])
def test_colors_follow_the_tags(tmp_path: Path, matrix: str, full: bool) -> None:
    colors = np.zeros((64, 96, 3), np.uint8)
    for index, color in enumerate(
        [(230, 20, 20), (20, 200, 30), (20, 30, 220), (250, 250, 250), (128, 128, 128), (9, 9, 9)]
    ):
        colors[:, index * 16 : index * 16 + 16] = color
    path = write_video(
        tmp_path / "a.mp4", [colors] * 3, matrix=matrix, full_range=full, options={"crf": "1"},
        colorspace=1 if matrix == "ITU709" else 5, color_range=2 if full else 1,
    )  # fmt: skip
    image = list(VideoReader(path))[1]
    centers = image[32, 8::16].astype(int)
    assert np.abs(centers - colors[32, 8::16]).max() <= 5


def test_ten_bits_keep_their_brightness(tmp_path: Path) -> None:
    ramp = np.linspace(10, 245, 128).astype(np.uint8)[None, :, None].repeat(96, 0).repeat(3, 2)
    options = {"x265-params": "log-level=error:crf=4"}
    path = write_video(tmp_path / "a.mp4", [ramp] * 3, codec="libx265", pixels="yuv420p10le", options=options)
    assert np.abs(next(iter(VideoReader(path))).astype(int) - ramp).max() <= 3


def copy(source: Path, target: Path, change: Callable[[Any], None], **options: Any) -> Path:
    with av.open(str(source)) as before, av.open(str(target), "w", options=options) as after:
        old = before.streams.video[0]
        new = after.add_stream_from_template(old)
        for packet in before.demux(old):
            if packet.dts is not None:
                change(packet)
                packet.stream = new
                after.mux(packet)
    return target


def test_edit_list_hides_frames_and_nothing_is_missing(tmp_path: Path) -> None:
    """A video that was cut without decoding it: the first frames are there for the others, and not to be shown."""
    source = write_video(tmp_path / "whole.mp4", 36, options={"bf": "0", "g": "100"})

    def earlier(packet: Any) -> None:
        shift = round(9 / 20 / packet.time_base)
        packet.pts, packet.dts = packet.pts - shift, packet.dts - shift

    path = copy(source, tmp_path / "cut.mp4", earlier, avoid_negative_ts="disabled")
    reader = VideoReader(path)
    assert reader.declared == 36
    frames = list(reader.frames())
    assert [number_of(frame.image) for frame in frames] == list(range(9, 36))
    assert [frame.time for frame in frames] == pytest.approx(np.arange(27) / 20, abs=1e-3)
    assert reader.missing == 0


class TestOnTheWay:
    def test_pixel_format_changes(self, tmp_path: Path) -> None:
        """As trail cameras do it: JPEGs of another subsampling after some frames."""
        parts = [
            write_video(tmp_path / f"{pixels}.mjpg", pictures, codec="mjpeg", form="mjpeg", pixels=pixels)
            for pixels, pictures in (
                ("yuvj422p", [numbered(i) for i in range(5)]),
                ("yuvj420p", [numbered(i) for i in range(5, 20)]),
            )
        ]
        joined = tmp_path / "joined.mjpg"
        joined.write_bytes(b"".join(part.read_bytes() for part in parts))
        path = copy(joined, tmp_path / "a.avi", lambda packet: None)
        frames = list(VideoReader(path))
        assert [number_of(frame) for frame in frames] == list(range(20))
        assert max(apart(frame, numbered(i)) for i, frame in enumerate(frames)) < 15

    def test_size_changes(self, tmp_path: Path) -> None:
        first = write_video(tmp_path / "a.ts", 5, form="mpegts")
        second = write_video(tmp_path / "b.ts", [numbered(i, 64, 96) for i in range(5)], form="mpegts")
        first.write_bytes(first.read_bytes() + second.read_bytes())
        with pytest.raises(DataError, match=r"changes its size from 128x96 to 96x64 .* at frame 5"):
            list(VideoReader(first))

    def test_clock_jumps_back(self, tmp_path: Path) -> None:
        """Two recordings that were joined byte by byte."""
        first = write_video(tmp_path / "a.ts", 5, form="mpegts")
        first.write_bytes(first.read_bytes() * 2)
        assert times(first) == pytest.approx(np.arange(10) / 20, abs=1e-3)

    def test_damage_in_the_middle_is_counted(self, tmp_path: Path) -> None:
        path = write_video(tmp_path / "a.mp4", 40, options={"g": "10"}, container={"movflags": "+faststart"})
        data = bytearray(path.read_bytes())
        middle = len(data) // 2
        data[middle : middle + 600] = b"\0" * 600
        path.write_bytes(data)
        reader = VideoReader(path)
        assert len(list(reader)) + reader.damaged >= 40
        assert reader.damaged >= 1
        assert reader.missing == 0


class TestBroken:
    def test_missing_empty_text(self, tmp_path: Path) -> None:
        (tmp_path / "empty.mp4").touch()
        (tmp_path / "text.mp4").write_text("no video here")
        (tmp_path / "list.ts").write_text("#EXTM3U\n#EXT-X-TARGETDURATION:5\n#EXTINF:5,\nhttp://localhost/a.ts\n")
        for name, message in (
            ("absent.mp4", "no video at"), ("empty.mp4", "0 bytes"), ("text.mp4", "not a video"), ("list.ts", "list"),
        ):  # fmt: skip
            with pytest.raises(DataError, match=message) as raised:
                VideoReader(tmp_path / name)
            assert "\n" not in str(raised.value)
        with pytest.raises(DataError, match="no video at"):
            VideoReader(tmp_path)

    def test_sound_only(self, tmp_path: Path) -> None:
        with av.open(str(tmp_path / "a.mp4"), "w") as out:
            stream: Any = out.add_stream("aac", rate=48000)
            silence = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
            silence.sample_rate = 48000
            out.mux(stream.encode(silence))
            out.mux(stream.encode(None))
        with pytest.raises(DataError, match="contains no video"):
            VideoReader(tmp_path / "a.mp4")

    @pytest.mark.parametrize(("name", "options"), [("a.avi", {"codec": "mjpeg"}), ("a.mkv", {}), ("a.mp4", {})])
    def test_truncated(self, tmp_path: Path, name: str, options: dict[str, Any]) -> None:
        path = write_video(
            tmp_path / name, 40, container={"movflags": "+faststart"} if name == "a.mp4" else {}, **options
        )
        path.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
        reader = VideoReader(path)
        found = len(list(reader))
        assert 0 < found < 40
        assert reader.missing >= 1
        if name != "a.mkv":
            assert found + reader.missing == 40

    def test_index_at_the_end_is_lost(self, tmp_path: Path) -> None:
        path = write_video(tmp_path / "a.mp4", 20)
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        with pytest.raises(DataError, match="is not a video that can be read, or is truncated"):
            VideoReader(path)

    def test_frames_of_one_color(self, tmp_path: Path) -> None:
        black = np.zeros((64, 96, 3), np.uint8)
        path = write_video(tmp_path / "a.mp4", [black] * 12)
        with pytest.raises(DataError, match=r"every one of the 12 frames .* one single color"):
            list(VideoReader(path))
        reader = VideoReader(write_video(tmp_path / "b.mp4", [black] * 4 + [numbered(i, 64, 96) for i in range(6)]))
        assert len(list(reader)) == 10
        assert reader.plain == 4

    def test_camera_that_is_not_there(self) -> None:
        with pytest.raises(DataError, match="camera 97 gives no picture"):
            CameraReader(97)


class TestWriter:
    @pytest.mark.parametrize(("codec", "tag"), [("h264", b"avc1"), ("mp4v", b"mp4v"), ("vp09", b"vp09")])
    def test_what_is_written_is_read_back_at_its_time(self, tmp_path: Path, codec: str, tag: bytes) -> None:
        true = [0.0, 0.05, 0.1, 0.25, 0.5, 0.55, 1.5]
        with VideoWriter(tmp_path / "a.mp4", 10, codec) as writer:
            for number, seconds in enumerate(true):
                writer.write(numbered(number), seconds)
        assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]
        assert tag in (tmp_path / "a.mp4").read_bytes()
        assert numbers(tmp_path / "a.mp4") == list(range(7))
        assert times(tmp_path / "a.mp4") == pytest.approx(true, abs=1e-3)
        with av.open(str(tmp_path / "a.mp4")) as made:
            context = made.streams.video[0].codec_context
            assert context.pix_fmt == "yuv420p"  # what browsers play
            assert not made.streams.audio

    def test_colors_are_those_given(self, tmp_path: Path) -> None:
        """A player that follows the tags and OpenCV both show the red that was given."""
        red = np.full((64, 64, 3), (220, 30, 40), np.uint8)
        red[:8] = 255
        with VideoWriter(tmp_path / "a.mp4", 10) as writer:
            for _ in range(3):
                writer.write(red)
        assert np.abs(next(iter(VideoReader(tmp_path / "a.mp4")))[32, 32].astype(int) - red[32, 32]).max() <= 4
        capture = cv2.VideoCapture(str(tmp_path / "a.mp4"))
        assert np.abs(capture.read()[1][32, 32, ::-1].astype(int) - red[32, 32]).max() <= 6

    def test_odd_sizes_are_made_even(self, tmp_path: Path) -> None:
        with VideoWriter(tmp_path / "a.mp4", 10) as writer:
            for number in range(3):
                writer.write(numbered(number, 31, 45))
        reader = VideoReader(tmp_path / "a.mp4")
        assert (reader.height, reader.width) == (32, 46)

    def test_refused(self, tmp_path: Path) -> None:
        with pytest.raises(ConfigError, match=r"codec is 'avc1'.*allowed: h264, mp4v, vp09"):
            VideoWriter(tmp_path / "a.mp4", 12, "avc1")
        with pytest.raises(ConfigError, match=r"suffix of a\.gif"):
            VideoWriter(tmp_path / "a.gif", 12)
        with pytest.raises(ConfigError, match="fps is 0"):
            VideoWriter(tmp_path / "a.mp4", 0)
        with VideoWriter(tmp_path / "a.mp4", 12) as writer:
            writer.write(numbered(0))
            with pytest.raises(DataError, match="frame 1 is"):
                writer.write(numbered(0, 64, 64))
        (tmp_path / "a.mp4").unlink()
        with pytest.raises(DataError, match="no frame was given"), VideoWriter(tmp_path / "a.mp4", 12):
            pass
        assert list(tmp_path.iterdir()) == []
