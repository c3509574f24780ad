"""What set the pace of a finished training, and the one setting to change first."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from lightning.pytorch.utilities import move_data_to_device

from saunet.data.loading.module import DepthDataModule
from saunet.data.loading.sampling import evenly
from saunet.data.loading.windows import Item, collate
from saunet.threads import available_cores

_SAMPLES = 3
_AUGMENT = 0.2
"""Share of a step from where augmentation is worth a word."""


@dataclass(frozen=True, slots=True)
class Pace:
    """Where the time of a training step went, in seconds."""

    step: float
    waiting: float
    """For the loader."""
    augment: float
    """Device transforms."""
    decode: float
    """To read a sample's frames, in one process."""
    rest: float
    """For what else makes a sample: resizing, ground truth."""

    def __str__(self) -> str:
        loader, augment = self.waiting / self.step, self.augment / self.step
        shares = f"{max(0.0, 1 - loader - augment):.0%} networks and losses, {augment:.0%} augmentation, {loader:.0%}"
        sample = f"a sample takes {_ms(self.decode)} to read and {_ms(self.rest)} to resize"
        return f"a step took {_ms(self.step)}: {shares} waiting for the loader, where {sample}"


def _ms(seconds: float) -> str:
    return f"{1000 * seconds:{'.0f' if seconds >= 0.1 else '.3g'}} ms"


def measure(step: float, waiting: float, data: DepthDataModule, batch_size: int, device: torch.device) -> Pace:
    """Add to a step's seconds what its parts cost, by making some samples anew in this process.

    Raises:
        DataError: if a sample cannot be read.
    """
    dataset = data.datasets["train"]
    chosen = evenly(len(dataset), _SAMPLES)
    samples = [dataset[Item(place, place)] for place in chosen]  # files are in memory then, as in later epochs
    steps = (0, *dataset.offsets)

    def decode() -> None:
        for position, frame in (dataset.windows[place] for place in chosen):
            for each in steps:
                dataset.drives[position].image(frame + each)

    decoding = _seconds(decode)
    whole = _seconds(lambda: [dataset[Item(place, place)] for place in chosen])
    batch: Any = move_data_to_device(collate(samples), device)
    data.on_after_batch_transfer(batch, 0)
    augment = _seconds(lambda: data.on_after_batch_transfer(batch, 0), device)
    count = len(chosen)
    return Pace(step, waiting, augment * batch_size / count, decoding / count, max(0.0, whole - decoding) / count)


def _seconds(call: Callable[[], object], device: torch.device | None = None) -> float:
    began = time.perf_counter()
    call()
    if device is not None and device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - began


def first_change(
    pace: Pace, *, share: float, workers: int, cacheable: bool, device: str, precision: str, compiled: bool
) -> str:
    """Return the setting that gains most, where waiting for the loader counts from a share of the time on."""
    cores = available_cores()
    if pace.waiting > share * pace.step:
        if workers < cores:
            wanted = math.ceil(max(1, workers) * pace.step / max(pace.step - pace.waiting, 1e-9))
            return f"data.workers={min(cores, wanted)} (now {workers})"
        if cacheable and pace.decode > pace.rest:
            return "data.cache, with smaller copies made once by saunet prepare cache"
        return "a faster disk, or more cores: no setting helps"
    if pace.augment > _AUGMENT * pace.step:
        return "data.color_jitter_prob=0, which also changes what is learned"
    if device == "cuda" and precision.startswith("32"):
        return "trainer.precision=bf16-mixed"
    if device == "cuda" and not compiled:
        return "speed.compile=true"
    return "a smaller model, data.height or data.width: the networks set the pace"
