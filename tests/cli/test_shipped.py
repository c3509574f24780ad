"""A model that comes with saunet is named like a file, on every command line that takes a trained model."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from saunet.exporting.box import pack
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
