"""What limits the speed of a training: threads, waiting for the loader, and the first setting to change."""

from __future__ import annotations

import contextlib
import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.utilities import move_data_to_device, rank_zero_info

from saunet.data.loading.module import DepthDataModule
from saunet.data.loading.sampling import evenly, share
from saunet.data.loading.windows import Item, collate
from saunet.errors import DataError, in_range, positive
from saunet.threads import SETTINGS, Usage, available_cores, free

_ENOUGH = 20
"""A training reports what limited its speed from this many steps on."""
_LOOK = 0.5
"""Seconds over which the use of the cores is measured before the first step."""
_SAMPLES = 3
_AUGMENT = 0.2
"""Augmentation is mentioned from this fraction of a step on."""


@dataclass(frozen=True, slots=True)
class Pace:
    """Where the time of a training step went, in seconds."""

    step: float
    waiting: float
    """Waiting for the loader."""
    augment: float
    """Device transforms."""
    decode: float
    """Reading a sample's frames, in one process."""
    rest: float
    """Making the rest of a sample: resizing, ground truth."""

    def __str__(self) -> str:
        loader, augment = self.waiting / self.step, self.augment / self.step
        shares = f"{max(0.0, 1 - loader - augment):.0%} networks and losses, {augment:.0%} augmentation, {loader:.0%}"
        sample = f"a sample takes {_ms(self.decode)} to read and {_ms(self.rest)} to resize"
        return f"a step took {_ms(self.step)}: {shares} waiting for the loader, where {sample}"


def _ms(seconds: float) -> str:
    return f"{1000 * seconds:{'.0f' if seconds >= 0.1 else '.3g'}} ms"


def measure(step: float, waiting: float, data: DepthDataModule, batch_size: int, device: torch.device) -> Pace:
    """Split a step's seconds into its parts, by making some samples again in this process.

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
    """Return the setting that gains most; waiting for the loader counts only above a fraction of the time."""
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


@dataclass(frozen=True, slots=True)
class Loading:
    """How fast images arrived and how fast they could have been used, over some steps of one process."""

    images: int
    seconds: float
    waited: float

    def __add__(self, other: Loading) -> Loading:
        return Loading(self.images + other.images, self.seconds + other.seconds, self.waited + other.waited)

    @property
    def share(self) -> float:
        """Fraction of the time that was spent waiting for the loader."""
        return self.waited / self.seconds if self.seconds > 0 else 0.0

    @property
    def reached(self) -> float:
        """Images per second that arrived."""
        return self.images / self.seconds if self.seconds > 0 else 0.0

    @property
    def needed(self) -> float:
        """Images per second that the model could use without waiting."""
        return self.images / max(self.seconds - self.waited, 1e-9)


class LoaderMonitor(Callback):
    """Log the loader's images per second and waiting time, and report once when it is the bottleneck.

    At the end it reports where a step's time went and what to change first.
    The first step of an epoch is left out, because worker processes start and validation runs before it. Loading while
    the device is busy costs nothing and is not counted; only the time that the training step waits is.

    Args:
        every_n_steps: Steps per measurement, across several epochs if these are shorter.
        share: Fraction of the time above which the loader counts as the bottleneck.
    """

    def __init__(self, every_n_steps: int = 50, share: float = 0.1) -> None:
        self.every_n_steps = int(positive("every_n_steps", every_n_steps))
        self.share = in_range("share", share, 0, 1)
        self._since: tuple[float, float] | None = None
        """When the previous step ended, and the waiting time until then; None before the first step of an epoch."""
        self._measured = Loading(0, 0.0, 0.0)
        self._steps = 0
        self._all = Loading(0, 0.0, 0.0)
        self._all_steps = 0
        self._said = False

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Do not measure the pause between epochs; earlier measurements still count."""
        self._since = None

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        waited = getattr(trainer.train_dataloader, "waited", None)
        if waited is None:
            return
        since, self._since = self._since, (time.monotonic(), waited)
        if since is None:
            return
        count, neighbors = batch["sources"].shape[:2]
        latest = Loading(int(count * (1 + neighbors)), self._since[0] - since[0], waited - since[1])
        loading = self._measured = self._measured + latest
        self._all, self._steps, self._all_steps = self._all + latest, self._steps + 1, self._all_steps + 1
        if self._steps < self.every_n_steps:
            return
        self._measured, self._steps = Loading(0, 0.0, 0.0), 0
        figures = {"loader/images_per_second": loading.reached, "loader/share": loading.share}
        pl_module.log_dict(figures, batch_size=1)
        if loading.share > self.share and not self._said:
            self._said = True
            rank_zero_info(sentence(loading, trainer))

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Report what limited the speed, unless there were too few steps to know."""
        data = getattr(trainer, "datamodule", None)
        if self._all_steps < _ENOUGH or not trainer.is_global_zero or not isinstance(data, DepthDataModule):
            return
        step, waiting = (total / self._all_steps for total in (self._all.seconds, self._all.waited))
        with contextlib.suppress(DataError):  # a file that is gone by now must not fail a finished training
            pace = measure(step, waiting, data, share(data.batch_size, trainer.world_size), pl_module.device)
            change = first_change(
                pace,
                share=self.share,
                workers=getattr(trainer.train_dataloader, "num_workers", 0),
                cacheable=data.cacheable and data.copies is None,
                device=pl_module.device.type,
                precision=str(trainer.precision),
                compiled=getattr(pl_module, "compiled", False),
            )
            rank_zero_info(f"{pace}; to make it faster: {change}")


class Threads(Callback):
    """Compute with as many threads as there are free cores, measured before the first step and during training.

    More threads than free cores wait for each other most of the time. If ``OMP_NUM_THREADS`` or ``MKL_NUM_THREADS`` is
    set, it is left alone. There are never more threads than torch had before.

    Args:
        every: Seconds between measurements of the cores' use.
    """

    def __init__(self, every: float = 20.0) -> None:
        self.every = positive("every", every)
        self._before = (0, 0)
        self._since: Usage | None = None

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._before = (torch.get_num_threads(), cv2.getNumThreads())
        self._since = None
        given = next((name for name in SETTINGS if name in os.environ), None)
        if given or trainer.num_devices > 1:  # several processes would measure each other
            rank_zero_info(f"{count(self._before[0])} per process{f', as {given} says' if given else ''}")
            return
        began = Usage.now()
        time.sleep(_LOOK)
        self._since = Usage.now()
        # The load average covers a minute, in which this program may have been busy itself; a single moment may be
        # unlucky.
        taken = min(self._since.taken_since(began), os.getloadavg()[0]) if began and self._since else 0.0
        cores = available_cores()
        self._use(free(cores, taken))
        others = f", of which other programs use {taken:.1f}" if taken >= 0.1 else ""
        said = f"{count(torch.get_num_threads())}: this process may use {cores} cores{others}"
        rank_zero_info(f"{said}; OMP_NUM_THREADS sets another number")

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        since = self._since
        if since is None or time.monotonic() - since.moment < self.every:
            return
        self._since = Usage.now()
        if self._since is not None:
            self._use(free(available_cores(), self._since.taken_since(since)))

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Restore the process's number of threads."""
        if self._before[0]:
            torch.set_num_threads(self._before[0])
            cv2.setNumThreads(self._before[1])

    def _use(self, wanted: int) -> None:
        threads, own = (max(1, min(wanted, most)) for most in self._before)
        if threads != torch.get_num_threads():
            torch.set_num_threads(threads)
        if own != cv2.getNumThreads():
            cv2.setNumThreads(own)


def count(threads: int) -> str:
    return f"computing with {threads} thread{'s' * (threads > 1)}"


def sentence(loading: Loading, trainer: Trainer) -> str:
    """Report that the loader is the bottleneck, with its figures and what to do."""
    workers = getattr(trainer.train_dataloader, "num_workers", 0)
    cores = available_cores()
    each = " on this process" if trainer.world_size > 1 else ""
    data = getattr(trainer, "datamodule", None)
    advice = [f"raise data.workers (now {workers}, there are {cores} cores)"] if workers < cores else []
    if isinstance(data, DepthDataModule) and data.cacheable and data.copies is None:
        advice.append("load smaller copies made once with saunet prepare cache")
    return (
        f"the loader is the bottleneck: {loading.reached:.0f} images/s arrive{each} and the model could use "
        f"{loading.needed:.0f} ({loading.share:.0%} of the time is spent waiting); "
        f"{', or '.join(advice or ['use a faster disk or more cores'])}"
    )
