"""``saunet-predict``: point clouds, colours, videos, and what does not apply to a video."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from torch import nn

import saunet
from saunet.checkpoint import ModelRecord, atomic_save, build_networks
from saunet.config import PredictConfig
from saunet.images import read_image
from saunet.infer.clips import VideoWriter
from saunet.infer.files import predict_files
from saunet.infer.pointcloud import Camera, point_cloud, write_ply
from saunet.registry import REGISTRIES


def _node(kind: str, name: str) -> dict[str, Any]:
    plain = dataclasses.asdict(REGISTRIES[kind].node(name)())
    return {key: value for key, value in plain.items() if value != "???"}


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An untrained model on disk."""
    parts = {"encoder": _node("encoder", "resnet18"), "decoder": _node("decoder", "unet"), "pose": None}
    record = ModelRecord(**parts, min_depth=0.1, max_depth=100.0, height=32, width=64)
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


def test_the_tool_writes_what_the_library_writes_by_default() -> None:
    defaults = {name: p.default for name, p in inspect.signature(predict_files).parameters.items()}
    config = PredictConfig()
    assert tuple(config.outputs) == defaults["outputs"]
    for key in ("palette", "camera", "batch_size", "overwrite"):
        assert getattr(config, key) == defaults[key]


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
    write_ply(tmp_path / "x.ply", point_cloud(prediction, Camera.from_numbers((80, 80, 44.5, 29.5), 60, 90)))
    assert (tmp_path / "out" / "a_points.ply").read_bytes() == (tmp_path / "x.ply").read_bytes()
    assert "intrinsics have 3 numbers" in tool("predict", *arguments, "camera=[80,80,44.5]").err


def test_palette_and_keep_aspect(tool: Callable[..., Any], checkpoint: Path, image: Path, tmp_path: Path) -> None:
    arguments = (f"checkpoint={checkpoint}", "input=a.png", "palette=turbo", "keep_aspect=true")
    outcome = tool("predict", *arguments, "output=out")
    assert outcome.code == 0, outcome.err
    from saunet.infer.predictor import Predictor

    expected = Predictor.from_checkpoint(checkpoint, keep_aspect=True).predict(image).colour(None, "turbo")
    assert np.array_equal(read_image(tmp_path / "out" / "a_disparity.png"), expected)
    assert "did you mean 'turbo'" in tool("predict", *arguments, "palette=turbi", "output=out2").err
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


@pytest.mark.parametrize("change", ["outputs=[npy]", "camera=[80,80,44.5,29.5]", "batch_size=2"])
def test_what_is_for_images_is_refused_for_a_video(
    tool: Callable[..., Any], checkpoint: Path, video: Path, change: str
) -> None:
    outcome = tool("predict", f"checkpoint={checkpoint}", "input=drive.mp4", "output=out", change)
    assert outcome.code == 1
    assert f"{change.split('=')[0]} is for images" in outcome.err
