"""Videos in and out: every frame arrives, colors are stable, nothing half-written stays."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from predicting import run
from processes import python
from videos import write_video

from saunet.errors import ConfigError, DataError
from saunet.io.colormaps import RunningRange
from saunet.io.images import write_image
from saunet.io.live import CameraReader
from saunet.io.video import VideoFrame, VideoReader, VideoWriter
from saunet.prediction.predictor import Predictor
from saunet.prediction.sinks import compose
from saunet.prediction.sources import find_sources

Picture = NDArray[np.uint8]


def clip(count: int, height: int = 48, width: int = 96) -> Iterator[Picture]:
    x = np.arange(width)
    for index in range(count):
        row = (127 + 100 * np.sin((x + 4 * index) / 12)).astype(np.uint8)
        yield np.ascontiguousarray(np.broadcast_to(row[None, :, None], (height, width, 3)))


@pytest.fixture
def video(tmp_path: Path) -> Path:
    with VideoWriter(tmp_path / "in.mp4", 12.0) as writer:
        for frame in clip(9):
            writer.write(frame)
    return tmp_path / "in.mp4"


def test_side_by_side_from_file(predictor: Predictor, video: Path, tmp_path: Path) -> None:
    before = video.read_bytes()
    summary = run(predictor, video, tmp_path / "new")
    assert (summary.frames, summary.missing) == (9, 0)
    with VideoReader(summary.clips[0]) as reader:
        assert (reader.height, reader.width) == (2 * (48 + 14), 96)
        assert len(list(reader)) == 9
    assert video.read_bytes() == before
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["in_disparity.mp4"]


def test_side_by_side_from_frames(predictor: Predictor, tmp_path: Path) -> None:
    summary = run(predictor, clip(5), tmp_path, fps=7, layout="beside", colormap="turbo", max_frames=4)
    with VideoReader(summary.clips[0]) as reader:
        assert (reader.height, reader.width, reader.declared) == (48 + 14, 192, 4)
        assert reader.fps == pytest.approx(7, rel=1e-3)


def test_layouts() -> None:
    wide, tall = np.zeros((10, 40, 3), np.uint8), np.zeros((40, 10, 3), np.uint8)
    assert compose(wide, wide).shape == (20, 40, 3)
    assert compose(tall, tall).shape == (40, 20, 3)
    assert compose(wide, wide, "beside").shape == (10, 80, 3)
    assert compose(wide, np.zeros((5, 20, 3), np.uint8), "stacked").shape == (20, 40, 3)


def test_colors_are_stable_over_a_clip() -> None:
    """One outlying frame moves the limits by a twentieth of what it would alone; they then come back."""
    limits = RunningRange(0.95)
    ramp = np.linspace(0.1, 0.5, 1000, dtype=np.float32).reshape(20, 50)
    first = limits.update(ramp)
    alone = RunningRange(0.0).update(ramp * 3)
    jumped = limits.update(ramp * 3)
    assert jumped[1] - first[1] == pytest.approx(0.05 * (alone[1] - first[1]), rel=1e-4)
    for _ in range(200):
        last = limits.update(ramp)
    assert last == pytest.approx(first, rel=1e-4)
    with pytest.raises(ConfigError, match="range_smoothing is 1"):
        RunningRange(1.0)


def test_folder_of_images_and_truncated_ones(predictor: Predictor, tmp_path: Path) -> None:
    for index, frame in enumerate(clip(3)):
        write_image(tmp_path / "in" / f"{index}.png", frame)
    for index, source in enumerate((tmp_path / "in", str(tmp_path / "in" / "*.png"))):
        assert run(predictor, source, tmp_path / str(index), ["mp4"]).frames == 3
    (tmp_path / "in" / "1.png").write_bytes(b"")
    with pytest.raises(DataError, match=r"1\.png is empty"):
        run(predictor, tmp_path / "in", tmp_path / "out", ["mp4"])
    assert not list((tmp_path / "out").glob("*"))


def test_truncated_stream_gives_what_is_there_and_says_so(predictor: Predictor, tmp_path: Path) -> None:
    path = write_video(tmp_path / "x.avi", 20, codec="mjpeg")
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    summary = run(predictor, path, tmp_path / "out")
    assert 5 < summary.frames < 15
    assert summary.exit_code == 1
    assert "truncated" in summary.failures[0]
    assert summary.frames + summary.missing == 20


@pytest.mark.slow
def test_memory_stays_flat_over_a_long_clip(predictor: Predictor, tmp_path: Path) -> None:
    used: list[float] = []

    def frames() -> Iterator[Picture]:
        for index, frame in enumerate(itertools.islice(itertools.cycle(list(clip(12))), 10_000)):
            if index % 1000 == 999:
                pages = int(Path("/proc/self/statm").read_text().split()[1])
                used.append(pages * os.sysconf("SC_PAGE_SIZE") / 2**20)
            yield frame

    if not Path("/proc/self/statm").exists():
        pytest.skip("no /proc to read the memory in use from")
    assert run(predictor, frames(), tmp_path).frames == 10_000
    assert used[-1] - used[0] < 10, f"MB in use every 1000 frames: {used}"


class FakeCamera(CameraReader):
    """Gives three frames; then the user has seen enough."""

    def __init__(self, source: int) -> None:
        assert source == 0
        self.fps, self.height, self.width = 20.0, 48, 96

    def frames(self, fps: float | int | None = None) -> Iterator[VideoFrame]:
        yield from (VideoFrame(number, number / 20, picture) for number, picture in enumerate(clip(3)))
        raise KeyboardInterrupt

    def close(self) -> None:
        """Nothing to release."""


class TestUnfinished:
    def test_interrupting_a_camera_finishes_its_video(
        self, predictor: Predictor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("saunet.prediction.sources.CameraReader", FakeCamera)
        assert run(predictor, "0", tmp_path).frames == 3
        with VideoReader(tmp_path / "camera0_disparity.mp4") as reader:
            assert reader.declared == 3

    def test_error_and_interrupt_leave_nothing(self, predictor: Predictor, tmp_path: Path) -> None:
        def frames(error: type[BaseException]) -> Iterator[Picture]:
            yield from clip(2)
            raise error

        for error in (KeyboardInterrupt, RuntimeError):
            with pytest.raises(error):
                run(predictor, frames(error), tmp_path)
            assert list(tmp_path.iterdir()) == []

    def test_older_file_survives_a_failure(self, predictor: Predictor, video: Path) -> None:
        before = video.read_bytes()
        older = video.rename(video.with_name("frames_disparity.mp4"))
        with pytest.raises(DataError, match="frame 1 is"):
            run(predictor, [np.zeros((side, 32, 3), np.uint8) for side in (32, 16)], older.parent, overwrite=True)
        assert older.read_bytes() == before
        assert list(older.parent.iterdir()) == [older]

    def test_no_frame_given(self, predictor: Predictor, tmp_path: Path) -> None:
        with pytest.raises(DataError, match=r"no frame was given, so .*frames_disparity\.mp4 was not written"):
            run(predictor, iter([]), tmp_path)
        assert list(tmp_path.iterdir()) == []

    def test_full_disk(self, tmp_path: Path) -> None:
        """A file size limit in a process of its own stands for a full disk."""
        code = (
            "import resource, signal, sys, numpy as np\n"
            "from saunet.errors import DataError\n"
            "from saunet.io.video import VideoWriter\n"
            "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
            "resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000))\n"
            "noise = np.random.default_rng(0)\n"
            "try:\n"
            "    with VideoWriter(sys.argv[1], 10) as writer:\n"
            "        for _ in range(30):\n"
            "            writer.write(noise.integers(0, 255, (64, 64, 3), dtype=np.uint8))\n"
            "except DataError as error:\n    print(error)\n"
        )
        target = tmp_path / "x.mp4"
        result = python("-c", code, str(target))
        assert result.returncode == 0, result.stderr
        assert f"{target}" in result.stdout
        assert "disk full" in result.stdout or "space" in result.stdout
        assert list(tmp_path.iterdir()) == []


def test_times_are_kept(predictor: Predictor, tmp_path: Path) -> None:
    """A phone's video at 20, then 10 frames per second, cut out of a longer one."""
    true = [0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 1.0]
    path = write_video(tmp_path / "phone.mp4", 8, times=true)
    made = run(predictor, path, tmp_path / "out").clips[0]
    assert [frame.time for frame in VideoReader(made).frames()] == pytest.approx(true, abs=1e-3)
    slow = run(predictor, path, tmp_path / "out", fps=5, overwrite=True).clips[0]
    assert [frame.time for frame in VideoReader(slow).frames()] == pytest.approx(np.arange(8) / 5, abs=1e-3)


def test_what_is_no_frame_of_the_user_is_not_read(predictor: Predictor, tmp_path: Path) -> None:
    """Resource forks of macOS, thumbnails of a NAS, checkpoints of notebooks; and folders behind links are read."""
    for index, name in enumerate(
        ("a/0.png", "a/@eaDir/0.png/THUMB.jpg", "a/.ipynb_checkpoints/0.png", "elsewhere/1.png")
    ):
        write_image(tmp_path / name, next(clip(1 + index)))
    (tmp_path / "a" / "._0.png").write_bytes(b"\0\5\x16\7")
    (tmp_path / "a" / "link").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "elsewhere" / "back").symlink_to(tmp_path / "a")
    assert [source.stem for source in find_sources(tmp_path / "a", tmp_path / "out")] == ["0", "link/1"]


class TestRefused:
    def test_output(self, predictor: Predictor, video: Path, tmp_path: Path) -> None:
        (tmp_path / "file").touch()
        with pytest.raises(DataError, match="cannot write"):
            run(predictor, video, tmp_path / "file")

    def test_words_and_numbers(self, predictor: Predictor, video: Path, tmp_path: Path) -> None:
        for name, value in (("layout", "side"), ("fps", 0.0), ("codec", "avc1"), ("range_smoothing", 1.0)):
            with pytest.raises(ConfigError, match=f"{name} is '?{value}"):
                run(predictor, video, tmp_path / "x", **{name: value})  # type: ignore[arg-type]
        assert not (tmp_path / "x").exists()
