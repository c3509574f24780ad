"""What a run leaves about itself, and sweeps of which a job fails."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import pytest
import yaml

from saunet.errors import DataError
from saunet.runs.folder import RunRecord
from saunet.runs.sweep import summary
from saunet.training.stopping import GracefulStop

Tool = Callable[..., Any]
NARROW = ("model/encoder=lite_mono_tiny", "model.encoder.dims=[8,16,16]", "model.encoder.depths=[2,2,2]")
SMALL = (*NARROW, "model/pose=posecnn")
QUICK = ("experiment=smoke", "logger=none", "callbacks.pictures=null", *SMALL)


def record(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "run.json").read_text())
    return content


def test_a_finished_run_says_so(smoke_run: Path) -> None:
    content = record(smoke_run)
    assert (content["status"], content["error"], content["name"]) == ("finished", None, "smoke")
    assert {"train", "val"} == set(content["splits"])
    assert all(len(each) == 64 for each in content["splits"].values())


def test_what_a_run_says_is_in_its_log_once(smoke_run: Path) -> None:
    said = (smoke_run / "train.log").read_text()
    for line in ("train (", "val (", "networks: depth"):
        assert said.count(f" INFO {line}") == 1
    assert record(smoke_run)["splits"]["train"][:16] in said


@pytest.mark.slow
@pytest.mark.parametrize(
    ("package", "options"),
    [
        ("hydra_plugins.hydra_joblib_launcher", ("hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "seed=1,2")),
        ("hydra_plugins.hydra_submitit_launcher", ("hydra/launcher=submitit_local", "seed=1,2")),
        (
            "hydra_plugins.hydra_optuna_sweeper",
            ("hydra/sweeper=optuna", "hydra.sweeper.n_trials=2", "hydra.sweeper.n_jobs=1",
             "hydra.sweeper.sampler.seed=1", "optim.lr=tag(log,interval(1e-5,1e-3))"),
        ),
    ],
    ids=["joblib", "submitit", "optuna"],
)  # fmt: skip
def test_launchers_and_searches_of_the_extra_sweep(package: str, options: tuple[str, ...], tmp_path: Path) -> None:
    pytest.importorskip(package, reason="the extra 'sweep' is not installed")
    command = [sys.executable, "-m", "saunet.cli.train", "-m", *QUICK, *options, "hydra.sweep.dir=sweep"]
    run = subprocess.run(
        command, cwd=tmp_path, env={**os.environ, "OMP_NUM_THREADS": "1"}, capture_output=True, text=True, timeout=300
    )
    assert run.returncode == 0, run.stderr
    assert "sweep: 2 of 2 jobs finished" in run.stdout
    for job in ("0", "1"):
        assert record(tmp_path / "sweep" / job)["status"] == "finished"
        assert (tmp_path / "sweep" / job / "train.log").read_text().count("networks: depth") == 1
    if "optuna" in package:
        found = yaml.safe_load((tmp_path / "sweep" / "optimization_results.yaml").read_text())
        tried = {float(value) for value in re.findall(r"optim\.lr=(\S+)", run.stdout)}
        assert found["best_params"]["optim.lr"] in tried
        assert found["best_value"] > 0


def test_a_failing_job_costs_no_other_and_is_recorded(tool: Tool, tmp_path: Path) -> None:
    jobs = "optim.lr=-1,1e-3"
    outcome = tool("train", "--multirun", *QUICK, "trainer.limit_train_batches=1", jobs, "hydra.sweep.dir=sweep")
    assert outcome.code == 1
    assert "Traceback" not in outcome.err
    assert "job 0" in outcome.err
    assert "sweep: 1 of 2 jobs finished" in outcome.err
    assert "optim.lr=-1) failed: optim.lr is -1.0; it must be greater than 0" in outcome.err
    failed, finished = record(tmp_path / "sweep" / "0"), record(tmp_path / "sweep" / "1")
    assert failed["status"] == "failed"
    assert failed["error"].startswith("optim.lr is -1.0")
    assert finished["status"] == "finished"
    assert (tmp_path / "sweep" / "1" / "checkpoints" / "last.ckpt").is_file()


def test_a_job_that_vanished_is_marked_failed_in_the_summary(tmp_path: Path) -> None:
    for job in ("0", "1", "10", "2"):
        RunRecord(tmp_path / job, "x").start()
    RunRecord(tmp_path / "2", "x").end("finished")
    text, finished = summary(tmp_path)
    lines = text.splitlines()
    assert not finished
    assert lines[0].startswith("sweep: 1 of 4 jobs finished")
    assert [line.split()[0] for line in lines[1:]] == ["0", "1", "10"]
    assert "killed" in record(tmp_path / "10")["error"]


def test_a_sweep_does_not_write_its_jobs_over_each_other(tool: Tool, tmp_path: Path) -> None:
    jobs = ("train", "--multirun", *QUICK, "trainer.limit_train_batches=1", "seed=1,2")
    outcome = tool(*jobs, "output_dir=runs/all", "hydra.sweep.dir=sweep")
    assert outcome.code == 1
    assert "output_dir is 'runs/all'" in outcome.err
    assert "set hydra.sweep.dir=runs/all, where each job gets a folder of its own" in outcome.err
    assert "sweep:" not in outcome.out
    assert not (tmp_path / "runs").exists()
    outcome = tool(*jobs, "output_dir=${hydra:runtime.output_dir}/run", "hydra.sweep.dir=sweep")
    assert outcome.code == 0, outcome.err
    assert "sweep: 2 of 2 jobs finished" in outcome.out


def test_a_second_sweep_in_a_folder_is_refused(tool: Tool, tmp_path: Path) -> None:
    hold = (
        "import time\nfrom saunet.runs.folder import locked\nwith locked('sweep'): print(1, flush=True), time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", hold], stdout=subprocess.PIPE, cwd=tmp_path) as first:
        assert first.stdout is not None
        first.stdout.readline()
        before = set(tmp_path.rglob("*"))
        outcome = tool("train", "--multirun", *QUICK, "seed=1,2", "hydra.sweep.dir=sweep")
        first.kill()
    assert outcome.code == 1
    assert "another run is writing to" in outcome.err
    assert set(tmp_path.rglob("*")) == before


def test_a_job_that_another_process_is_at_work_on_is_not_marked(tmp_path: Path) -> None:
    RunRecord(tmp_path / "0", "x", pid=os.getppid()).start()
    text, finished = summary(tmp_path)
    assert not finished
    assert "running" in text
    assert record(tmp_path / "0")["status"] == "running"


def test_a_sweep_without_a_job_has_not_finished(tmp_path: Path) -> None:
    text, finished = summary(tmp_path)
    assert not finished
    assert text.startswith("sweep: 0 of 0 jobs finished")


def test_an_interrupted_sweep_names_the_jobs_that_never_started(
    tool: Tool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def press(self: GracefulStop, *_: Any) -> None:
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(GracefulStop, "on_before_backward", press, raising=False)
    outcome = tool("train", "--multirun", *QUICK, "seed=1,2,3", "hydra.sweep.dir=sweep")
    assert outcome.code == 130
    assert "sweep: 0 of 3 jobs finished" in outcome.err
    assert re.findall(r"\(.*seed=(\d)\) (interrupted|not started)", outcome.err) == [
        ("1", "interrupted"), ("2", "not started"), ("3", "not started")
    ]  # fmt: skip
    kept = (tmp_path / "sweep" / "0" / "train.log").read_text()
    assert kept.count("SIGINT: finishing the step, then saving") == 1
    assert kept.count("saunet train: stopped by SIGINT after step") == 1


def test_resume_and_warm_start_on_the_command_line(tool: Tool, smoke_run: Path, tmp_path: Path) -> None:
    last = smoke_run / "checkpoints" / "last.ckpt"
    again = ("experiment=smoke", "logger=none", "callbacks.pictures=null", "trainer.limit_train_batches=1", SMALL[-1])
    outcome = tool("train", *again, f"init_from={last}", "optim.lr=1e-5", "output_dir=warm")
    assert outcome.code == 0, outcome.err
    assert "starting from" in outcome.out
    outcome = tool("resume", "warm", "trainer.max_epochs=2")  # whose experiment may have set init_from
    assert outcome.code == 0, outcome.err
    assert "init_from" not in outcome.out + outcome.err  # it is what the run started from
    other = last.with_name("best.ckpt")
    outcome = tool("train", *again, f"init_from={other}", "resume=warm/checkpoints/last.ckpt", "output_dir=warm")
    assert outcome.code == 0, outcome.err
    assert f"init_from={other} is not used" in outcome.out + outcome.err
    kept = (tmp_path / "warm" / "train.log").read_text()
    assert [kept.count(f" INFO {words}") for words in ("starting from", "resuming from", "results: ")] == [1, 2, 3]


def test_the_log_of_a_run_holds_why_it_failed(tool: Tool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(error: Exception) -> Callable[..., None]:
        def hook(self: GracefulStop, *_: Any) -> None:
            raise error

        return hook

    monkeypatch.setattr(GracefulStop, "on_before_backward", fail(DataError("the disk is gone")), raising=False)
    tool("train", *QUICK, "output_dir=failed").says("the disk is gone")
    assert "saunet train: the disk is gone" in (tmp_path / "failed" / "train.log").read_text()
    monkeypatch.setattr(GracefulStop, "on_before_backward", fail(ZeroDivisionError("of ours")))
    with pytest.raises(ZeroDivisionError):
        tool("train", *QUICK, "output_dir=defect")
    kept = (tmp_path / "defect" / "train.log").read_text()
    assert "Traceback" in kept
    assert "ZeroDivisionError: of ours" in kept


def test_a_finished_run_is_not_replaced_by_mistake(tool: Tool, smoke_run: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(smoke_run, run)
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    for mistake, words in (
        ((), "holds best.ckpt of an earlier run; continue it with resume=auto"),
        (("seed=-1", "resume=auto"), "seed is -1"),
        (("resume=run/checkpoints/lst.ckpt",), "no checkpoint at"),
        (("resume=run/checkpoints/last.ckpt",), "checkpoint of another model"),  # refused once the data were set up
    ):
        outcome = tool("train", *QUICK, "hydra.run.dir=run", *mistake)
        outcome.says(words)
        assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before
    outcome = tool("train", *QUICK, "trainer.limit_train_batches=1", "hydra.run.dir=run", "overwrite=true")
    assert outcome.code == 0, outcome.err
    assert (run / "checkpoints" / "best.ckpt").read_bytes() != before[run / "checkpoints" / "best.ckpt"]


def test_a_training_of_some_length_ends_with_a_picture(tool: Tool, smoke_run: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="the extra 'plot' is not installed")
    few = ("trainer.limit_train_batches=1", "trainer.limit_val_batches=0", "trainer.log_every_n_steps=10")
    outcome = tool("train", "experiment=smoke", *SMALL, *few, "trainer.max_epochs=10", "hydra.run.dir=run")
    assert outcome.code == 0, outcome.err
    assert cv2.imread(str(tmp_path / "run" / "results.png")).shape[1] > 500
    with (tmp_path / "run" / "csv" / "metrics.csv").open() as file:
        assert sum(bool(row["train/loss"]) for row in csv.DictReader(file)) == 10  # not one alone: it is short
    assert not (smoke_run / "results.png").exists()  # two steps are no curve


def test_a_job_whose_config_is_refused_is_recorded(tool: Tool, tmp_path: Path) -> None:
    outcome = tool("train", "--multirun", *QUICK, "seed=-1,-2", "hydra.sweep.dir=sweep")
    assert outcome.code == 1
    assert "seed=-2) failed: seed is -2; it must be at least 0" in outcome.err
    assert record(tmp_path / "sweep" / "1")["status"] == "failed"


@pytest.mark.slow
def test_sigterm_ends_a_run_with_a_message_and_a_record(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "saunet.cli.train", *QUICK, "trainer.max_epochs=500", "resume=auto"]
    command += [f"hydra.run.dir={tmp_path}/r", "trainer.limit_train_batches=1.0", "trainer.limit_val_batches=0"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "FORCE_COLOR": "1", "TERM": "xterm"}  # a bar in a pipe
    errors = tmp_path / "stderr"  # a file: a pipe that nobody reads fills and blocks the run
    for attempt in range(2):
        with (
            errors.open("w") as stderr,
            subprocess.Popen(command, stdout=subprocess.PIPE, stderr=stderr, text=True, env=environment) as run,
        ):
            assert run.stdout is not None
            heard = ""
            while "loss=" not in heard:  # the progress bar, once a step was made
                letter = run.stdout.read(1)
                if not letter:
                    pytest.fail(f"the run ended before its first step: {errors.read_text()}")
                heard += letter
            run.send_signal(signal.SIGTERM)
            out, _ = run.communicate()
        err = errors.read_text()
        assert run.returncode == 143
        assert "saunet train: stopped by SIGTERM after step" in err
        assert f"resume with saunet resume {tmp_path}/r" in err
        assert record(tmp_path / "r")["status"] == "interrupted"
        assert ("resuming from" in heard + out) == (attempt == 1)


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0.0, 1.0])
def test_sigterm_to_the_whole_group_before_the_first_step_is_an_interruption(delay: float, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "saunet", "train", *QUICK, "data.workers=2", f"output_dir={tmp_path}/r"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    said, file = tmp_path / "said", tmp_path / "r" / "run.json"
    command += ["trainer.max_epochs=500", "trainer.limit_val_batches=0"]
    with (
        said.open("w") as stream,
        subprocess.Popen(command, stdout=stream, stderr=stream, env=environment, start_new_session=True) as run,
    ):
        while not file.exists():  # it is written before the loader's processes start
            assert run.poll() is None, said.read_text()
            time.sleep(0.02)
        time.sleep(delay)
        os.killpg(run.pid, signal.SIGTERM)
    assert run.returncode == 143, said.read_text()
    assert "Traceback" not in said.read_text()
    assert record(tmp_path / "r")["status"] == "interrupted"


@pytest.mark.slow
def test_ctrl_c_in_a_terminal_is_answered_once_and_the_second_ends_at_once(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "saunet", "train", *QUICK, "data.workers=2", f"output_dir={tmp_path}/r"]
    command += ["trainer.max_epochs=500", "trainer.limit_train_batches=1.0", "trainer.limit_val_batches=0"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "FORCE_COLOR": "1", "TERM": "xterm"}  # a bar in a pipe
    for again in (0, 1):
        said = tmp_path / f"said {again}"
        with (
            said.open("w") as stream,
            subprocess.Popen(
                [*command, f"output_dir={tmp_path}/r{again}"],
                stdout=stream,
                stderr=stream,
                env=environment,
                start_new_session=True,
            ) as run,
        ):
            while "loss=" not in said.read_text():  # the bar, once a step was made
                assert run.poll() is None, said.read_text()
                time.sleep(0.02)
            os.killpg(run.pid, signal.SIGINT)
            while again and "finishing" not in said.read_text() and run.poll() is None:
                time.sleep(0.001)
            if again and run.poll() is None:
                os.killpg(run.pid, signal.SIGINT)
        assert run.returncode == 130, said.read_text()
        assert said.read_text().count("SIGINT: finishing the step, then saving") == 1
        assert "Traceback" not in said.read_text()
        assert "stopped by SIGINT after step" in said.read_text() or again
