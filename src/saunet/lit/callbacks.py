"""What watches a training: stop on a non-finite loss, and a picture of what the network sees and does every epoch."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor

from saunet.checks import SaunetError
from saunet.infer.images import write_image
from saunet.lit.pictures import training_panel
from saunet.types import EvalBatch


class StopOnNonFinite(Callback):
    """End the run with one sentence when the loss is NaN or infinite, instead of training on garbage for hours.

    The flag stays on the device and is read only now and then, so the step never waits for it.

    Args:
        every_n_steps: How often the flag is read.
    """

    def __init__(self, every_n_steps: int = 10) -> None:
        self.every_n_steps = every_n_steps
        self._bad: Tensor | None = None

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Remember whether any loss since the last look was not finite."""
        loss = outputs["loss"] if isinstance(outputs, Mapping) else outputs
        bad = ~torch.isfinite(loss.detach())
        self._bad = bad if self._bad is None else self._bad | bad
        if trainer.global_step % self.every_n_steps == 0 and bool(self._bad):
            raise SaunetError(
                f"the loss became NaN or infinite at or before step {trainer.global_step} "
                f"(last batch: {', '.join(batch['name'][:4])}); lower optim.lr, or train with trainer.precision=32"
            )


class PicturePanel(Callback):
    """Write input, disparity, warped view and auto-mask of one validation batch after every validation.

    Args:
        folder: Where the PNG files go.
        rows: How many samples to show.
    """

    def __init__(self, folder: str, rows: int = 2) -> None:
        self.folder, self.rows = Path(folder), rows
        self._batch: EvalBatch | None = None

    def on_validation_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: EvalBatch, batch_idx: int, dataloader_idx: int = 0
    ) -> None:
        """Keep the first batch that has source images."""
        if self._batch is None and trainer.is_global_zero and batch["sources"].shape[1] > 0:
            self._batch = batch

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw the batch with the networks as they are now."""
        batch, self._batch = self._batch, None
        if batch is None or trainer.sanity_checking:
            return
        with torch.no_grad():
            pyramid, views, terms = pl_module.step(batch)  # type: ignore[operator]
        panel = training_panel(batch, pyramid, views, terms, rows=self.rows)
        self.folder.mkdir(parents=True, exist_ok=True)
        write_image(self.folder / f"epoch_{trainer.current_epoch:03d}.png", panel)
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                logger.experiment.add_image("panel", panel, trainer.global_step, dataformats="HWC")
