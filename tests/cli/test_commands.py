"""The straight path on the command line: train, resume, evaluate, predict; also on recordings in KITTI's layout."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import saunet
from saunet.runs.checkpoint import read_checkpoint
from saunet.tools.prepare.targets import densify
from saunet.tools.prepare.tool import kitti_recordings

Tool = Callable[..., Any]
SMALL = ("data.height=64", "data.width=96", "data.batch_size=2", "data.workers=0", "trainer=smoke")
NANO = ("experiment=selfsup", "model=sau_net_nano", "model/pose=posecnn")
KITTI = ("data=kitti", "data.split=all", "data.val_drives=[2011_09_26_drive_0002_sync]", "data.cameras=[left]")


def test_a_run_leaves_checkpoints_logs_pictures_and_its_config(smoke_run: Path) -> None:
    names = {str(path.relative_to(smoke_run)) for path in smoke_run.rglob("*") if path.is_file()}
    assert {
        "checkpoints/best.ckpt",
        "checkpoints/last.ckpt",
        "csv/metrics.csv",
        "pictures/epoch_000.png",
        "run.json",
    } <= names
    assert any(name.startswith("tensorboard/events") for name in names)
    record = json.loads((smoke_run / "run.json").read_text())
    assert record["config"]["data"]["height"] == 64
    assert "experiment=smoke" in record["overrides"]
    with (smoke_run / "csv" / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {"train/loss", "train/photometric", "train/gradient", "val/abs_rel", "val/a1"} <= set(rows[0])


def test_the_record_says_what_was_trained(smoke_run: Path) -> None:
    record = read_checkpoint(smoke_run / "checkpoints" / "last.ckpt").record
    assert (record.height, record.width, record.offsets) == (64, 96, (-1, 1))
    assert record.data["name"] == "smoke"


def test_resume_goes_on_from_the_last_checkpoint(tool: Tool, smoke_run: Path) -> None:
    last = smoke_run / "checkpoints" / "last.ckpt"
    more = ("model/pose=posecnn", f"resume={last}", "trainer.max_epochs=2", "output_dir=again")
    outcome = tool("train", "experiment=smoke", *more)
    assert outcome.code == 0, outcome.err
    assert read_checkpoint(last).epoch == 0
    assert "nothing was left" not in outcome.out
    done = tool("train", "experiment=smoke", "model/pose=posecnn", f"resume={last}", "output_dir=done")
    assert done.code == 0, done.err
    assert "nothing was left to train" in done.out


def test_evaluate_writes_a_table_beside_trivial_predictors(tool: Tool, smoke_run: Path, tmp_path: Path) -> None:
    outcome = tool(
        "evaluate",
        f"checkpoint={smoke_run / 'checkpoints' / 'best.ckpt'}",
        "data=synthetic_tiny",
        "output_dir=results",
    )
    assert outcome.code == 0, outcome.err
    for word in ("RMSE ↓", "δ1 ↑", "model", "constant depth", "mean depth map"):
        assert word in outcome.out
    summary = json.loads((tmp_path / "results" / "metrics.json").read_text())
    assert summary["results"][0]["images"] == 6
    assert (tmp_path / "results" / "per_image.csv").is_file()


def test_predict_writes_pictures_that_match_the_library(tool: Tool, smoke_run: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    (tmp_path / "in").mkdir()
    for name in ("a", "b"):
        cv2.imwrite(str(tmp_path / "in" / f"{name}.png"), rng.integers(0, 255, (60, 90, 3), dtype=np.uint8))
    checkpoint = smoke_run / "checkpoints" / "best.ckpt"
    arguments = (f"checkpoint={checkpoint}", "input=in", "output=out", "outputs=[color,png16,npy]")
    outcome = tool("predict", *arguments)
    assert outcome.code == 0, outcome.err
    assert "depth is relative" in outcome.out
    depth = np.load(tmp_path / "out" / "a_depth.npy")
    np.testing.assert_allclose(depth, saunet.load(checkpoint).predict(tmp_path / "in" / "a.png").depth, rtol=1e-5)
    stored = cv2.imread(str(tmp_path / "out" / "a_depth.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_allclose(stored / 256, depth, atol=1 / 256)
    assert "0 files written, 2 images were finished before" in tool("predict", *arguments).out


def test_the_kitti_path_from_disk(tool: Tool, raw_root: Path, tmp_path: Path) -> None:
    outcome = tool("train", *NANO, *KITTI, f"data.root={raw_root}", *SMALL, "output_dir=run")
    assert outcome.code == 0, outcome.err
    outcome = tool(
        "evaluate",
        "checkpoint=run/checkpoints/last.ckpt",
        *KITTI,
        f"data.root={raw_root}",
        "data.workers=0",
        "protocols=[eigen_camera_z,metric]",
        "output_dir=results",
    )
    assert outcome.code == 0, outcome.err
    protocols = {row["protocol"] for row in json.loads((tmp_path / "results" / "metrics.json").read_text())["results"]}
    assert protocols == {"eigen_camera_z", "metric"}


def test_the_papers_experiment_trains_with_interpolated_lidar(tool: Tool, raw_root: Path) -> None:
    densify(kitti_recordings(raw_root, ["left"]), ["linear"])
    outcome = tool(
        "train",
        "experiment=paper",
        "model=sau_net_nano",
        *KITTI[1:],  # the experiment's own data set: with dense maps
        f"data.root={raw_root}",
        *SMALL,
        "model.encoder.weights=null",
        "model.pose.weights=null",
        "output_dir=run",
    )
    assert outcome.code == 0, outcome.err


@pytest.mark.parametrize("objective", saunet.available("objective"))
@pytest.mark.parametrize("decoder", ["unet", "aunet"])
def test_any_encoder_decoder_objective_can_be_swapped(tool: Tool, decoder: str, objective: str) -> None:
    outcome = tool(
        "train",
        "experiment=smoke",
        "model/encoder=lite_mono_tiny",
        f"model/decoder={decoder}",
        "model/pose=posecnn",
        f"objective={objective}",
        "logger=none",
        "trainer.limit_train_batches=1",
    )
    assert outcome.code == 0, outcome.err
