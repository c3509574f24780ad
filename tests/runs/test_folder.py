"""``run.json`` after every kind of end."""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from saunet.errors import ConfigError, DataError
from saunet.runs.folder import (
    RunRecord,
    Stopped,
    first_process,
    git_state,
    locked,
    mark_lost,
    read,
    record_failed_start,
    recording,
    versions,
)


def content(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "run.json").read_text())
    return found


def test_it_says_running_and_then_finished(tmp_path: Path) -> None:
    with recording(tmp_path, "trial") as record:
        during = content(tmp_path)
        record.write(splits={"train": "abc"})
    after = content(tmp_path)
    assert (during["status"], during["ended"], during["error"]) == ("running", None, None)
    assert (after["status"], after["name"], after["splits"]) == ("finished", "trial", {"train": "abc"})
    assert after["ended"] >= after["started"] == during["started"]
    assert {"python", "torch", "lightning", "saunet"} <= set(after["versions"])


@pytest.mark.parametrize(
    ("error", "status", "said"),
    [
        (DataError("no frames"), "failed", "no frames"),
        (ZeroDivisionError("by\nzero"), "failed", "ZeroDivisionError: by zero"),
        (OSError(28, "full"), "failed", "the disk, in one sentence"),
        (KeyboardInterrupt(), "interrupted", "interrupted"),
        (Stopped("stopped by SIGTERM", 143), "interrupted", "stopped by SIGTERM"),
    ],
)
def test_every_end_is_written_down(tmp_path: Path, error: BaseException, status: str, said: str) -> None:
    def describe(reason: Exception) -> str | None:
        return "the disk, in one sentence" if isinstance(reason, OSError) else None

    with pytest.raises(type(error)), recording(tmp_path, "trial", describe):
        raise error
    after = content(tmp_path)
    assert (after["status"], after["error"]) == (status, said)
    assert after["ended"] is not None


def test_what_another_process_of_the_run_wrote_stays(tmp_path: Path) -> None:
    with recording(tmp_path, "trial"):
        there = content(tmp_path)
        (tmp_path / "run.json").write_text(json.dumps({**there, "splits": {"val": "def"}}))
    assert content(tmp_path)["splits"] == {"val": "def"}


def test_a_new_run_in_the_folder_begins_a_new_record(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text(json.dumps({"status": "failed", "error": "old"}))
    with recording(tmp_path, "trial"):
        assert content(tmp_path)["error"] is None


def test_a_run_that_vanished_is_marked_failed_once(tmp_path: Path) -> None:
    RunRecord(tmp_path, "trial").start()
    mark_lost(tmp_path)
    assert content(tmp_path)["status"] == "failed"
    assert "killed" in content(tmp_path)["error"]
    mark_lost(tmp_path, "once more")
    assert "killed" in content(tmp_path)["error"]
    (tmp_path / "run.json").write_text("half a rec")
    assert read(tmp_path) == {}
    mark_lost(tmp_path / "nowhere")
    assert not (tmp_path / "nowhere").exists()


def test_a_folder_that_cannot_be_written_to_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(ConfigError, match=r"cannot write .*run\.json"), recording(tmp_path / "file", "trial"):
        pass


@pytest.mark.parametrize(
    ("environment", "first"),
    [
        ({}, True),
        ({"RANK": "0", "LOCAL_RANK": "0"}, True),
        ({"RANK": "4", "LOCAL_RANK": "0"}, False),
        ({"LOCAL_RANK": "1"}, False),
        ({"NODE_RANK": "1", "LOCAL_RANK": "0"}, False),
        ({"SLURM_PROCID": "3"}, False),
    ],
)
def test_only_the_first_process_writes(
    environment: dict[str, str], first: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name in ("RANK", "LOCAL_RANK", "NODE_RANK", "SLURM_PROCID"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert first_process() == first
    with recording(tmp_path, "trial"):
        assert (tmp_path / "run.json").exists() == first


@pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")
def test_git_state_belongs_to_the_code_and_not_to_the_folder_around_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [name for name in os.environ if name.startswith("GIT_")]:  # a hook of git names its repository
        monkeypatch.delenv(name)
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))  # the temporary folder may lie in a repository
    monkeypatch.setenv("GIT_CONFIG_GLOBAL", os.devnull)

    def git(*arguments: str) -> None:
        identity = ("-c", "user.name=a", "-c", "user.email=a@b.c", "-c", "commit.gpgsign=false")
        subprocess.run(["git", "-C", str(tmp_path), *identity, *arguments], check=True, capture_output=True)

    code = tmp_path / "code.py"
    code.write_text("1")
    assert git_state(code) is None  # no repository
    git("init", "-q")
    assert git_state(code) is None  # not one of its files
    git("add", "code.py")
    git("commit", "-q", "-m", "x")
    clean = git_state(code)
    assert clean is not None
    assert (len(clean["commit"]), clean["dirty"]) == (40, False)
    code.write_text("2")
    assert git_state(code) == {"commit": clean["commit"], "dirty": True}


def test_versions_are_strings() -> None:
    assert all(isinstance(value, str) for value in versions().values())


def test_what_a_run_is_stands_in_its_record(tmp_path: Path) -> None:
    config = {"optim": {"clip": math.inf, "betas": (0.9, -math.inf)}}
    with recording(tmp_path, "trial", config=config, choices={"data": "kitti"}, overrides=["seed=1"]):
        pass
    after = content(tmp_path)
    assert after["config"] == {"optim": {"clip": ".inf", "betas": [0.9, "-.inf"]}}
    assert (after["choices"], after["overrides"]) == ({"data": "kitti"}, ["seed=1"])


def test_a_failed_start_is_recorded_where_there_is_no_record(tmp_path: Path) -> None:
    record_failed_start(tmp_path, "trial", ConfigError("seed is -1"), lambda error: None)
    assert (content(tmp_path)["status"], content(tmp_path)["error"]) == ("failed", "seed is -1")
    record_failed_start(tmp_path, "trial", ConfigError("seed is -2"), lambda error: None)
    assert content(tmp_path)["error"] == "seed is -1"


HOLD = """
import sys
from saunet.runs.folder import locked, recording
with locked(sys.argv[1]), recording(sys.argv[1], "first"):
    print("held", flush=True)
    sys.stdin.readline()
"""


def test_a_second_run_in_a_folder_is_refused_until_the_first_ends_or_dies(tmp_path: Path) -> None:
    for end in ("ends", "is killed"):
        with subprocess.Popen(
            [sys.executable, "-c", HOLD, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as first:
            assert first.stdout is not None
            assert first.stdin is not None
            assert first.stdout.readline() == "held\n"
            with (
                pytest.raises(ConfigError, match=rf"another run \(process {first.pid} on .*another folder"),
                locked(tmp_path),
            ):
                pass
            assert content(tmp_path)["pid"] == first.pid
            if end == "ends":
                first.stdin.write("go on\n")
                first.stdin.flush()
            else:
                first.kill()
        with locked(tmp_path):
            pass
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"]


def test_the_other_processes_of_a_run_need_no_lock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LOCAL_RANK", "1")
    with locked(tmp_path / "new"):
        assert not (tmp_path / "new").exists()
