"""How many threads compute: control groups of both kinds, cores that others use, and what the user has set."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import tiny
import torch

from saunet import threads
from saunet.threads import WAITING, Usage, available_cores, free, wait_briefly
from saunet.training.pace import Threads


@pytest.fixture
def eight(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine of eight cores, all allowed."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 8)


def tree(root: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root


V2, V1 = "0::/a/b\n", "4:memory:/x\n3:cpu,cpuacct:/a\n0::/\n"
GROUP, MOUNT = "proc/self/cgroup", "sys/fs/cgroup"


@pytest.mark.usefixtures("eight")
@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({}, 8),
        ({GROUP: V2, f"{MOUNT}/a/b/cpu.max": "max 100000\n"}, 8),
        ({GROUP: V2, f"{MOUNT}/a/b/cpu.max": "300000 100000\n"}, 3),
        ({GROUP: V2, f"{MOUNT}/a/b/cpu.max": "350000 100000\n"}, 3),
        ({GROUP: V2, f"{MOUNT}/a/b/cpu.max": "50000 100000\n"}, 1),
        ({GROUP: V2, f"{MOUNT}/a/b/cpu.max": "900000 100000\n", f"{MOUNT}/a/cpu.max": "200000 100000\n"}, 2),
        ({GROUP: V2, f"{MOUNT}/cpu.max": "400000 100000\n"}, 4),  # a container that names its group as the host sees it
        ({GROUP: "0::/\n", f"{MOUNT}/unified/cpu.max": "400000 100000\n"}, 4),
        (
            {
                GROUP: V1,
                f"{MOUNT}/cpu,cpuacct/a/cpu.cfs_quota_us": "250000\n",
                f"{MOUNT}/cpu,cpuacct/a/cpu.cfs_period_us": "50000\n",
            },
            5,
        ),
        ({GROUP: V1, f"{MOUNT}/cpu/a/cpu.cfs_quota_us": "-1\n", f"{MOUNT}/cpu/a/cpu.cfs_period_us": "100000\n"}, 8),
    ],
)
def test_cores_of_a_control_group(files: dict[str, str], expected: int, tmp_path: Path) -> None:
    assert available_cores(tree(tmp_path, files)) == expected


def test_cores_of_the_affinity_mask(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {1, 5}, raising=False)
    assert available_cores(tmp_path) == 2


@pytest.mark.usefixtures("eight")
@pytest.mark.parametrize(
    ("most", "taken", "expected"),
    [(8, 0.0, 8), (8, 0.4, 8), (8, 0.6, 7), (8, 8.0, 1), (8, 20.0, 1), (2, 5.0, 2), (2, 6.8, 1), (1, 0.0, 1)],
)
def test_threads_for_free_cores(most: int, taken: float, expected: int) -> None:
    assert free(most, taken) == expected


def test_others_are_what_this_process_did_not_use() -> None:
    before, after = Usage(10.0, everybody=100.0, own=7.0), Usage(20.0, everybody=125.0, own=17.0)
    assert after.taken_since(before) == pytest.approx(1.5)
    assert before.taken_since(before) == 0


@pytest.mark.skipif(not Path("/proc/stat").exists(), reason="the system does not tell how its cores are used")
def test_the_work_of_this_process_is_its_own() -> None:
    before = Usage.now()
    assert before is not None
    began = sum(os.times()[:2])
    while sum(os.times()[:2]) < began + 0.3:
        sum(range(1000))
    after = Usage.now()
    assert after is not None
    assert after.own - before.own == pytest.approx(0.3, abs=0.2)
    assert after.everybody - before.everybody >= after.own - before.own - 0.1


@pytest.mark.parametrize("given", ["OMP_WAIT_POLICY", *WAITING])
def test_the_users_way_of_waiting_stays(given: str, monkeypatch: pytest.MonkeyPatch) -> None:
    environment = {given: "active"}
    monkeypatch.setattr(os, "environ", environment)
    wait_briefly()
    assert environment == {given: "active"}
    environment.clear()
    wait_briefly()
    assert environment == WAITING


def test_the_command_sets_how_threads_wait_before_it_imports_torch() -> None:
    code = (
        "import os, sys, saunet.cli.app as app, saunet.threads as threads\n"
        "app._run = lambda *_: print('torch' in sys.modules, os.environ['GOMP_SPINCOUNT']) or 0\n"
        "app.main(['predict'])"
    )
    environment = {key: value for key, value in os.environ.items() if key not in {"OMP_WAIT_POLICY", *WAITING}}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", WAITING["GOMP_SPINCOUNT"]]


class Machine:
    """Eight cores, of which others use so many; a clock of its own."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, taken: float, load: float) -> None:
        self.taken, self.time, self.used, self.threads = taken, 0.0, 0.0, 8
        monkeypatch.setattr(Usage, "now", lambda: Usage(self.time, self.used, 0.0))
        monkeypatch.setattr(threads.time, "monotonic", lambda: self.time)
        monkeypatch.setattr(threads.time, "sleep", self.sleep)
        monkeypatch.setattr(os, "getloadavg", lambda: (load, load, load))
        monkeypatch.setattr("saunet.training.pace.available_cores", lambda: 8)
        monkeypatch.setattr(torch, "get_num_threads", lambda: self.threads)
        monkeypatch.setattr(torch, "set_num_threads", lambda count: setattr(self, "threads", count))
        for name in threads.SETTINGS:
            monkeypatch.delenv(name, raising=False)

    def sleep(self, seconds: float) -> None:
        self.time += seconds
        self.used += seconds * self.taken


@pytest.mark.usefixtures("eight")
@pytest.mark.parametrize(
    ("taken", "load", "expected"),
    [(0.0, 0.0, 8), (3.0, 3.2, 5), (8.0, 9.0, 1), (0.0, 8.0, 8), (8.0, 0.2, 8)],  # a minute ago, or for a moment only
)
def test_a_training_starts_with_the_threads_that_find_a_core(
    taken: float,
    load: float,
    expected: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    machine, trainer, callback = Machine(monkeypatch, taken, load), tiny.tiny_trainer(tmp_path), Threads()
    with caplog.at_level("INFO"):
        callback.on_fit_start(trainer, tiny.tiny_model())
    assert machine.threads == expected
    assert f"with {expected} thread" in caplog.text
    assert "8 cores" in caplog.text
    assert "OMP_NUM_THREADS" in caplog.text
    callback.teardown(trainer, tiny.tiny_model(), "fit")
    assert machine.threads == 8


@pytest.mark.usefixtures("eight")
def test_threads_follow_the_load(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    machine, trainer, model = Machine(monkeypatch, 0.0, 0.0), tiny.tiny_trainer(tmp_path), tiny.tiny_model()
    callback, seen, batch = Threads(every=20.0), [], dict[str, Any]()
    callback.on_fit_start(trainer, model)
    for machine.taken in (0.0, 6.0, 6.0, 0.0):
        machine.sleep(19)
        callback.on_train_batch_start(trainer, model, batch, 0)
        seen.append(machine.threads)
        machine.sleep(2)
        callback.on_train_batch_start(trainer, model, batch, 0)
        seen.append(machine.threads)
    assert seen == [8, 8, 8, 2, 2, 2, 2, 8]


@pytest.mark.usefixtures("eight")
@pytest.mark.parametrize("name", threads.SETTINGS)
def test_the_users_number_of_threads_stays(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    machine, trainer, callback = Machine(monkeypatch, 8.0, 8.0), tiny.tiny_trainer(tmp_path), Threads()
    monkeypatch.setenv(name, "8")
    with caplog.at_level("INFO"):
        callback.on_fit_start(trainer, tiny.tiny_model())
        machine.sleep(100)
        callback.on_train_batch_start(trainer, tiny.tiny_model(), {}, 0)
    assert machine.threads == 8
    assert f"as {name} says" in caplog.text
