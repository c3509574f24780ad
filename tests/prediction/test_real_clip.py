"""The real frames of KITTI drive 9005 as a video in; video, 16-bit PNGs, points, page and trajectory out."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from predicting import run

from saunet.io.images import read_depth, read_image
from saunet.io.video import VideoReader, VideoWriter
from saunet.models.depth import DepthNet
from saunet.prediction.odometer import Odometer

DRIVE = Path("raw") / "2011_09_26" / "2011_09_26_drive_9005_sync" / "image_02" / "data"
CAMERA = (721.5377, 721.5377, 608.5593, 171.854)
"""P_rect_02 of that day, principal point counted from zero."""

FRAMES = 12
LAST = f"{FRAMES - 1:06d}"

pytestmark = pytest.mark.data


@pytest.fixture(scope="module")
def video(kitti_mini: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("drive") / "drive9005.mp4"
    with VideoWriter(path, 10) as writer:
        for frame in sorted((kitti_mini / DRIVE).glob("*.png"))[:FRAMES]:
            writer.write(read_image(frame))
    return path


@pytest.fixture(scope="module")
def results(video: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Everything that `predict` writes, by small untrained networks."""
    import torch

    from saunet.prediction.predictor import Predictor
    from saunet.registry import decoders, encoders, poses

    torch.manual_seed(0)
    network = DepthNet(encoders.build("resnet18", blocks=(1, 1, 1, 1)), decoders.partial("unet"))
    folder = tmp_path_factory.mktemp("results")
    outputs = ("mp4", "png16", "ply", "html", "trajectory")
    odometer = Odometer(poses.build("posecnn"), 64, 192)
    summary = run(Predictor(network, 64, 192), video, folder, outputs, camera=CAMERA, odometer=odometer, batch_size=4)
    assert (summary.frames, summary.missing) == (FRAMES, 0)
    return folder


def test_video_plays_with_both_halves(results: Path, video: Path) -> None:
    with VideoReader(results / "drive9005_disparity.mp4") as after, VideoReader(video) as before:
        assert after.declared == before.declared == FRAMES
        assert (after.width, after.height) == (1242, 2 * (before.height + 28))
        shown, original = next(iter(after)), next(iter(before))
    assert np.abs(shown[28 : 28 + 375].astype(int) - original[:375]).mean() < 6


def test_depth_and_points_are_the_same_in_every_file(results: Path) -> None:
    folder = results / "drive9005"
    assert len(list(folder.iterdir())) == 2 * FRAMES
    depth = read_depth(folder / f"{LAST}_depth.png")
    assert depth.shape[1] == 1242
    assert depth.min() > 0
    header, body = (folder / f"{LAST}_points.ply").read_bytes().split(b"end_header\n", 1)
    count = int(re.search(rb"element vertex (\d+)", header).group(1))  # type: ignore[union-attr]
    vertices = np.frombuffer(body, dtype=[("xyz", "<f4", 3), ("rgb", "u1", 3)])
    assert len(vertices) == count > 10_000
    x, y, z = vertices["xyz"][:: max(1, count // 500)].T
    columns, rows = np.round(x / z * 721.5377 + 608.5593), np.round(y / z * 721.5377 + 171.854)
    assert np.abs(depth[rows.astype(int), columns.astype(int)] - z).max() < 0.5 / 256 + 1e-3


def test_page_and_trajectory(results: Path) -> None:
    page = (results / "drive9005_points.html").read_text()
    found = re.search(r'<script id="clip" type="application/json">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    clip: dict[str, Any] = json.loads(found.group(1))
    assert page.count('<script class="frame"') == FRAMES
    assert clip["unit"].startswith("relative")
    assert len((results / "drive9005_trajectory.txt").read_text().splitlines()) == FRAMES
    assert cv2.imread(str(results / "drive9005_trajectory.png")).shape == (800, 800, 3)
