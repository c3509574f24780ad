"""Two processes on the CPU: training runs, and validation says exactly what one process says."""

from __future__ import annotations

import csv
import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import torch
from processes import python
from training_options import train_options

from saunet.errors import ConfigError

pytestmark = pytest.mark.ddp

ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
TWO = ("trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2")
SMOKE = (
    "experiment=smoke",
    "data.frames_per_drive=7",
    "trainer.max_epochs=1",
    "trainer.limit_train_batches=2",
    "trainer.limit_val_batches=1.0",
    "trainer.log_every_n_steps=1",
)


def _run(tool: str, folder: Path, *overrides: str) -> str:
    done = python("-m", "saunet", tool, *overrides, f"hydra.run.dir={folder}", env=ENVIRONMENT)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stderr


def _logged(folder: Path) -> dict[str, float]:
    values: dict[str, float] = {}
    with (folder / "csv" / "metrics.csv").open() as file:
        for row in csv.DictReader(file):
            values.update({key: float(value) for key, value in row.items() if value})
    return values


def test_two_processes_validate_exactly_like_one(tmp_path: Path) -> None:
    # Five validation frames that two processes share unevenly. Batch norm is there on purpose: without a broadcast each
    # process would score its part with its own running statistics.
    small = ("model/encoder=resnet18", "model.encoder.blocks=[1,1,1,1]", "model/pose=posecnn")
    said = _run("train", tmp_path / "two", *SMOKE, *TWO, *small)
    assert "sync_dist" not in said
    assert "Grad strides" not in said
    two = _logged(tmp_path / "two")
    checkpoint = f"checkpoint={tmp_path / 'two' / 'checkpoints' / 'last.ckpt'}"
    data = ("data=synthetic_tiny", "data.frames_per_drive=7", "data.workers=0", "split=val", "baselines=false")
    _run("evaluate", tmp_path / "one", checkpoint, *data)
    (one,) = json.loads((tmp_path / "one" / "metrics.json").read_text())["results"]
    assert one["images"] == two["val/images"] == 5
    for name in ("abs_rel", "sq_rel", "rmse", "rmse_log", "a1", "a2", "a3", "scale"):
        assert two[f"val/{name}"] == pytest.approx(one[name], rel=1e-6), name


def test_spawned_processes_are_refused_with_the_reason(config: dict[str, Any]) -> None:
    for strategy in ("ddp_spawn", {"_target_": "lightning.pytorch.strategies.DDPStrategy", "start_method": "spawn"}):
        with pytest.raises(ConfigError, match=r"trainer\.strategy is .*a signal would end"):
            train_options({**config, "trainer": {"strategy": strategy}})


def test_a_sweep_over_processes_is_refused_with_the_ways_out(tmp_path: Path) -> None:
    done = python("-m", "saunet.cli.train", "--multirun", *SMOKE, *TWO, "seed=1,2", cwd=tmp_path)
    assert done.returncode == 1
    assert "start each training with its own command" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("nodes", [1, 2])
def test_torchrun_starts_the_processes_of_one_node_or_of_several(nodes: int, tmp_path: Path) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        meeting = f"127.0.0.1:{probe.getsockname()[1]}"
    command = [
        sys.executable,
        "-m",
        "torch.distributed.run",
        "--nnodes",
        str(nodes),
        "--nproc-per-node",
        str(2 // nodes),
    ]
    command += ["--rdzv-backend", "c10d", "--rdzv-endpoint", meeting, "-m", "saunet.cli.train", *SMOKE, *TWO]
    command += [f"trainer.devices={2 // nodes}", f"trainer.num_nodes={nodes}", f"hydra.run.dir={tmp_path}"]
    started = [subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=ENVIRONMENT) for _ in range(nodes)]
    said = [each.communicate(timeout=900)[1] for each in started]
    assert [each.returncode for each in started] == [0] * nodes, said
    assert sum(each.count("networks: depth") for each in said) == 1  # one process speaks
    assert json.loads((tmp_path / "run.json").read_text())["status"] == "finished"
    assert _logged(tmp_path)["val/images"] == 5


CURVE = Path(__file__).parents[1] / "helpers" / "ddp_curve.py"


def _train(folder: Path, *arguments: int) -> subprocess.CompletedProcess[str]:
    return python(str(CURVE), str(folder), *(str(int(each)) for each in arguments), env=ENVIRONMENT)


def _curve(folder: Path, processes: int) -> dict[str, Any]:
    done = _train(folder, processes, 7)
    assert done.returncode == 0, done.stderr[-3000:]
    curve: dict[str, Any] = json.loads((folder / "curve.json").read_text())
    return curve


def test_two_processes_have_the_loss_curve_of_one(tmp_path: Path) -> None:
    one, two = _curve(tmp_path / "one", 1), _curve(tmp_path / "two", 2)
    assert len(one["losses"]) == 20
    assert one["validated"] == two["validated"] == [3, 6, 9, 12, 15, 18, 20]  # the last within an epoch
    assert one["losses"][-1] < 0.95 * one["losses"][0]
    assert two["losses"] == pytest.approx(one["losses"], rel=1e-4)  # sums are taken in another order
    assert two["metrics"] == pytest.approx(one["metrics"], rel=1e-4)  # of weights that differ by as little
    assert two["focals"] == pytest.approx(one["focals"], rel=1e-4)
    assert all(abs(factor - 1) > 0.005 for factor in one["focals"])


@pytest.mark.parametrize("victim", [0, 1])
def test_a_killed_process_ends_the_run_with_a_sentence_and_a_checkpoint(victim: int, tmp_path: Path) -> None:
    done = _train(tmp_path, 2, 500, victim, signal.SIGKILL)
    assert time.time() - (tmp_path / "struck").stat().st_mtime < 10
    assert done.returncode != 0
    named = "process 1 of 2 was killed (signal 9)" if victim == 1 else "the first process of the run is gone"
    assert f"saunet train: {named}" in done.stderr
    assert "resume with resume=" in done.stderr
    record = json.loads((tmp_path / "run.json").read_text())
    assert record["status"] == "failed"
    assert named in record["error"]
    stored = torch.load(tmp_path / "c" / "last.ckpt", weights_only=True)
    assert stored["global_step"] >= 3


@pytest.mark.parametrize("asked", [0, 1])
def test_one_process_asked_to_stop_stops_both_with_everything_saved(asked: int, tmp_path: Path) -> None:
    done = _train(tmp_path, 2, 500, asked, signal.SIGTERM)
    assert done.returncode == 128 + signal.SIGTERM
    record = json.loads((tmp_path / "run.json").read_text())
    assert record["status"] == "interrupted"
    assert "stopped by SIGTERM after step" in record["error"]
    assert "everything is saved" in record["error"]
