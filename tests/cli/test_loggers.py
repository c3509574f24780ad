"""Each choice of ``logger=`` in a training of two steps, without any network."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

SMOKE = ("train", "experiment=smoke", "output_dir=run")


def test_csv_and_tensorboard_are_there_by_default(smoke_run: Path) -> None:
    assert (smoke_run / "csv" / "metrics.csv").is_file()
    assert list((smoke_run / "tensorboard").glob("events.*"))


def test_wandb_offline(tool: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("wandb", reason="wandb, of the extra 'track', is not installed")
    for name in ("CONFIG", "CACHE", "DATA"):
        monkeypatch.setenv(f"WANDB_{name}_DIR", str(tmp_path / "home"))
    outcome = tool(*SMOKE, "logger=wandb", "logger.wandb.offline=true")
    assert outcome.code == 0, outcome.err
    assert list((tmp_path / "run" / "wandb").glob("offline-run-*/run-*.wandb"))
    assert (tmp_path / "run" / "csv" / "metrics.csv").is_file()


def test_mlflow_in_a_local_database(tool: Callable[..., Any], tmp_path: Path) -> None:
    pytest.importorskip("mlflow", reason="mlflow, of the extra 'track', is not installed")
    outcome = tool(*SMOKE, "logger=mlflow")
    assert outcome.code == 0, outcome.err
    with sqlite3.connect(tmp_path / "run" / "mlflow.db") as database:
        logged = {key for (key,) in database.execute("select key from metrics")}
    assert "val/abs_rel" in logged
    assert not (tmp_path / "mlruns").exists()
    assert (tmp_path / "run" / "csv" / "metrics.csv").is_file()


@pytest.mark.parametrize(("choice", "package"), [("wandb", "wandb"), ("mlflow", "mlflow")])
def test_a_missing_package_is_named(tool: Callable[..., Any], tmp_path: Path, choice: str, package: str) -> None:
    try:
        __import__(package)
    except ImportError:
        tool(*SMOKE, f"logger={choice}").says(f"logger={choice}", "saunet[track]")
        assert not (tmp_path / "run").exists()
    else:
        pytest.skip(f"{package} is installed")
