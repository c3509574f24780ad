"""A model that comes with saunet is named like a file, on every command line that takes a trained model."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from saunet.data.video.camera import CameraFile, write_camera
from saunet.exporting.box import pack
from saunet.io.images import write_image
from saunet.synthetic import SyntheticDrive
from saunet.weights import locate

Tool = Callable[..., Any]


@pytest.fixture
def street(smoke_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A small trained model as the shipped one."""
    monkeypatch.setattr(locate, "BOX", tmp_path / "box")
    pack(smoke_run / "checkpoints" / "best.ckpt", tmp_path / "box" / "street")
    return tmp_path / "box" / "street"


def test_predict_needs_no_checkpoint(tool: Tool, street: Path, smoke_run: Path) -> None:
    pictures = smoke_run / "pictures"
    outcome = tool("predict", f"input={pictures}", "output=depth", "outputs=[npy]")
    assert outcome.code == 0, outcome.err
    assert "written" in outcome.out
    outcome = tool("predict", "checkpoint=street", f"input={pictures}", "output=depth", "outputs=[npy]")
    assert "0 files written" in outcome.out  # finished before, by the same model


def test_evaluate_and_odometry(tool: Tool, street: Path, tmp_path: Path) -> None:
    common = ("checkpoint=street", "data=synthetic_tiny", "output_dir=results")
    outcome = tool("evaluate", *common, "scale.method=speed")
    assert outcome.code == 0, outcome.err
    assert "constant depth" in outcome.out
    tool("evaluate", *common, "scale.method=speed", "scale.store=true").says("scale.store=true", "comes with saunet")
    outcome = tool("odometry", *common, "figure=false")
    assert outcome.code == 0, outcome.err


def test_init_from(tool: Tool, street: Path) -> None:
    settings = ("model/pose=posecnn", "trainer.limit_train_batches=1", "output_dir=warm")
    outcome = tool("train", "experiment=smoke", "init_from=street", *settings)
    assert outcome.code == 0, outcome.err
    assert "starting from street: all" in outcome.out


def test_without_one(tool: Tool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(locate, "BOX", tmp_path)
    (tmp_path / "x.png").touch()
    tool("predict", f"input={tmp_path / 'x.png'}", "output=y").says(
        "no model 'street' comes with this installation", "checkpoint="
    )
    tool("train", "experiment=smoke", "init_from=street").says("no model 'street' comes with this installation")


def test_listing_needs_no_network_code() -> None:
    program = "import saunet; print(saunet.available('weights')); import sys; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == [str(locate.shipped()), "False"]


def test_own_clips_and_paths_without_a_pose_network(tool: Tool, smoke_run: Path, tmp_path: Path) -> None:
    """The motion is that of tracked points, and runs are compared with what `street` gives."""
    drive = SyntheticDrive(seed=8, frames=8, height=120, width=400)
    (tmp_path / "clips" / "a").mkdir(parents=True)
    for index in drive.indices:
        write_image(tmp_path / "clips" / "a" / f"{index}.png", drive.image(index))
    write_camera(tmp_path / "clips" / "camera.yaml", CameraFile(Path(), drive.intrinsics(0), (120, 400), fps=10.0))
    common = ("data=video", "data.root=clips", "data.test_clips=[a]", "data.workers=0", "data.frames_cache=cache")
    outcome = tool("evaluate", "street", *common, "data.val_clips=[]", "output_dir=before")
    assert outcome.code == 0, outcome.err
    assert "motion: from tracked points (the model has no pose network)" in outcome.out
    results = json.loads((tmp_path / "before" / "metrics.json").read_text())
    (view,) = results["views"]
    assert view["images"] == 6
    assert view["warped"] < 0.5 * view["unwarped"]
    assert view["explained"] > 0.8
    assert results["settings"]["motion"] == "tracked"
    assert results["settings"]["size"] == [128, 416]
    smaller = ("data.val_clips=[]", "motion=tracked", "compare=before", "output_dir=smaller")
    outcome = tool("evaluate", str(smoke_run), *common, *smaller)
    assert outcome.code == 0, outcome.err
    assert "before was scored at 128x416 (height x width) and this model at 64x96" in outcome.out
    tool("evaluate", "street", *common, "size=96x320", "output_dir=other").says(
        "data.height is 96 and data.width is 320", "street takes images of 128x416", "leave the size out"
    )
    tool("odometry", "street", *common, "data.width=320", "output_dir=other").says("data.width is 320", "128x416")
    outcome = tool("odometry", "street", *common, "output_dir=path", "figure=false")
    assert outcome.code == 0, outcome.err
    assert "motion: from tracked points" in outcome.out
    outcome = tool("predict", "clips/a", "output=out", "outputs=[trajectory]", "camera=clips/camera.yaml", "fps=10")
    assert outcome.code == 0, outcome.err
    assert "trajectory: from tracked points" in outcome.out
    again = tool("odometry", "street", *common, "motion=tracked", "output_dir=again", "figure=false")
    assert again.code == 0, again.err
    paths = [np.loadtxt(next(tmp_path.glob(each))) for each in ("path/*/predicted_kitti.txt", "out/*_trajectory.txt")]
    np.testing.assert_allclose(*paths, atol=1e-3)
    true = np.linalg.inv(drive.pose(0)) @ drive.pose(7)
    assert np.linalg.norm(paths[0][-1, 3::4] - true[:3, 3]) < 0.3 * np.linalg.norm(true[:3, 3])
