"""Loader processes: how many a machine has room for, and one thread for each."""

from __future__ import annotations

import os

import cv2
import torch


def single_threaded(worker: int) -> None:
    """Keep a loader process to one thread: the processes are the parallelism."""
    cv2.setNumThreads(0)
    torch.set_num_threads(1)


def available_cores() -> int:
    """Return how many cores this process may use: fewer than the machine has, under a scheduler or in a container."""
    allowed = getattr(os, "sched_getaffinity", None)  # Linux only
    return len(allowed(0)) if allowed else os.cpu_count() or 1
