"""One pass over a clip into any of its results: video, files a frame, page, trajectory."""

from __future__ import annotations

import itertools
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from predicting import run

from saunet.errors import ConfigError, SaunetError
from saunet.io.colormaps import RunningRange, colorize
from saunet.io.images import read_image, write_image
from saunet.io.live import CameraReader
from saunet.io.video import VideoFrame, VideoReader, VideoWriter
from saunet.prediction.odometer import Odometer
from saunet.prediction.pointcloud import ViewerWriter
from saunet.prediction.predictor import Predictor
from saunet.runs.record import Scale

Picture = NDArray[np.uint8]
ALL = ("mp4", "color", "png16", "npy", "ply", "html", "trajectory")


def clip(count: int) -> Iterator[Picture]:
    x = np.arange(96)
    for index in range(count):
        row = (127 + 100 * np.sin((x + 4 * index) / 12)).astype(np.uint8)
        yield np.ascontiguousarray(np.broadcast_to(row[None, :, None], (48, 96, 3)))


def timed(pictures: Iterator[Picture]) -> Iterator[VideoFrame]:
    return (VideoFrame(number, number / 20, picture) for number, picture in enumerate(pictures))


@pytest.fixture
def video(tmp_path: Path) -> Path:
    with VideoWriter(tmp_path / "drive.mp4", 12.0) as writer:
        for frame in clip(5):
            writer.write(frame)
    return tmp_path / "drive.mp4"


@pytest.fixture
def odometer() -> Odometer:
    from saunet.registry import poses

    return Odometer(poses.build("posecnn"), 32, 64)


def names(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def test_pairs_of_a_clip_lie_in_its_folder_and_older_ones_go(predictor: Predictor, video: Path, tmp_path: Path) -> None:
    predictor.scale = Scale(20.0, "camera height")
    out = tmp_path / "out"
    for count in (3, 1):
        run(predictor, video, out, ["pairs"], camera=[90.0], max_frames=count, overwrite=True)
        files = [
            f"drive/{kind}/{index:06d}.{end}"
            for kind, end in (("images", "png"), ("depth", "npy"))
            for index in range(count)
        ]
        assert names(out) == sorted([*files, "camera.yaml"])
    assert "fps: 12" in (out / "camera.yaml").read_text()


def test_everything_at_once(predictor: Predictor, video: Path, tmp_path: Path, odometer: Odometer) -> None:
    before = video.read_bytes()
    out = tmp_path / "out"
    summary = run(predictor, video, out, ALL, camera=[90.0], odometer=odometer, batch_size=2)
    assert (summary.frames, summary.missing) == (5, 0)
    endings = ("_depth.npy", "_depth.png", "_disparity.png", "_points.ply")
    per_frame = [f"drive/{index:06d}{ending}" for index in range(5) for ending in endings]
    whole = [
        "drive_disparity.mp4",
        "drive_points.html",
        "drive_trajectory.png",
        "drive_trajectory.tum",
        "drive_trajectory.txt",
    ]
    assert names(out) == sorted(per_frame + whole)
    assert {str(path) for path in summary.clips} == {str(out / name) for name in (*whole, "drive")}
    assert video.read_bytes() == before
    with VideoReader(out / "drive_disparity.mp4") as reader:
        assert reader.declared == 5
        assert reader.fps == pytest.approx(12)
    assert len((out / "drive_trajectory.txt").read_text().splitlines()) == 5
    # colors follow the clip's running range, and depth is that of each frame
    limits = RunningRange()
    with VideoReader(video) as reader:
        for index, frame in enumerate(reader):
            result = predictor.predict(frame)
            assert np.allclose(np.load(out / "drive" / f"{index:06d}_depth.npy"), result.depth, rtol=1e-5)
            expected = colorize(result.disparity, limits.update(result.disparity))
            got = read_image(out / "drive" / f"{index:06d}_disparity.png").astype(int)
            assert np.abs(got - expected).max() <= 12  # one of 256 levels, as batches round differently


def test_results_are_not_replaced_unasked(predictor: Predictor, video: Path, tmp_path: Path) -> None:
    for outputs, name in ((("mp4",), "drive_disparity.mp4"), (("npy",), "drive")):
        run(predictor, video, tmp_path / "out", outputs, max_frames=2)
        with pytest.raises(ConfigError, match=f"{name} exists; choose another output folder, or set overwrite=true"):
            run(predictor, video, tmp_path / "out", outputs)
        assert run(predictor, video, tmp_path / "out", outputs, overwrite=True).frames == 5
    (tmp_path / "out" / "drive" / "notes_of_mine.txt").touch()
    run(predictor, video, tmp_path / "out", ["png16"], overwrite=True, max_frames=1)
    assert names(tmp_path / "out" / "drive") == ["000000_depth.png", "notes_of_mine.txt"]


def test_folder_whose_results_lie_inside(predictor: Predictor, tmp_path: Path) -> None:
    for index, frame in enumerate(clip(3)):
        write_image(tmp_path / "in" / f"{index}.png", frame)
    for _ in range(2):
        summary = run(predictor, tmp_path / "in", tmp_path / "in" / "depth", ["html"], camera=[90], overwrite=True)
        assert summary.frames == 3
        write_image(tmp_path / "in" / "depth" / "x.png", next(clip(1)))
    with pytest.raises(ConfigError, match="contains the input images"):
        run(predictor, tmp_path / "in", tmp_path / "in", ["mp4"])


def test_interrupt_and_failure_keep_finished_frames_and_nothing_half(predictor: Predictor, tmp_path: Path) -> None:
    def frames(error: type[BaseException]) -> Iterator[Picture]:
        yield from clip(2)
        raise error

    for error in (KeyboardInterrupt, RuntimeError):
        out = tmp_path / error.__name__
        with pytest.raises(error):
            run(predictor, frames(error), out, ["mp4", "html", "png16"], camera=[90])
        assert names(out) == ["frames/000000_depth.png", "frames/000001_depth.png"]
        assert cv2.imread(str(out / "frames" / "000001_depth.png"), cv2.IMREAD_UNCHANGED).dtype == np.uint16


def test_interrupting_a_camera_completes_everything(
    predictor: Predictor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, odometer: Odometer
) -> None:
    class Camera(CameraReader):
        def __init__(self, source: int) -> None:
            self.fps, self.height, self.width = 20.0, 48, 96

        def frames(self, fps: Any = None) -> Iterator[VideoFrame]:
            yield from timed(clip(4))
            raise KeyboardInterrupt

        def close(self) -> None:
            """Nothing to release."""

    monkeypatch.setattr("saunet.prediction.sources.CameraReader", Camera)
    summary = run(predictor, 0, tmp_path, ("mp4", "html", "trajectory"), camera=[90], odometer=odometer)
    assert summary.frames == 4
    assert names(tmp_path) == [
        "camera0_disparity.mp4", "camera0_points.html", "camera0_trajectory.png", "camera0_trajectory.tum",
        "camera0_trajectory.txt",
    ]  # fmt: skip


class RunningCamera(CameraReader):
    """Gives frames until somebody stops it."""

    def __init__(self, source: int) -> None:
        self.fps, self.height, self.width = 20.0, 48, 96

    def frames(self, fps: Any = None) -> Iterator[VideoFrame]:
        return timed(itertools.cycle(list(clip(4))))

    def close(self) -> None:
        """Nothing to release."""


@pytest.fixture
def ctrl_c(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[type, str, list[int]], None]]:
    """Press Ctrl-C right after certain calls of a method: before what called it has taken note of its end."""
    if threading.current_thread() is not threading.main_thread():
        pytest.skip("signals arrive in the main thread, and the tests run in another")
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a background shell job ignores it

    def press(owner: type, method: str, calls: list[int]) -> None:
        original, count = getattr(owner, method), itertools.count(1)

        def pressed(*arguments: Any) -> Any:
            result = original(*arguments)
            if next(count) in calls:
                signal.raise_signal(signal.SIGINT)
            return result

        monkeypatch.setattr(owner, method, pressed)

    monkeypatch.setattr("saunet.prediction.sources.CameraReader", RunningCamera)
    yield press
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(
    ("owner", "method"),
    [
        (VideoWriter, "write"),
        (ViewerWriter, "add"),
        (Odometer, "add"),
        (Predictor, "disparity"),
    ],
)
def test_ctrl_c_in_the_middle_of_a_frame_keeps_the_recording(
    predictor: Predictor, tmp_path: Path, odometer: Odometer, ctrl_c: Callable[..., None], owner: type, method: str
) -> None:
    ctrl_c(owner, method, [3])
    outputs = ("mp4", "html", "trajectory", "npy")
    summary = run(predictor, 0, tmp_path, outputs, camera=[90], odometer=odometer)
    assert summary.frames == 3
    with VideoReader(tmp_path / "camera0_disparity.mp4") as reader:
        assert len(list(reader)) == 3
    assert len((tmp_path / "camera0_trajectory.txt").read_text().splitlines()) == 3
    assert len(list((tmp_path / "camera0").iterdir())) == 3
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_ctrl_c_pressed_twice_discards_the_recording(
    predictor: Predictor, tmp_path: Path, ctrl_c: Callable[..., None]
) -> None:
    ctrl_c(ViewerWriter, "add", [2])
    ctrl_c(ViewerWriter, "add", [2])  # around the first
    with pytest.raises(KeyboardInterrupt):
        run(predictor, 0, tmp_path, ("mp4", "html"), camera=[90])
    assert names(tmp_path) == []


def test_refused(predictor: Predictor, video: Path, tmp_path: Path) -> None:
    def refused(outputs: list[str], **more: Any) -> str:
        with pytest.raises(SaunetError) as error:
            run(predictor, video, tmp_path / "out", outputs, **more)
        assert not (tmp_path / "out").exists()
        return str(error.value)

    assert "outputs is 'gif'" in refused(["gif"])
    assert "outputs is empty" in refused([])
    for output in ("ply", "html"):
        assert f"'{output}', which needs the camera's true intrinsics" in refused([output])
    assert "no checkpoint at" in refused(["trajectory"])
    assert "colormap is 'jet'" in refused(["mp4"], colormap="jet")
    assert "batch_size is 0" in refused(["mp4"], batch_size=0)


@pytest.mark.slow
def test_memory_stays_flat_over_ten_thousand_frames(predictor: Predictor, tmp_path: Path, odometer: Odometer) -> None:
    """All of a clip's results at once but those a frame; the page goes to disk as it is made."""
    if not Path("/proc/self/statm").exists():
        pytest.skip("no /proc to read the memory in use from")
    import os
    import tracemalloc

    used: list[tuple[float, float]] = []

    def frames() -> Iterator[Picture]:
        for index, frame in enumerate(itertools.islice(itertools.cycle(list(clip(12))), 10_000)):
            if index % 1000 == 999:
                pages = int(Path("/proc/self/statm").read_text().split()[1])
                used.append((pages * os.sysconf("SC_PAGE_SIZE") / 2**20, tracemalloc.get_traced_memory()[0] / 2**20))
            yield frame

    tracemalloc.start()
    try:
        summary = run(predictor, frames(), tmp_path, ("mp4", "trajectory"), odometer=odometer, batch_size=4)
    finally:
        tracemalloc.stop()
    assert summary.frames == 10_000
    resident, traced = (np.array(column) for column in zip(*used, strict=True))
    print(f"resident MB every 1000 frames: {resident.round(1)}; of Python objects: {traced.round(2)}", file=sys.stderr)
    assert resident[-1] - resident[0] < 20
    assert traced[-1] - traced[0] < 10  # 10 000 poses are 1.3 MB, and their motions as much
