"""A monitor that says when the loader holds the training back, and by how much."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.utilities import rank_zero_info

from saunet.data.loading.sampling import available_cores
from saunet.errors import in_range, positive


@dataclass(frozen=True, slots=True)
class Loading:
    """How fast images came and how fast they could have been used, over some steps of one process."""

    images: int
    seconds: float
    waited: float

    @property
    def share(self) -> float:
        """Part of the time that was spent waiting for the loader."""
        return self.waited / self.seconds if self.seconds > 0 else 0.0

    @property
    def reached(self) -> float:
        """Images a second that arrived."""
        return self.images / self.seconds if self.seconds > 0 else 0.0

    @property
    def needed(self) -> float:
        """Images a second that the model could use if none were waited for."""
        return self.images / max(self.seconds - self.waited, 1e-9)


class LoaderMonitor(Callback):
    """Log the loader's images a second and its share of the time, and say once when it is the bottleneck.

    The first step of an epoch, before which worker processes start and validation runs, is left out. Time that the
    loader needs beside a busy device costs nothing and is not counted: only what the training step waits for is.

    Args:
        every_n_steps: Steps over which is measured, of several epochs where these are shorter.
        share: Part of the time from where the loader is called a bottleneck.
    """

    def __init__(self, every_n_steps: int = 50, share: float = 0.1) -> None:
        self.every_n_steps = int(positive("every_n_steps", every_n_steps))
        self.share = in_range("share", share, 0, 1)
        self._since: tuple[float, float] | None = None
        """When the step before ended, and what had been waited by then; None before the first step of an epoch."""
        self._measured = Loading(0, 0.0, 0.0)
        self._steps = 0
        self._said = False

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Measure no pause between epochs; what was measured before it counts on."""
        self._since = None

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Count, and report when the window is full."""
        waited = getattr(trainer.train_dataloader, "waited", None)
        if waited is None:
            return
        since, self._since = self._since, (time.monotonic(), waited)
        if since is None:
            return
        before = self._measured
        self._measured = Loading(
            before.images + _images(batch),
            before.seconds + self._since[0] - since[0],
            before.waited + waited - since[1],
        )
        self._steps += 1
        if self._steps < self.every_n_steps:
            return
        loading, self._measured, self._steps = self._measured, Loading(0, 0.0, 0.0), 0
        figures = {"loader/images_per_second": loading.reached, "loader/share": loading.share}
        pl_module.log_dict(figures, batch_size=1)
        if loading.share > self.share and not self._said:
            self._said = True
            rank_zero_info(sentence(loading, trainer))


def sentence(loading: Loading, trainer: Trainer) -> str:
    """Say that the loader is the bottleneck, with its figures and what to do."""
    workers = getattr(trainer.train_dataloader, "num_workers", 0)
    cores = available_cores()
    each = " on this process" if trainer.world_size > 1 else ""
    data = getattr(trainer, "datamodule", None)
    advice = [f"raise data.workers (now {workers}, there are {cores} cores)"] if workers < cores else []
    if getattr(data, "cacheable", False) and data.copies is None:  # type: ignore[union-attr]
        advice.append("load smaller copies made once with saunet prepare cache")
    return (
        f"the loader is the bottleneck: {loading.reached:.0f} images/s arrive{each} and the model could use "
        f"{loading.needed:.0f} ({loading.share:.0%} of the time is spent waiting); "
        f"{', or '.join(advice or ['use a faster disk or more cores'])}"
    )


def _images(batch: Mapping[str, Any]) -> int:
    """Return how many images were read for a batch: targets and sources."""
    sources = batch["sources"]
    return int(sources.shape[0] * (1 + sources.shape[1]))
