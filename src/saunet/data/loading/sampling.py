"""Samplers of whole batches that are the same for any number of devices, and a loader that can resume.

A sampler yields lists of items, one list a batch, to a loader with ``batch_size=None``.
"""

from __future__ import annotations

import math
import os
import signal
import time
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset, DistributedSampler

from saunet.data.loading.windows import Item
from saunet.errors import ConfigError, SaunetError
from saunet.threads import available_cores

AHEAD = 4  # batches that each loader process keeps ready: enough to hide one slow file or a validation


class TrainBatches(DistributedSampler[Any]):
    """Shuffled batches of `Item`; step k sees the same samples and random numbers on any number of devices."""

    def __init__(
        self, dataset: Dataset[Any], batch_size: int, seed: int = 0, rank: int = 0, world_size: int = 1
    ) -> None:
        super().__init__(dataset, num_replicas=world_size, rank=rank, shuffle=True, seed=seed, drop_last=True)
        self.batch_size = batch_size
        self.share = share(batch_size, world_size)
        self.count = len(dataset)  # type: ignore[arg-type]
        self.start = 0
        self.start_epoch: int | None = None
        if self.count < batch_size:
            raise ConfigError(
                f"batch_size is {batch_size} but there are only {self.count} training samples; "
                f"use data.batch_size={max(world_size, self.count // world_size * world_size)} or less, or more data"
            )

    def __len__(self) -> int:
        return self.count // self.batch_size

    @property
    def first(self) -> int:
        """The batch with which the next epoch begins: where a resumed run stopped, if it is that epoch."""
        return self.start if self.start_epoch in (None, self.epoch) else 0

    def __iter__(self) -> Iterator[list[Item]]:
        random = np.random.default_rng([self.seed, self.epoch])
        order = random.permutation(self.count)
        seeds = random.integers(2**63, size=self.count)
        first = self.rank * self.share
        start, self.start = self.first, 0
        for step in range(start, len(self)):
            part = slice(step * self.batch_size + first, step * self.batch_size + first + self.share)
            yield [Item(*each) for each in zip(order[part].tolist(), seeds[part].tolist(), strict=True)]


class EvalBatches(DistributedSampler[Any]):
    """Every sample exactly once over all devices, in order, and the same number of batches on each.

    Equal numbers of batches keep the collective operations of a step (buffer broadcast) in sync; batch sizes differ by
    at most one.
    """

    def __init__(self, dataset: Dataset[Any], batch_size: int, rank: int = 0, world_size: int = 1) -> None:
        super().__init__(dataset, num_replicas=world_size, rank=rank, shuffle=False)
        count = len(dataset)  # type: ignore[arg-type]
        if count < world_size:
            fix = f"use trainer.devices={count}"
            raise ConfigError(f"{count} samples cannot be evaluated on {world_size} devices; {fix}")
        self.indices = np.arange(rank, count, world_size)
        self.batches = min(math.ceil(math.ceil(count / world_size) / batch_size), count // world_size)

    def __len__(self) -> int:
        return self.batches

    def __iter__(self) -> Iterator[list[int]]:
        for part in np.array_split(self.indices, self.batches):
            yield part.tolist()


def evenly(count: int, most: int) -> list[int]:
    """Return the positions of at most ``most`` of ``count`` items, spread evenly from the first to the last."""
    return [int(place) for place in np.linspace(0, count - 1, min(most, count)).round()]


def share(batch_size: int, world_size: int) -> int:
    if batch_size < 1 or batch_size % world_size:
        nearest = max(1, round(batch_size / world_size)) * world_size
        raise ConfigError(
            f"batch_size is {batch_size}; it is the total over all {world_size} devices and must be a positive "
            f"multiple of their number, such as {nearest}"
        )
    return batch_size // world_size


GRACE = 30
"""Seconds that a loader process keeps working after it was told to end; its user ends it earlier."""


def processes(wanted: int) -> dict[str, Any]:
    """Return the settings of a `torch.utils.data.DataLoader` for this many processes, at most one per core."""
    workers = min(wanted, available_cores())
    return {
        "num_workers": workers,
        "prefetch_factor": AHEAD if workers else None,
        "pin_memory": torch.cuda.is_available(),
        "persistent_workers": workers > 0,
        "worker_init_fn": _prepare,
    }


def _prepare(worker: int) -> None:
    """Use one thread, and keep working for a while after the process group is told to end: the first process saves.

    That process may be in the middle of an epoch or a validation, and needs the batches in progress. Only it reports:
    its handler of Ctrl-C, which a terminal sends to the whole group, is not kept here.
    """
    cv2.setNumThreads(0)
    torch.set_num_threads(1)
    if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:
        signal.signal(signal.SIGINT, _end_at_the_second)
    for name in ("SIGTERM", "SIGHUP"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), _end_later)


def _end_at_the_second(number: int, frame: object) -> None:
    signal.signal(number, signal.default_int_handler)


def _end_later(number: int, frame: object) -> None:
    if not hasattr(signal, "alarm"):  # Windows
        os._exit(0)
    signal.signal(signal.SIGALRM, lambda *_: os._exit(0))  # without torch's error about its processes
    signal.alarm(GRACE)


class Loader(DataLoader[Any]):
    """A loader that reports a bad file in one sentence, and measures how long its user waits."""

    waited = 0.0
    """Seconds spent waiting for batches so far."""

    def __iter__(self) -> Iterator[Any]:  # type: ignore[override]
        try:
            batches = iter(super().__iter__())
            while True:
                began = time.perf_counter()
                batch = next(batches, None)
                self.waited += time.perf_counter() - began
                if batch is None:
                    return
                yield batch
        except SaunetError as error:
            # torch puts a loader process's traceback into the message; its last line is the error
            name = f"{type(error).__module__}.{type(error).__qualname__}: "
            raise type(error)(str(error).rpartition(name)[2].strip()) from error


class ResumableLoader(Loader):
    """A loader over `TrainBatches` that can be saved in the middle of an epoch and resumes with the next batch."""

    _done = 0

    def __iter__(self) -> Iterator[Any]:  # type: ignore[override]
        self._done = self.sampler.first  # type: ignore[attr-defined]
        for batch in super().__iter__():
            self._done += 1
            yield batch

    def state_dict(self) -> dict[str, int]:
        """Return the epoch and how many of its batches were handed out; 0 after the last.

        An epoch that a limit ends early counts as complete: the next one must not begin in the middle.
        """
        return {"batches": self._done % max(1, len(self)), "epoch": self.sampler.epoch}  # type: ignore[attr-defined]

    def load_state_dict(self, state: dict[str, int]) -> None:
        self.sampler.start, self.sampler.start_epoch = state["batches"], state.get("epoch")  # type: ignore[attr-defined]
