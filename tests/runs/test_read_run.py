"""Reading a run's folder, and telling how it ended."""

from __future__ import annotations

import csv
import json
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from made_runs import ERRORS, make_run

from saunet.runs.folder import SIGN_OF_LIFE
from saunet.runs.run import read_run


def test_a_finished_run_tells_what_it_was(tmp_path: Path) -> None:
    times = {"started": "2026-01-01T00:00:00+00:00", "ended": "2026-01-01T00:01:30+00:00"}
    run = read_run(make_run(tmp_path / "a", status="finished", **times))
    assert (run.status, run.error, run.name, run.seconds) == ("finished", None, "a", 90)
    assert run.component("model/encoder") == "stratified_nano"
    assert run.component("objective") == "saunet"
    assert run.component("optim") == ""


def test_without_choices_a_component_goes_by_its_class(tmp_path: Path) -> None:
    make_run(tmp_path / "a")
    (tmp_path / "a" / ".hydra" / "hydra.yaml").unlink()
    assert read_run(tmp_path / "a").component("model/encoder") == "StratifiedTransformer"


def test_an_old_run_is_of_unknown_status(tmp_path: Path) -> None:
    assert read_run(make_run(tmp_path / "a")).status == "unknown"


@pytest.mark.parametrize("status", ["failed", "interrupted"])
def test_a_broken_run_keeps_its_sentence(tmp_path: Path, status: str) -> None:
    run = read_run(make_run(tmp_path / "a", status=status, error="the loss became NaN"))
    assert (run.status, run.error) == (status, "the loss became NaN")


def test_a_run_whose_process_lives_is_running(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path / "a", status="running", host=socket.gethostname(), pid=os.getpid()))
    assert (run.status, run.error) == ("running", None)


def test_a_run_whose_process_is_gone_is_unfinished(tmp_path: Path) -> None:
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    run = read_run(make_run(tmp_path / "a", status="running", host=socket.gethostname(), pid=gone.pid))
    assert run.status == "unfinished"
    assert run.error is not None
    assert "killed" in run.error


def test_a_run_elsewhere_lives_as_long_as_it_writes(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "a", status="running", host="another-machine", pid=os.getpid())
    assert read_run(folder).status == "running"
    old = time.time() - SIGN_OF_LIFE - 1
    for path in folder.rglob("*"):
        os.utime(path, (old, old))
    assert read_run(folder).status == "unfinished"


def test_validation_counts_at_its_best_epoch(tmp_path: Path) -> None:
    (score,) = read_run(make_run(tmp_path / "a", abs_rel=(0.4, 0.2, 0.3))).scores
    assert score.errors == (0.2, *ERRORS[1:])
    assert (score.images, score.validation, score.data) == (4, True, "synthetic, validation split")


def test_best_is_the_highest_where_more_is_better(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "a", abs_rel=(0.4, 0.2, 0.3))
    log = folder / "csv" / "metrics.csv"
    rows = list(csv.DictReader(log.read_text().splitlines()))
    measured = [row for row in rows if row["val/a1"]]
    for row, value in zip(measured, (0.5, 0.7, 0.9), strict=True):
        row["val/a1"] = str(value)
    with log.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    config = folder / ".hydra" / "config.yaml"
    config.write_text(config.read_text() + "\nmonitor: val/a1\n")
    (score,) = read_run(folder).scores
    assert score.errors[4] == 0.9


def test_files_cut_short_by_a_kill_do_no_harm(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "a", status="finished")
    log = folder / "csv" / "metrics.csv"
    log.write_text(log.read_text() + "3,9,1.")
    (folder / "run.json").write_text(json.dumps({"status": "finished"})[:-5])
    (folder / ".hydra" / "overrides.yaml").write_text("- [")
    run = read_run(folder)
    assert run.status == "unknown"
    assert run.history[-1] == {"epoch": 3, "step": 9, "train/loss": 1.0}


def test_the_wanted_checkpoint_is_taken_or_the_other(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "a")
    assert read_run(folder).checkpoint is None
    (folder / "checkpoints").mkdir()
    (folder / "checkpoints" / "last.ckpt").touch()
    assert read_run(folder, "best").checkpoint == folder / "checkpoints" / "last.ckpt"
    (folder / "checkpoints" / "best.ckpt").touch()
    assert read_run(folder, "best").checkpoint == folder / "checkpoints" / "best.ckpt"
