"""A camera of one's own, from calibration to prediction, on the command line."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import saunet
from saunet.data.kitti.raw import KittiRaw
from saunet.data.video.camera import CameraFile, Lens, write_camera
from saunet.io.images import read_image
from saunet.tools.calibrate.solve import Board

Tool = Callable[..., Any]
TINY = (
    "experiment=selfsup",
    "model=sau_net_nano",
    "model/pose=posecnn",
    "trainer=smoke",
    "logger=none",
    "data=video",
    "data.frames_cache=cache",
    "data.workers=0",
    "data.batch_size=2",
    "data.height=64",
    "data.width=192",
)


@pytest.fixture(autouse=True)
def _one_thread() -> Any:
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    yield
    cv2.setNumThreads(before)


def _video(path: Path, frames: list[Any], fps: float = 10) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), fps, frames[0].shape[1::-1])
    for frame in frames:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
    writer.release()


def _sliding(count: int) -> list[Any]:
    noise = np.random.default_rng(0).integers(0, 255, (40, 200, 3), dtype=np.uint8)
    world = cv2.resize(noise, (800, 160), interpolation=cv2.INTER_CUBIC)
    return [np.ascontiguousarray(world[:, 4 * place : 4 * place + 320]) for place in range(count)]


def _camera(folder: Path) -> None:
    K = np.array([[250.0, 0, 160], [0, 250, 80], [0, 0, 1]])
    write_camera(folder / "camera.yaml", CameraFile(folder, K, (160, 320), camera_height=1.4))


@pytest.mark.data
def test_a_video_of_a_real_drive_goes_all_the_way(tool: Tool, kitti_mini: Path, tmp_path: Path) -> None:
    raw = KittiRaw(kitti_mini / "raw")
    drive = raw.drive(next(name for name in raw.drives if "9005" in name))
    small = [cv2.resize(drive.image(index), (414, 126), interpolation=cv2.INTER_AREA) for index in drive.indices]
    _video(tmp_path / "campus" / "my drive.avi", small)
    K = drive.intrinsics(0)  # of the original size: the video is the same picture, smaller
    write_camera(tmp_path / "campus" / "camera.yaml", CameraFile(Path(), K, (375, 1242), camera_height=1.65))

    looked = tool("doctor", "data=video", "data.root=campus", "data.frames_cache=cache", "output_dir=doctor")
    assert looked.code == 0, looked.err + looked.out
    for words in ("horizontal field of view 81 degrees", "camera height 1.65 m", "motion between frames 1 apart"):
        assert words in looked.out
    assert read_image(tmp_path / "doctor" / "doctor.png").shape[1] == 1312
    manifest = json.loads((tmp_path / "doctor" / "manifest.json").read_text())
    assert manifest["splits"]["train"]["samples"] == 40
    assert manifest["leave_out"] == {}

    trained = tool("train", *TINY, "data.root=campus", "data.manifest=doctor/manifest.json", "output_dir=run")
    assert trained.code == 0, trained.err
    assert "training and validation share 'my drive.avi'" in trained.err
    for said in (looked.out, trained.err, (tmp_path / "run" / "train.log").read_text()):
        assert "camera: campus/camera.yaml" in said
    predicted = tool("predict", "checkpoint=run/checkpoints/last.ckpt", "input=campus/my drive.avi", "output=out")
    assert predicted.code == 0, predicted.err
    assert "48 frames" in predicted.out
    frames = tmp_path / "frames"
    frames.mkdir()
    for place in (0, 1):
        cv2.imwrite(str(frames / f"{place}.png"), small[place])
    predicted = tool("predict", "checkpoint=run/checkpoints/last.ckpt", "input=frames", "output=out", "outputs=[npy]")
    assert predicted.code == 0, predicted.err
    depth = np.load(tmp_path / "out" / "0_depth.npy")
    assert depth.shape == (126, 414)
    assert np.isfinite(depth).all()
    scored = tool(
        "evaluate", "checkpoint=run/checkpoints/last.ckpt", *TINY[5:8], "data.root=campus", "output_dir=results"
    )
    assert scored.code == 0, scored.err
    assert "campus" in scored.out
    assert "mean depth map" not in scored.err  # nothing to compare it with


def test_the_doctor_ends_with_an_error_where_training_would(tool: Tool, tmp_path: Path) -> None:
    _video(tmp_path / "clips" / "a.avi", _sliding(14))
    arguments = ("data=video", "data.root=clips", "data.frames_cache=cache", "output_dir=doctor")
    outcome = tool("doctor", *arguments)
    assert outcome.code == 1
    assert "error: the train, val and test splits cannot be used: no camera.yaml" in outcome.out
    assert "data.manifest" not in outcome.out  # nothing was judged
    assert (tmp_path / "doctor" / "doctor.png").is_file()
    _camera(tmp_path / "clips")
    outcome = tool("doctor", *arguments, "data.val_share=0.3")
    assert outcome.code == 0, outcome.out
    assert "note: training and validation share 'a.avi'" in outcome.out
    left_out = re.search(r"lists (\d+) frames? to leave out \(checked: all\)", outcome.out)
    assert left_out
    assert ("train with data.manifest=doctor/manifest.json" in outcome.out) == (left_out[1] != "0")
    assert "(checked: 5 of 14; frames=0 checks all)" in tool("doctor", *arguments, "data.val_share=0.3", "frames=5").out
    tool("doctor", *arguments, "splits=[tset]").says("splits is 'tset'; did you mean 'test'?")


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("data.root=gone", ("no data root at", "gone", "set data.root")),
        ("data.manifest=gone.json", ("no manifest at gone.json",)),
        ("data.crop=[0.9]", ("crop is [0.9]",)),
        ("data.val_clips=[b]", ("val_clips names 'b', which matches no clip; clips: a.avi",)),
        ("data.camera=gone.yaml", ("no camera file at gone.yaml", "saunet calibrate")),
        ("data=mixed ~data.frames_cache", ("data=mixed has no sources",)),
    ],
)
def test_mistakes_end_in_one_sentence(tool: Tool, tmp_path: Path, override: str, words: tuple[str, ...]) -> None:
    _video(tmp_path / "clips" / "a.avi", _sliding(14))
    _camera(tmp_path / "clips")
    arguments = [*TINY, "data.root=clips"]
    if "data=mixed" in override:
        override, arguments = "", ["data=mixed", "experiment=selfsup", "trainer=smoke"]
    tool("train", *arguments, *override.split()).says(*words)


def test_a_damaged_video_and_a_wrong_camera_are_named(tool: Tool, tmp_path: Path) -> None:
    _video(tmp_path / "clips" / "a.avi", _sliding(14))
    _camera(tmp_path / "clips")
    camera = tmp_path / "clips" / "camera.yaml"
    camera.write_text(camera.read_text().replace("250.0", ".nan", 1))
    tool("train", *TINY, "data.root=clips").says("camera.yaml: K needs 4 or 9 finite numbers")
    _camera(tmp_path / "clips")
    video = tmp_path / "clips" / "a.avi"
    video.write_bytes(video.read_bytes()[:500])
    tool("train", *TINY, "data.root=clips").says("a.avi", "is not a video that can be read, or is truncated")


def test_data_sets_are_mixed_by_config(tool: Tool, raw_root: Path, tmp_path: Path) -> None:
    _video(tmp_path / "clips" / "a.avi", _sliding(14))
    _camera(tmp_path / "clips")
    mixture = (
        "data=mixed",
        "+data@data.sources.town=kitti",
        "+data@data.sources.campus=video",
        f"data.sources.town.root={raw_root}",
        "data.sources.town.split=all",
        "data.sources.town.cameras=[left]",
        "data.sources.town.val_drives=[2011_09_26_drive_0002_sync]",
        "data.sources.campus.root=clips",
        "data.sources.campus.frames_cache=cache",
        "data.workers=0",
        "data.batch_size=2",
    )
    outcome = tool(
        "train", *TINY[:5], *mixture, "data.height=64", "data.width=96", "output_dir=run",
    )  # fmt: skip
    assert outcome.code == 0, outcome.err
    outcome = tool("evaluate", "checkpoint=run/checkpoints/last.ckpt", *mixture, "output_dir=results")
    assert outcome.code == 0, outcome.err
    all_of, _, alone = outcome.out.partition("town alone:")
    town, _, campus = alone.partition("campus alone:")
    for words in ("eigen_camera_z: the same points", "campus: no ground truth"):
        assert words in all_of
        assert words in town
    assert "eigen_camera_z" not in campus  # clips have no ground truth
    assert "campus: no ground truth" in campus
    assert "nan" not in outcome.out
    height = ("scale.method=camera_height", "protocols=[eigen_camera_z]", "data.test=[town]", "data.train=[town]")
    told = tool("evaluate", "checkpoint=run/checkpoints/last.ckpt", *mixture, *height, "output_dir=scaled")
    assert "needs scale.camera_height" not in told.err


def test_a_board_is_printed_and_found(tool: Tool, tmp_path: Path) -> None:
    assert tool("calibrate", "print_board=board.png").code == 0
    assert np.array_equal(read_image(tmp_path / "board.png")[..., 0], Board().picture())
    tool("calibrate").says("set one of input and video", "input=board.mp4")
    (tmp_path / "pictures").mkdir()
    cv2.imwrite(str(tmp_path / "pictures" / "a.png"), cv2.resize(Board().picture(), (480, 360)))
    outcome = tool("calibrate", "input=pictures", "output=camera.yaml")
    outcome.says("was found in 1 of 1 pictures of pictures", "at least 8")
    assert not (tmp_path / "camera.yaml").exists()
    (tmp_path / "camera.yaml").write_text("mine")
    tool("calibrate", "input=pictures").says("camera.yaml exists; choose another output, or set overwrite=true")
    assert (tmp_path / "camera.yaml").read_text() == "mine"


def test_prediction_sees_what_training_saw(tool: Tool, smoke_run: Path, tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    cv2.imwrite(str(tmp_path / "in" / "a.png"), _sliding(1)[0])
    K = np.array([[250.0, 0, 160], [0, 250, 80], [0, 0, 1]])
    camera = CameraFile(Path(), K, (160, 320), (-0.2, 0.05, 0.0, 0.0), crop=(0.25, 0.0, 0.0, 0.0))
    write_camera(tmp_path / "camera.yaml", camera)
    arguments = (f"checkpoint={smoke_run / 'checkpoints' / 'best.ckpt'}", "input=in", "output=out")
    outcome = tool("predict", *arguments, "outputs=[npy,ply]", "undistort=camera.yaml")
    assert outcome.code == 0, outcome.err
    straight = Lens(camera, 160, 320)(read_image(tmp_path / "in" / "a.png"))
    expected = saunet.load(smoke_run / "checkpoints" / "best.ckpt").predict(straight).depth
    np.testing.assert_allclose(np.load(tmp_path / "out" / "a_depth.npy"), expected, rtol=1e-4)
    assert expected.shape == (120, 320)
    assert (tmp_path / "out" / "a_points.ply").is_file()
    tool("predict", *arguments, "outputs=[npy]").says("made with different settings (undistort")
    tool("predict", *arguments, "undistort=camera.yaml", "camera=[1,2,3,4]").says("camera and undistort are both set")
    tool("predict", *arguments, "undistort=gone.yaml").says("no camera file at gone.yaml")
