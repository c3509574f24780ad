"""How many processor threads compute, and how they wait for each other.

The threads of an operation meet when it ends. By default, OpenMP's spin until the last one is there: where other
programs hold the cores, they spin for a thread that cannot run because of it, and a training step takes fifty times as
long.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

WAITING = {"GOMP_SPINCOUNT": "1000", "KMP_BLOCKTIME": "1"}
"""Rounds (GNU's OpenMP, torch's on Linux) or milliseconds (LLVM's and Intel's) that a thread spins before it sleeps."""
SETTINGS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS")
"""Variables by which a user says how many threads compute."""


def wait_briefly() -> None:
    """Let waiting OpenMP threads soon sleep, unless the user has set how they wait.

    It counts if torch is not imported yet: the variables are read when its OpenMP library is loaded.
    """
    if not {"OMP_WAIT_POLICY", *WAITING} & os.environ.keys():
        os.environ.update(WAITING)


def available_cores(root: Path = Path("/")) -> int:
    """Return how many cores this process may use: fewer than the machine has, under a scheduler or in a container."""
    allowed = getattr(os, "sched_getaffinity", None)  # Linux only
    count = len(allowed(0)) if allowed else os.cpu_count() or 1
    return max(1, int(min(count, *_quotas(root), math.inf)))


def _quotas(root: Path) -> Iterator[float]:
    """Yield the cores' worth of time that the control groups of this process may use, where they are limited."""
    for line in _read(root / "proc/self/cgroup").splitlines():
        _, controllers, path = line.split(":", 2)
        base = root / "sys/fs/cgroup"
        mounts = [base / controllers, base / "cpu"] if "cpu" in controllers.split(",") else []
        for mount in mounts or ([] if controllers else [base, base / "unified"]):
            group = mount / path.strip("/")  # in a container it may be named as the host sees it: its root counts too
            for folder in (group, *group.parents):
                quota, period = (_read(folder / f"cpu.cfs_{name}_us") for name in ("quota", "period"))
                limit = [quota, period] if quota and period else _read(folder / "cpu.max").split()
                if len(limit) == 2 and limit[0] not in ("max", "-1\n"):
                    yield int(limit[0]) / int(limit[1])
                if folder == mount:
                    break


def _read(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:  # another system, or another layout of its control groups
        return ""


@dataclass(frozen=True)
class Usage:
    """Processor time spent up to a moment, seconds."""

    moment: float
    everybody: float
    own: float
    """By this process and the children that it has now or had."""

    @staticmethod
    def now() -> Usage | None:
        """Return the present figures, or None on a system that does not tell them."""
        first = _read(Path("/proc/stat")).split("\n", 1)[0].split()
        if not first:
            return None
        tick = os.sysconf("SC_CLK_TCK")
        user, nice, system, _, _, interrupts, soft = map(int, first[1:8])
        children = multiprocessing.active_children()  # which also collects those that have ended, so it comes first
        own = sum(os.times()[:4])
        for child in children:
            fields = _read(Path(f"/proc/{child.pid}/stat")).rpartition(")")[2].split()
            own += sum(map(int, fields[11:15])) / tick
        return Usage(time.monotonic(), (user + nice + system + interrupts + soft) / tick, own)

    def taken_since(self, before: Usage) -> float:
        """Return how many cores others have kept busy since another moment."""
        others = (self.everybody - before.everybody) - (self.own - before.own)
        return max(0.0, others / max(self.moment - before.moment, 1e-9))


def free(most: int, taken: float) -> int:
    """Return how many of at most ``most`` threads find a core, of which others keep ``taken`` busy; at least one."""
    return max(1, min(most, math.floor((os.cpu_count() or 1) - taken + 0.5)))
