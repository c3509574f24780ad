"""``saunet predict``: point clouds, colors, videos, and what does not apply to a video."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from processes import python
from torch import nn

import saunet
from saunet.io.images import read_image
from saunet.io.video import VideoReader, VideoWriter
from saunet.prediction.pointcloud import Camera, point_cloud
from saunet.runs.checkpoint import atomic_save, build_networks
from saunet.runs.record import ModelRecord


@pytest.fixture(scope="module")
def checkpoint(node: Callable[..., dict[str, Any]], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An untrained model on disk."""
    encoder = {**node("encoder", "resnet18"), "blocks": [1, 1, 1, 1]}
    decoder = {**node("decoder", "unet"), "channels": [8] * 5}
    record = ModelRecord(encoder, decoder, None, min_depth=0.1, max_depth=100.0, height=32, width=64)
    depth, _ = build_networks(record)
    path = tmp_path_factory.mktemp("model") / "x.ckpt"
    state = dict(nn.ModuleDict({"depth": depth}).state_dict())
    atomic_save({"state_dict": state, "saunet": record.to_plain(), "epoch": 0, "global_step": 0}, path)
    return path


@pytest.fixture
def image(tmp_path: Path) -> Path:
    """A picture in the folder where the tool runs."""
    noise = np.random.default_rng(0).integers(0, 255, (6, 9, 3), dtype=np.uint8)
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), cv2.resize(noise, (90, 60)))
    return path


@pytest.fixture
def video(tmp_path: Path, image: Path) -> Path:
    """Two frames."""
    with VideoWriter(tmp_path / "drive.mp4", 10) as writer:
        for _ in range(2):
            writer.write(read_image(image))
    return tmp_path / "drive.mp4"


def test_what_a_clip_looks_like_can_be_chosen(
    tool: Callable[..., Any], checkpoint: Path, video: Path, image: Path, tmp_path: Path
) -> None:
    for source, name in (("drive.mp4", "drive"), ("*.png", tmp_path.name)):
        outcome = tool(
            "predict", f"checkpoint={checkpoint}", f"input={source}", "output=out", "outputs=[mp4]",
            "fps=30", "layout=beside", "codec=vp09", "range_smoothing=0",
        )  # fmt: skip
        assert outcome.code == 0, outcome.err
        with VideoReader(tmp_path / "out" / f"{name}_disparity.mp4") as reader:
            assert reader.fps == pytest.approx(30, rel=1e-3)
            assert reader.width > reader.height
            assert f"{name}_disparity.mp4 ({reader.width}x{reader.height}, 30 fps)" in outcome.out
    refused = tool("predict", f"checkpoint={checkpoint}", "input=drive.mp4", "output=out2", "codec=avc1")
    refused.says("codec is 'avc1'", "allowed: h264, mp4v, vp09")


def test_number_of_frames(tool: Callable[..., Any], checkpoint: Path, video: Path, image: Path, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "b.png"), cv2.imread(str(image)))
    for source, name in (("drive.mp4", "drive/000000_depth.npy"), ("*.png", "a_depth.npy")):
        arguments = (f"checkpoint={checkpoint}", f"input={source}", f"output=out_{source[-3:]}", "outputs=[npy]")
        for wrong in (-1, 0):
            tool("predict", *arguments, f"max_frames={wrong}").says(f"max_frames is {wrong}; it must be greater than 0")
        assert tool("predict", *arguments, "max_frames=1").code == 0
        folder = tmp_path / f"out_{source[-3:]}"
        assert [str(path.relative_to(folder)) for path in folder.rglob("*.npy")] == [name]


def test_point_clouds_need_the_camera_and_get_it(
    tool: Callable[..., Any], checkpoint: Path, image: Path, tmp_path: Path
) -> None:
    arguments = (f"checkpoint={checkpoint}", "input=a.png", "output=out", "outputs=[ply]")
    refused = tool("predict", *arguments)
    assert refused.code == 1
    assert "needs the camera's true intrinsics" in refused.err
    outcome = tool("predict", *arguments, "camera=[80,80,44.5,29.5]")
    assert outcome.code == 0, outcome.err
    prediction = saunet.load(checkpoint).predict(image)
    point_cloud(prediction, Camera.from_numbers((80, 80, 44.5, 29.5), 60, 90)).save(tmp_path / "x.ply")
    assert (tmp_path / "out" / "a_points.ply").read_bytes() == (tmp_path / "x.ply").read_bytes()
    assert "intrinsics have 3 numbers" in tool("predict", *arguments, "camera=[80,80,44.5]").err
    (tmp_path / "camera.yaml").write_text("image_size: [90, 60]\nK: [80, 80, 44.5, 29.5]\n")
    assert tool("predict", *arguments[:2], "output=out_file", "outputs=[ply]", "camera=camera.yaml").code == 0
    assert (tmp_path / "out_file" / "a_points.ply").read_bytes() == (tmp_path / "x.ply").read_bytes()
    (tmp_path / "camera.yaml").write_text("image_size: [90, 60]\nK: [80, 80, 44.5, 29.5]\ndistortion: [0.1, 0, 0, 0]\n")
    refused = tool("predict", *arguments[:2], "output=o", "outputs=[ply]", "camera=camera.yaml")
    refused.says("lens with distortion", "set undistort=camera.yaml")


def test_colormap_and_keep_aspect(tool: Callable[..., Any], checkpoint: Path, image: Path, tmp_path: Path) -> None:
    arguments = (f"checkpoint={checkpoint}", "input=a.png", "colormap=turbo", "keep_aspect=true")
    outcome = tool("predict", *arguments, "output=out")
    assert outcome.code == 0, outcome.err
    from saunet.prediction.predictor import Predictor

    expected = Predictor.from_checkpoint(checkpoint, keep_aspect=True).predict(image).color(None, "turbo")
    assert np.array_equal(read_image(tmp_path / "out" / "a_disparity.png"), expected)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.png", "out"]  # no run folder, no log
    assert "did you mean 'turbo'" in tool("predict", *arguments, "colormap=turbi", "output=out2").err
    assert not (tmp_path / "out2").exists()


def test_video_is_written_once(tool: Callable[..., Any], checkpoint: Path, video: Path, tmp_path: Path) -> None:
    arguments = (f"checkpoint={checkpoint}", "input=drive.mp4", "output=out")
    first = tool("predict", *arguments)
    assert first.code == 0, first.err
    assert "2 frames" in first.out
    before = (tmp_path / "out" / "drive_disparity.mp4").stat().st_mtime_ns
    again = tool("predict", *arguments)
    assert again.code == 1
    assert "drive_disparity.mp4 exists; choose another output folder, or set overwrite=true" in again.err
    assert (tmp_path / "out" / "drive_disparity.mp4").stat().st_mtime_ns == before
    assert tool("predict", *arguments, "overwrite=true").code == 0


def test_video_into_everything(tool: Callable[..., Any], checkpoint: Path, video: Path, tmp_path: Path) -> None:
    outcome = tool(
        "predict", f"checkpoint={checkpoint}", "input=drive.mp4", "output=out",
        "outputs=[mp4,png16,ply,html]", "camera=[90]", "batch_size=2", "max_depth=50", "flip=true",
    )  # fmt: skip
    assert outcome.code == 0, outcome.err
    assert "depth is relative" in outcome.out
    files = sorted(str(path.relative_to(tmp_path / "out")) for path in (tmp_path / "out").rglob("*.*"))
    assert files == [
        "drive/000000_depth.png", "drive/000000_points.ply", "drive/000001_depth.png", "drive/000001_points.ply",
        "drive_disparity.mp4", "drive_points.html",
    ]  # fmt: skip
    refused = tool("predict", f"checkpoint={checkpoint}", "input=drive.mp4", "output=out2", "outputs=[trajectory]")
    assert refused.code == 1
    assert "no pose network" in refused.err
    assert "set camera=" in refused.err


def test_folder_into_files_and_a_page(tool: Callable[..., Any], checkpoint: Path, image: Path, tmp_path: Path) -> None:
    arguments = (f"checkpoint={checkpoint}", "input=*.png", "output=out", "outputs=[npy,html]", "camera=[90]")
    outcome = tool("predict", *arguments)
    assert outcome.code == 0, outcome.err
    assert sorted(path.suffix for path in (tmp_path / "out").iterdir()) == [".html", ".json", ".npy"]
    assert f"1 frame: {Path('out') / tmp_path.name}_points.html" in outcome.out
    again = tool("predict", *arguments)
    assert again.code == 0, again.err
    assert "0 files written, 1 images were finished before: out" in again.out
    assert f"finished before: {Path('out') / tmp_path.name}_points.html" in again.out
    tool("predict", *arguments, "fps=3").says("_points.html exists", "set overwrite=true")
    assert "outputs is 'colour'; did you mean 'color'" in tool("predict", *arguments[:3], "outputs=[colour]").err


def test_one_picture_does_not_import_the_trainer(checkpoint: Path, image: Path, tmp_path: Path) -> None:
    code = (
        "import sys\n"
        "from saunet.cli.app import main\n"
        "main()\n"
        "trainer = ('lightning', 'torchmetrics', 'kornia', 'scipy', 'matplotlib', 'saunet.losses', 'saunet.data')\n"
        "print([name for name in trainer if name in sys.modules])"
    )
    arguments = ["-c", code, "predict", f"checkpoint={checkpoint}", "input=a.png", "output=out"]
    python(*arguments, cwd=tmp_path)  # which may have to make the table of all keys
    command = [sys.executable, *arguments, "overwrite=true"]
    result = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=True)
    assert result.stdout.splitlines()[-1] == "[]"


def test_camera_that_is_not_there(tool: Callable[..., Any], checkpoint: Path, tmp_path: Path) -> None:
    outcome = tool("predict", f"checkpoint={checkpoint}", "input=97", "output=out")
    assert outcome.code == 1
    assert "camera 97 gives no picture; check that it is connected" in outcome.err
    assert not (tmp_path / "out").exists()


class TestBadInput:
    """A clear message or the right result; what is finished stays valid."""

    @pytest.fixture
    def run(self, tool: Callable[..., Any], checkpoint: Path) -> Callable[..., Any]:
        return lambda name, *more: tool("predict", f"checkpoint={checkpoint}", f"input={name}", "output=out", *more)

    @pytest.mark.parametrize("kind", ["one pixel", "gray", "gray16", "color16", "rgba"])
    def test_unusual_images(self, run: Callable[..., Any], tmp_path: Path, kind: str) -> None:
        ramp = np.arange(40, dtype=np.uint8)[:, None].repeat(60, 1) * 6
        pictures: dict[str, Any] = {
            "one pixel": np.full((1, 1, 3), 77, np.uint8),
            "gray": ramp,
            "gray16": ramp.astype(np.uint16) * 257,
            "color16": np.dstack([ramp] * 3).astype(np.uint16) * 257,
            "rgba": np.dstack([ramp, ramp, ramp, 255 - ramp]),
        }
        cv2.imwrite(str(tmp_path / "a.png"), pictures[kind])
        outcome = run("a.png", "outputs=[color,png16,npy]")
        assert outcome.code == 0, outcome.err
        depth = np.load(tmp_path / "out" / "a_depth.npy")
        assert depth.shape == pictures[kind].shape[:2]
        assert np.isfinite(depth).all()
        if kind != "one pixel":  # all are the same gray picture
            cv2.imwrite(str(tmp_path / "b.png"), np.dstack([ramp] * 3))
            assert run("b.png", "outputs=[npy]").code == 0
            assert np.array_equal(depth, np.load(tmp_path / "out" / "b_depth.npy"))

    def test_rotated_by_exif(self, run: Callable[..., Any], tmp_path: Path) -> None:
        cv2.imwrite(str(tmp_path / "a.jpg"), np.random.default_rng(0).integers(0, 255, (30, 50, 3), dtype=np.uint8))
        data = (tmp_path / "a.jpg").read_bytes()
        tiff = b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
        exif = b"\xff\xe1" + (len(tiff) + 8).to_bytes(2, "big") + b"Exif\0\0" + tiff
        (tmp_path / "a.jpg").write_bytes(data[:2] + exif + data[2:])
        assert run("a.jpg", "outputs=[npy]").code == 0
        assert np.load(tmp_path / "out" / "a_depth.npy").shape == (50, 30)

    def test_directory_without_images(self, run: Callable[..., Any], tmp_path: Path) -> None:
        (tmp_path / "in").mkdir()
        for more in ((), ("outputs=[mp4]",)):
            outcome = run("in", *more)
            assert outcome.code == 1
            assert "no images in in; looked for files ending in .bmp" in outcome.err
        assert not (tmp_path / "out").exists()

    def test_no_frames_and_truncated_header(self, run: Callable[..., Any], video: Path, tmp_path: Path) -> None:
        cv2.VideoWriter(str(tmp_path / "none.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10, (32, 32)).release()
        video.write_bytes(video.read_bytes()[: video.stat().st_size // 2])
        for name, words in (
            ("none.avi", "none.avi"),
            ("drive.mp4", "truncated"),
        ):
            outcome = run(name)
            assert outcome.code == 1
            assert words in outcome.err
        assert not (tmp_path / "out").exists()

    def test_truncated_stream(self, run: Callable[..., Any], image: Path, tmp_path: Path) -> None:
        writer = cv2.VideoWriter(str(tmp_path / "x.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10, (90, 60))
        for _ in range(10):
            writer.write(cv2.imread(str(image)))
        writer.release()
        data = (tmp_path / "x.avi").read_bytes()
        (tmp_path / "x.avi").write_bytes(data[: len(data) * 6 // 10])
        outcome = run("x.avi", "outputs=[mp4,npy]")
        assert outcome.code == 1
        assert "is truncated: it ends 5 frames earlier than it declares" in outcome.err
        assert (tmp_path / "out" / "x_disparity.mp4").is_file()
        count = len(list((tmp_path / "out" / "x").iterdir()))
        assert 2 < count < 9
        assert f"{count} frames" in outcome.out

    @pytest.mark.parametrize("input_", ["in", "drive.mp4"])
    def test_full_disk_and_interrupt(self, checkpoint: Path, video: Path, tmp_path: Path, input_: str) -> None:
        """In a process of its own: a file size limit stands for the full disk, a signal to itself for Ctrl-C."""
        for index in range(6):
            size = (20, 30) if index < 3 else (400, 600)  # the large ones do not fit
            picture = np.random.default_rng(index).integers(0, 255, (*size, 3), dtype=np.uint8)
            cv2.imwrite(str(tmp_path / f"in_{index}.png"), picture)
            (tmp_path / "in").mkdir(exist_ok=True)
            (tmp_path / f"in_{index}.png").rename(tmp_path / "in" / f"{index}.png")
        code = (
            "import os, resource, signal, sys\n"
            "from saunet.cli.app import main\n"
            "from saunet.prediction import sinks\n"
            "how, sys.argv = sys.argv[1], sys.argv[:1] + sys.argv[2:]\n"
            "signal.signal(signal.SIGINT, signal.default_int_handler)  # a background shell job ignores it\n"
            "if how == 'full':\n"
            "    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
            "    resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000))\n"
            "else:\n"
            "    left, write = [2], sinks.write_output\n"
            "    def interrupted(*arguments):\n"
            "        left[0] -= 1\n"
            "        if left[0] == 0:\n"
            "            os.kill(os.getpid(), signal.SIGINT)\n"
            "        return write(*arguments)\n"
            "    sinks.write_output = interrupted\n"
            "main()\n"
        )
        for how in ("full", "interrupt"):
            out = tmp_path / how
            arguments = [f"checkpoint={checkpoint}", f"input={input_}", f"output={out}", "outputs=[npy,html]"]
            result = python("-c", code, how, "predict", *arguments, "camera=[90]", cwd=tmp_path)
            assert "Traceback" not in result.stderr
            if how == "full":
                assert result.returncode == 1
                assert "saunet predict: cannot write" in result.stderr
                assert "File too large" in result.stderr
            else:
                assert result.returncode == 130
                assert result.stderr.strip().endswith("saunet predict: interrupted")
            assert not [path for path in out.rglob("*") if "partial" in path.name or path.suffix == ".html"]
            for path in out.rglob("*.npy"):
                assert np.isfinite(np.load(path)).all()
        assert list((tmp_path / "interrupt").rglob("*.npy"))
        if input_ == "in":  # and it goes on where it stopped
            assert list((tmp_path / "full").rglob("*.npy"))
