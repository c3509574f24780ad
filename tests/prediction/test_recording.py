"""Images into files and into a clip's results: one pass, and a finished or interrupted run goes on where it stopped."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from predicting import run as predict_into

from saunet.errors import ConfigError, DataError
from saunet.io.images import read_image, write_image
from saunet.io.video import VideoReader
from saunet.prediction.prediction import ImagePredictor
from saunet.prediction.predictor import Predictor
from saunet.prediction.sources import Recording
from saunet.prediction.tool import PredictResult

OUTPUTS = ("color", "npy", "mp4", "html")


@pytest.fixture
def frames(tmp_path: Path, picture: NDArray[np.uint8]) -> Path:
    """Four frames; sorted as text, the last would be the second."""
    for index, number in enumerate((1, 2, 3, 10)):
        write_image(tmp_path / "drive" / f"frame_{number}.png", np.roll(picture, 20 * index, axis=1))
    return tmp_path / "drive"


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many images each run of the network gets."""
    batches: list[int] = []
    original = Predictor.disparity

    def counted(self: Predictor, images: Any) -> Any:
        batches.append(len(images))
        return original(self, images)

    monkeypatch.setattr(Predictor, "disparity", counted)
    return batches


@pytest.fixture
def run(predictor: Predictor, frames: Path, tmp_path: Path) -> Callable[..., PredictResult]:
    def now(outputs: Any = OUTPUTS, **more: Any) -> PredictResult:
        return predict_into(predictor, frames, tmp_path / "out", outputs, camera=[90], batch_size=2, **more)

    return now


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*.*")}


def test_one_pass_gives_what_two_gave(
    run: Callable[..., PredictResult], predictor: Predictor, frames: Path, tmp_path: Path, seen: list[int]
) -> None:
    summary = run()
    assert seen == [2, 2]
    assert (summary.frames, len(summary.written), summary.skipped) == (4, 8, 0)
    predict_into(predictor, frames, tmp_path / "two", ("color", "npy"), batch_size=2)
    predict_into(predictor, frames, tmp_path / "two", ("mp4", "html"), camera=[90], batch_size=2, overwrite=True)
    found, wanted = content(tmp_path / "out"), content(tmp_path / "two")
    assert found.keys() == wanted.keys()
    for name in found.keys() - {"predictions.json", "drive_disparity.mp4"}:  # an mp4 may hold the time of day
        assert found[name] == wanted[name], name
    with (
        VideoReader(tmp_path / "out" / "drive_disparity.mp4") as one,
        VideoReader(tmp_path / "two" / "drive_disparity.mp4") as two,
    ):
        assert [frame.tobytes() for frame in one] == [frame.tobytes() for frame in two]


def test_what_is_finished_is_skipped_and_the_rest_made(
    run: Callable[..., PredictResult], frames: Path, tmp_path: Path, seen: list[int]
) -> None:
    first = run()
    before = content(tmp_path / "out")
    seen.clear()
    again = run()
    assert (seen, again.clips, again.finished, again.skipped) == ([], (), first.clips, 4)
    assert content(tmp_path / "out") == before
    (tmp_path / "out" / "frame_2_depth.npy").unlink()
    run()
    assert seen == [1]  # a file is missing: its image alone
    (tmp_path / "out" / "drive_points.html").unlink()
    seen.clear()
    third = run()
    assert seen == [2, 2]
    assert [path.name for path in third.clips] == ["drive_points.html"]
    assert third.written == ()
    assert content(tmp_path / "out").keys() == before.keys()
    assert run(["mp4"]).finished == (tmp_path / "out" / "drive_disparity.mp4",)


def test_clip_is_made_again_of_new_images(
    run: Callable[..., PredictResult], frames: Path, tmp_path: Path, picture: NDArray[np.uint8]
) -> None:
    made = run(["mp4"]).clips[0]
    write_image(frames / "frame_11.png", picture)
    old = made.stat().st_mtime - 1000
    os.utime(frames / "frame_11.png", (old, old))  # copied with its date
    assert run(["mp4"]).clips == (made,)
    with VideoReader(made) as reader:
        assert reader.declared == 5
    later = made.stat().st_mtime + 1000
    os.utime(frames / "frame_3.png", (later, later))
    assert run(["mp4"]).clips == (made,)


def test_what_others_made_is_not_replaced_unasked(
    run: Callable[..., PredictResult], predictor: Predictor, frames: Path, tmp_path: Path
) -> None:
    made = run(["mp4"]).clips[0]
    before = made.read_bytes()
    for setting in ({"layout": "beside"}, {"fps": 30}, {"range_smoothing": 0.5}, {"codec": "vp09"}):
        with pytest.raises(ConfigError, match=r"drive_disparity\.mp4 exists; .* set overwrite=true"):
            run(["mp4"], **setting)
    with pytest.raises(ConfigError, match=r"holds predictions made with different settings \(colormap\);"):
        run(["mp4"], colormap="turbo")
    assert made.read_bytes() == before
    assert run(["mp4"], fps=30, overwrite=True).clips == (made,)
    assert run(["mp4"], fps=30).finished == (made,)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "drive_disparity.mp4").touch()
    with pytest.raises(ConfigError, match=r"drive_disparity\.mp4 exists"):
        predict_into(predictor, frames, tmp_path / "other", ["mp4"])


def test_broken_image_costs_the_clip_and_no_other_image(
    run: Callable[..., PredictResult], frames: Path, tmp_path: Path, seen: list[int]
) -> None:
    (frames / "frame_2.png").write_bytes(b"")
    with pytest.raises(
        DataError, match=r"frame_2\.png is empty .*; drive_disparity\.mp4, drive_points\.html would lack"
    ):
        run()
    assert len(list((tmp_path / "out").glob("*.npy"))) == 3
    assert not list((tmp_path / "out").glob("drive_*"))
    seen.clear()
    with pytest.raises(DataError, match=r"frame_2\.png is empty"):
        run(["mp4"])
    assert seen == []  # without files, nothing is left to do after it


def test_interrupt_keeps_single_files_and_the_next_run_goes_on(
    run: Callable[..., PredictResult], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = ImagePredictor.predict_batch
    runs: list[int] = []

    def interrupted(self: ImagePredictor, *arguments: Any) -> Any:
        runs.append(1)
        if len(runs) == 2:
            raise KeyboardInterrupt
        return original(self, *arguments)

    monkeypatch.setattr(ImagePredictor, "predict_batch", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run()
    assert sorted(path.name for path in (tmp_path / "out").glob("*.*")) == [
        "frame_1_depth.npy", "frame_1_disparity.png", "frame_2_depth.npy", "frame_2_disparity.png", "predictions.json",
    ]  # fmt: skip
    summary = run()
    assert len(summary.written) == 4
    assert len(summary.clips) == 2


def test_first_images_only(run: Callable[..., PredictResult], tmp_path: Path) -> None:
    assert run(max_frames=3).frames == 3
    assert read_image(tmp_path / "out" / "frame_3_disparity.png").shape == (40, 90, 3)
    assert not (tmp_path / "out" / "frame_10_disparity.png").exists()


def test_stamps_in_names_are_the_times_of_results(
    predictor: Predictor, picture: NDArray[np.uint8], tmp_path: Path
) -> None:
    stamps = [1_700_000_000.0, 1_700_000_000.1, 1_700_000_000.25, 1_700_000_001.5]
    for number, stamp in enumerate(stamps):
        write_image(tmp_path / "drive" / f"{stamp}.png", np.roll(picture, 20 * number, axis=1))
    recording = Recording(tmp_path / "drive")
    assert (recording.timed, [frame.time for frame in recording]) == (True, stamps)
    assert recording.fps == pytest.approx(1 / 0.15)
    predict_into(predictor, tmp_path / "drive", tmp_path / "out", ("mp4",))
    (video,) = (tmp_path / "out").rglob("*.mp4")
    assert [frame.time for frame in VideoReader(video).frames()] == pytest.approx([0, 0.1, 0.25, 1.5], abs=1e-3)
    write_image(tmp_path / "drive" / "first.png", picture)
    assert not Recording(tmp_path / "drive").timed
