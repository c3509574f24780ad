"""Loader processes: how many a machine has room for, and one thread for each."""

from __future__ import annotations

import os
from typing import Any

import cv2
import torch

AHEAD = 4
"""Batches that each loader process keeps ready: enough that one slow file, or a validation, is not felt."""


def single_threaded(worker: int) -> None:
    """Keep a loader process to one thread: the processes are the parallelism."""
    cv2.setNumThreads(0)
    torch.set_num_threads(1)


def available_cores() -> int:
    """Return how many cores this process may use: fewer than the machine has, under a scheduler or in a container."""
    allowed = getattr(os, "sched_getaffinity", None)  # Linux only
    return len(allowed(0)) if allowed else os.cpu_count() or 1


def processes(wanted: int) -> dict[str, Any]:
    """Return the settings of a `torch.utils.data.DataLoader` for so many processes, but at most one a core."""
    workers = min(wanted, available_cores())
    return {
        "num_workers": workers,
        "prefetch_factor": AHEAD if workers else None,
        "pin_memory": torch.cuda.is_available(),
        "persistent_workers": workers > 0,
        "worker_init_fn": single_threaded,
    }
