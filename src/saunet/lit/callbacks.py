"""What accompanies a training: checkpoints, the progress bar, a stop on a non-finite loss, a picture every epoch."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint, TQDMProgressBar
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_info
from torch import Tensor

from saunet.atomic import replacing
from saunet.checks import CheckpointError, SaunetError, positive
from saunet.images import write_image
from saunet.lit.pictures import training_panel
from saunet.types import EvalBatch


class StopOnNonFinite(Callback):
    """End the run with one sentence when the loss is NaN or infinite, instead of training on garbage for hours.

    The flag stays on the device and is read only now and then, so the step never waits for it.

    Args:
        every_n_steps: How often the flag is read.
    """

    def __init__(self, every_n_steps: int = 10) -> None:
        self.every_n_steps = int(positive("every_n_steps", every_n_steps))
        self._bad: Tensor | None = None
        self._names: list[str] = []

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Remember whether any loss since the last look was not finite."""
        loss = outputs["loss"] if isinstance(outputs, Mapping) else outputs
        bad = ~torch.isfinite(loss.detach())
        self._bad = bad if self._bad is None else self._bad | bad
        self._names = batch["name"][:4]
        if trainer.global_step % self.every_n_steps == 0:
            self._look(trainer)

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Look before broken weights are scored and saved."""
        self._look(trainer)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Look before broken weights are saved."""
        self._look(trainer)

    def _look(self, trainer: Trainer) -> None:
        if self._bad is not None and bool(self._bad):
            raise SaunetError(
                f"the loss became NaN or infinite at or before step {trainer.global_step} "
                f"(last batch: {', '.join(self._names)}); lower optim.lr, or train with trainer.precision=32"
            )


class LastCheckpoint(ModelCheckpoint):
    """``last.ckpt``, after every epoch: what to resume from.

    Args:
        folder: Where it goes.
    """

    def __init__(self, folder: str) -> None:
        super().__init__(folder, "last", enable_version_counter=False)


class BestCheckpoint(ModelCheckpoint):
    """``best.ckpt``: the state with the smallest monitored value.

    Args:
        folder: Where it goes.
        monitor: What decides; where it is not measured (no validation frame has ground truth), ``val/loss`` does, and
            without validation ``train/loss``.
    """

    def __init__(self, folder: str, monitor: str = "val/abs_rel") -> None:
        super().__init__(folder, "best", monitor, mode="min", enable_version_counter=False)
        self.wanted = monitor

    @property
    def state_key(self) -> str:
        """Name in the checkpoint; without the monitor, which may have fallen back."""
        return "BestCheckpoint"

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take over the best so far from the run that is resumed, with its file: a new run has its own folder."""
        best, folder = Path(state_dict["best_model_path"]), Path(str(self.dirpath))
        if best.is_file() and best.parent != folder:
            folder.mkdir(parents=True, exist_ok=True)
            with replacing(folder / best.name, CheckpointError) as temporary:
                shutil.copyfile(best, temporary)
            moved = str(folder / best.name)
            state_dict = {
                **state_dict,
                "dirpath": str(folder),
                "best_model_path": moved,
                "kth_best_model_path": moved,
                "best_k_models": {moved: state_dict["best_model_score"]},
            }
        super().load_state_dict(state_dict)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Choose what to monitor, then save."""
        self._choose(trainer)
        super().on_validation_end(trainer, pl_module)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Choose what to monitor, then save."""
        self._choose(trainer)
        super().on_train_epoch_end(trainer, pl_module)

    def _choose(self, trainer: Trainer) -> None:
        measured = [name for name in (self.wanted, "val/loss", "train/loss") if name in trainer.callback_metrics]
        self.monitor = measured[0] if measured else self.wanted


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


class Progress(TQDMProgressBar):
    """One bar with what matters, after one line that says how large the networks are."""

    def __init__(self, refresh_rate: int = 5) -> None:
        super().__init__(refresh_rate=refresh_rate)

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Say how many parameters are trained."""
        counts = {
            name: sum(parameter.numel() for parameter in module.parameters()) / 1e6
            for name, module in pl_module.named_children()
        }
        parts = ", ".join(f"{name} {count:.1f} M" for name, count in counts.items() if count)
        rank_zero_info(f"networks: {parts}; together {sum(counts.values()):.1f} M parameters")

    def get_metrics(self, trainer: Trainer, pl_module: LightningModule) -> dict[str, Any]:
        """Return what the bar shows; the logger's version number is not a metric."""
        metrics = super().get_metrics(trainer, pl_module)
        return {name: value for name, value in metrics.items() if name != "v_num"}
