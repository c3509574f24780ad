"""Everything that users get wrong ends in one sentence and a non-zero exit, with nothing half-written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from saunet.cli.errors import sentence

Tool = Callable[..., Any]


class Absent:
    """A package that Lightning looked for and did not find."""

    def __init__(self, message: str) -> None:
        self.message = message

    def __bool__(self) -> bool:
        return False

    def __str__(self) -> str:
        return self.message


KITTI = (
    "experiment=selfsup",
    "model=sau_net_nano",
    "model/pose=posecnn",
    "trainer=smoke",
    "data=kitti",
    "data.split=all",
    "data.cameras=[left]",
    "data.val_drives=[2011_09_26_drive_0002_sync]",
    "data.workers=0",
    "data.batch_size=1",
    "data.height=64",
    "data.width=96",
)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("model.encoder.dephts=[2,2]", ("unknown key 'model.encoder.dephts'", "did you mean 'depths'?")),
        ("sead=3", ("unknown key 'sead'", "did you mean 'seed'?")),
        ("trainer.max_epoch=2", ("unknown key 'trainer.max_epoch'", "did you mean 'max_epochs'?")),
        ("trainer.gpus=1", ("unknown key 'trainer.gpus'", "did you mean 'devices'?")),
        ("optim.learning_rate=1e-4", ("unknown key 'optim.learning_rate'", "did you mean 'lr'?")),
        ("max_epochs=3", ("unknown key 'max_epochs'", "did you mean 'trainer.max_epochs'?")),
        ("steps=10", ("unknown key 'steps'", "did you mean 'trainer.max_steps'?")),
        ("learning_rate=1e-4", ("unknown key 'learning_rate'", "did you mean 'lr'?")),
        ("imgsz=640", ("unknown key 'imgsz'", "did you mean 'size'?")),
        ("size=192", ("size is '192'", "size=192x640")),
        ("+epochs=3", ("leave out the plus sign: trainer.max_epochs=...",)),
        ("+dta.root=x", ("unknown key 'dta'", "did you mean 'data'?")),
        ("model.encoder=resnet18", ("choose a component with a slash: model/encoder=resnet18",)),
        ("--experiment selfsup", ("written without dashes: experiment=selfsup",)),
        ("objective.alpha=much", ("objective.alpha is 'much'; it must be float",)),
        ("model/encoder=resnet19", ("unknown model/encoder 'resnet19'", "did you mean 'resnet18'?", "stratified_tiny")),
        ("experiment=nope", ("unknown experiment 'nope'", "available: ", "demo")),
        ("data=kitti data.root=/nowhere/at/all", ("no data root at /nowhere/at/all", "set data.root")),
        ("experiment=smoke data.height=90", ("90x96", "nearest valid size is 96x96")),
        ("experiment=smoke seed=-1", ("seed is -1; it must be at least 0",)),
        ("experiment=smoke seed=4294967296", ("seed is 4294967296; it must lie between 0 and 4294967295",)),
        ("experiment=smoke model.pose=null", ("model.pose is null", "data.stereo=true")),
        ("experiment=smoke trainer.accumulate_grad_batches=0", ("trainer.accumulate_grad_batches is 0",)),
        ("experiment=smoke trainer.val_check_interval=0", ("trainer.val_check_interval is 0",)),
        ("experiment=smoke trainer.check_val_every_n_epoch=0", ("trainer.check_val_every_n_epoch is 0",)),
        ("experiment=smoke trainer.precision=64", ("trainer.precision is '64'", "allowed: 32-true")),
        ("experiment=smoke trainer.overfit_batches=1", ("use trainer.limit_train_batches",)),
        ("experiment=smoke logger=null", ("cannot be null; choose logger=none",)),
        ("experiment=smoke callbacks=null", ("a config group cannot be null",)),
        ("experiment=smoke output_dir=", ("output_dir= is empty",)),
        ("experiment=smoke resume=", ("resume= is empty",)),
        ("experiment=smoke trainer.max_epochs=-1", ("trainer.max_epochs is -1",)),
        ("experiment=smoke trainer.enable_progress_bar=false", ("set callbacks.progress=null instead",)),
        ("experiment=smoke protocol=eigen_lidar_x", ("protocol 'eigen_lidar_x' is defined on 'lidar_x'", "'exact'")),
        ("experiment=smoke optim.lr=-1", ("optim.lr is -1.0; it must be greater than 0",)),
        ("experiment=smoke objective.gradient.target=lidar", ("set data.target_depth=true",)),
        ("experiment=smoke model.decoder.attention=eac", ("unknown attention 'eac'", "did you mean 'eca'?")),
        ("experiment=smoke model.pose.input=triplet data.offsets=[1]", ("'triplet' but there are 2 frames", "needs 3")),
        ("experiment=smoke model/encoder=resnet18 model.encoder.weights=no/w.pth", ("there is no such file",)),
        ("experiment=smoke model/encoder=resnet18 model.encoder.frames=2", ("frames=2; depth comes from one image",)),
        ("-m experiment=glob(table9/*)", ("experiment=glob(table9/*) matches none of", "table3/stf_t_aunet")),
        ("experiment=smoke data.batch_size=99", ("batch_size is 99 but there are only 4 training samples",)),
        ("experiment=smoke resume=true", ("resume is 'true'", "resume=auto")),
        (
            "experiment=smoke optim.fused=true trainer.precision=bf16-mixed trainer.gradient_clip_val=1",
            ("optim.fused=true, trainer.precision=bf16-mixed", "set optim.fused=false"),
        ),
        ("experiment=smoke resume=/nowhere/last.ckpt", ("no checkpoint at /nowhere/last.ckpt",)),
        ("experiment=smoke hydra.run.dir=/proc/nowhere/run", ("/proc/nowhere", "check the path")),
    ],
)
def test_train(tool: Tool, override: str, words: tuple[str, ...], tmp_path: Path) -> None:
    tool("train", *override.split()).says(*words)
    assert list(tmp_path.iterdir()) == []  # nothing half-written is left, nor an empty folder


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("callbacks.last.every_n_steps=-1", "callbacks.last: every_n_steps is -1; it must be at least 0"),
        ("trainer.strategy=foo", "trainer: You selected an invalid strategy name"),
        ("logger=wandb", "logger=wandb needs a package that is not installed; run `pip install 'saunet[track]'`"),
        ("logger=mlflow", "logger=mlflow needs a package that is not installed; run `pip install 'saunet[track]'`"),
    ],
)
def test_what_hydra_builds_speaks_for_itself(
    tool: Tool, override: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module, flag in (("wandb", "_WANDB_AVAILABLE"), ("mlflow", "_MLFLOW_AVAILABLE")):
        absent = f"Requirement '{module}>=1' not met. HINT: Try running `pip install -U '{module}>=1'`"
        monkeypatch.setattr(f"lightning.pytorch.loggers.{module}.{flag}", Absent(absent))
    outcome = tool("train", "experiment=smoke", override)
    outcome.says(words)
    last = outcome.err.strip().splitlines()[-1]
    assert last.startswith(f"saunet train: {words}")
    assert "full_key" not in last
    assert last.count(words) == 1


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_gpu_that_is_not_there(tool: Tool) -> None:
    outcome = tool("train", "experiment=smoke", "trainer=gpu")
    outcome.says("gpu")
    assert "Error in call" not in outcome.err  # Hydra's wrapping


def test_an_empty_path_is_refused(tool: Tool, tmp_path: Path) -> None:
    tool("predict", "checkpoint=x", "output=out", "input=").says("input= is empty")
    outcome = tool("train", "-m", "experiment=smoke", "output_dir=", "hydra.sweep.dir=sweep")
    assert outcome.code == 1
    assert "output_dir= is empty" in outcome.err
    assert [path.name for path in tmp_path.iterdir()] == ["sweep"]


def test_a_full_gpu_is_one_sentence() -> None:
    said = sentence(torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB"))
    assert said is not None
    assert "data.batch_size" in said


def test_a_missing_value_is_asked_for(tool: Tool) -> None:
    tool("predict").says("input is not set; add input=... to the command line")
    tool("predict", "x.png", "camera_height=1.65").says("did you mean 'scale.camera_height'?")
    tool("odometry").says("checkpoint is not set; add checkpoint=...")


@pytest.mark.parametrize("name", ["evaluate", "predict"])
@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", ("damaged or truncated",)),
        (b"not a checkpoint", ("is not a checkpoint, or is damaged",)),
        (None, ("is not a saunet checkpoint",)),
    ],
)
def test_an_unreadable_checkpoint(
    tool: Tool, tmp_path: Path, name: str, content: bytes | None, words: tuple[str, ...]
) -> None:
    path = tmp_path / "x.ckpt"
    if content is None:
        torch.save({"state_dict": {}}, path)
    else:
        path.write_bytes(content)
    (tmp_path / "x.png").touch()
    overrides = ("input=x.png", "output=out") if name == "predict" else ()
    outcome = tool(name, f"checkpoint={path}", *overrides)
    outcome.says("x.ckpt")
    assert any(word in outcome.err for word in (*words, "is not a checkpoint", "damaged"))
    assert not (tmp_path / "out").exists()


def test_a_checkpoint_of_another_model_cannot_be_resumed(tool: Tool, smoke_run: Path) -> None:
    last = smoke_run / "checkpoints" / "last.ckpt"
    outcome = tool("train", "experiment=smoke", "model/encoder=lite_mono_tiny", "model/pose=posecnn", f"resume={last}")
    outcome.says("checkpoint of another model, the depth network does not fit")


def test_a_resumed_run_with_other_settings(tool: Tool, smoke_run: Path) -> None:
    last = smoke_run / "checkpoints" / "last.ckpt"
    outcome = tool("train", "experiment=smoke", "model/pose=posecnn", "data.width=128", f"resume={last}")
    outcome.says("width 96 but this run has 128", "saunet resume")


def test_an_empty_drive(tool: Tool, raw_root: Path) -> None:
    for path in raw_root.rglob("image_02/data/*.png"):
        path.unlink()
    undivided = [key for key in KITTI if "val_drives" not in key]
    tool("train", *undivided, f"data.root={raw_root}").says("hold no images")


@pytest.mark.parametrize("content", [b"", b"hello", "half"])
def test_a_broken_image(tool: Tool, raw_root: Path, content: bytes | str) -> None:
    for path in raw_root.rglob("image_02/data/*.png"):
        whole = path.read_bytes()
        path.write_bytes(whole[: len(whole) // 2] if isinstance(content, str) else content)
    outcome = tool("train", *KITTI, f"data.root={raw_root}")
    outcome.says(".png")


def test_a_malformed_calibration_line(tool: Tool, raw_root: Path) -> None:
    path = next(raw_root.rglob("calib_cam_to_cam.txt"))
    path.write_text(path.read_text().replace("P_rect_02: ", "P_rect_02: 7.2e+02 oops "))
    tool("train", *KITTI, f"data.root={raw_root}").says("calib_cam_to_cam.txt", "P_rect_02")


def test_predicting_what_is_no_image(tool: Tool, smoke_run: Path, tmp_path: Path) -> None:
    checkpoint = f"checkpoint={smoke_run / 'checkpoints' / 'best.ckpt'}"
    (tmp_path / "bad.png").write_bytes(b"not an image")
    tool("predict", checkpoint, "input=bad.png", "output=out").says("bad.png")
    tool("predict", checkpoint, "input=nothing.png", "output=out").says("nothing.png")
    assert not list(tmp_path.glob("out/*_disparity.png"))


def test_writing_where_nothing_can_be_written(tool: Tool, smoke_run: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    cv2.imwrite(str(tmp_path / "a.png"), np.full((60, 90, 3), 99, np.uint8))
    checkpoint = f"checkpoint={smoke_run / 'checkpoints' / 'best.ckpt'}"
    tool("predict", checkpoint, "input=a.png", "output=file/out").says("cannot write")
    tool("train", "experiment=smoke", "output_dir=file/run").says("file")


def test_an_unknown_device(tool: Tool, smoke_run: Path, tmp_path: Path) -> None:
    (tmp_path / "a.png").touch()
    checkpoint = f"checkpoint={smoke_run / 'checkpoints' / 'best.ckpt'}"
    tool("predict", checkpoint, "input=a.png", "output=out", "device=tpux").says("device 'tpux'", "available: cpu")
