"""Training callbacks: checkpoints, the progress bar, a picture every epoch."""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Sequence
from datetime import timedelta
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import UInt8
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint, TQDMProgressBar
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.plugins.io import TorchCheckpointIO
from lightning.pytorch.utilities import rank_zero_info
from rich.console import Console
from torch import Tensor

from saunet.errors import CheckpointError, ConfigError, positive
from saunet.io.atomic import replacing
from saunet.io.colormaps import colorize
from saunet.io.images import write_image
from saunet.io.progress import watched
from saunet.metrics.functional import RISING
from saunet.prediction.panel import panel
from saunet.runs.checkpoint import atomic_save
from saunet.training.health import DOUBTED, FEW, doubt
from saunet.training.module import EPOCH_LOSS
from saunet.types import DepthPyramid, EvalBatch, LossTerms, TrainBatch, View

_IN_DOUBT = " in doubt"
EVERY = 10.0
"""Seconds between two progress lines if the output is not a terminal."""


class AtomicCheckpointIO(TorchCheckpointIO):
    """Lightning's own storage, except that every local file is written completely or keeps its former content.

    Lightning's writer silently ignores a denied permission, so a run could end without a checkpoint. Addresses such as
    ``s3://...`` are left to Lightning.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any | None = None) -> None:
        if storage_options is not None:
            raise ConfigError(f"storage_options is {storage_options!r}; checkpoints take none, so leave it out")
        if "://" in str(path):
            super().save_checkpoint(checkpoint, path)
        else:
            atomic_save(checkpoint, path)


class LastCheckpoint(ModelCheckpoint):
    """``last.ckpt``, saved after every epoch and every given number of steps, to resume from.

    Args:
        folder: Where it is saved.
        every_n_steps: Also save after this many optimizer steps; 0 for never.
    """

    def __init__(self, folder: str, every_n_steps: int = 1000) -> None:
        super().__init__(folder, "last", enable_version_counter=False)
        self.every_n_steps = int(positive("every_n_steps", every_n_steps, allow_zero=True))
        self._saved_at = 0

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore nothing: a recorded path would be removed after the next save, and a foreign file may name any."""

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Save when due, right after an optimizer step."""
        step = trainer.global_step
        if (batch_idx + 1) % trainer.accumulate_grad_batches and not trainer.is_last_batch:
            return  # a partly accumulated gradient is not in a checkpoint
        if self.every_n_steps and step % self.every_n_steps == 0 and step != self._saved_at:
            self._saved_at = step
            trainer.save_checkpoint(Path(str(self.dirpath)) / "last.ckpt", weights_only=False)


class BestCheckpoint(ModelCheckpoint):
    """``best.ckpt``: the checkpoint with the best monitored value, the smallest except for ``val/a1``, ``a2``, ``a3``.

    Args:
        folder: Where it is saved.
        monitor: The metric that decides. If it is not measured (no validation frame has ground truth), ``val/loss``
            decides; without validation, the epoch's mean ``train/loss``. A checkpoint whose loss says little (see
            `saunet.training.health.doubt`) is kept only until there is another.
    """

    def __init__(self, folder: str, monitor: str = "val/abs_rel") -> None:
        super().__init__(folder, "best", monitor, mode=_direction(monitor), enable_version_counter=False)
        self.wanted = monitor
        self._scored_by, self._said, self._doubted = monitor, False, False
        self._beside: Path | None = None

    @property
    def cost(self) -> float | None:
        """The best monitored value as a cost for searches: negated if larger is better, infinite if in doubt."""
        if self.best_model_score is None:
            return None
        if self._scored_by.endswith(_IN_DOUBT):
            return math.inf
        return -float(self.best_model_score) if self.mode == "max" else float(self.best_model_score)

    @property
    def state_key(self) -> str:
        """Name in the checkpoint; without the monitor, because that may have been replaced."""
        return "BestCheckpoint"

    def on_load_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Remember the resumed checkpoint's folder: its best checkpoint lies beside it."""
        self._beside = Path(str(trainer.ckpt_path)).parent if trainer.ckpt_path else None

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Copy the resumed run's best checkpoint and its value into this run.

        The recorded path is not followed: the folder may have been moved, and a foreign file may name any path.
        """
        own = Path(str(self.dirpath)) / "best.ckpt"
        best = self._beside / own.name if self._beside else own
        if state_dict["best_model_path"] and best.is_file() and best.resolve() != own.resolve():
            with replacing(own, CheckpointError) as temporary:
                shutil.copyfile(best, temporary)
        path, score = (str(own), state_dict["best_model_score"]) if own.is_file() else ("", None)
        known = {} if score is None else {path: score}
        own_state = {"dirpath": str(self.dirpath), "best_model_path": path, "best_model_score": score}
        own_state |= {"best_k_models": known, "kth_best_model_path": path if known else ""}
        super().load_state_dict({**state_dict, **own_state})
        self._scored_by = state_dict.get("scored_by", state_dict["monitor"])

    def state_dict(self) -> dict[str, Any]:
        return {**super().state_dict(), "scored_by": self._scored_by}

    def _save_topk_checkpoint(self, trainer: Trainer, monitor_candidates: dict[str, Tensor]) -> None:
        """Choose what to monitor, then save."""
        wanted = EPOCH_LOSS if self.wanted == "train/loss" else self.wanted
        ranked = [wanted, "val/loss", EPOCH_LOSS]
        measured = [name for name in ranked if name in monitor_candidates]
        before = self._scored_by.removesuffix(_IN_DOUBT)
        if self.best_model_path and before in ranked and ranked.index(before) < ranked.index((measured or ranked)[0]):
            return  # a run resumed for its last steps measures less than the best so far was chosen by
        self.monitor = measured[0] if measured else wanted
        self.mode = _direction(self.monitor)
        if self.monitor != wanted and not self._said:
            self._said = True
            named = "the epoch's mean train/loss" if self.monitor == EPOCH_LOSS else self.monitor
            rank_zero_info(f"{self.wanted} is not measured in this run; best.ckpt is chosen by {named}")
        why = self._doubt(trainer, monitor_candidates)
        if why and not self._doubted:
            self._doubted = True
            rank_zero_info(
                f"step {trainer.global_step}: the loss says little about this checkpoint: {why}; best.ckpt keeps it "
                "only until there is another"
            )
        if why and self.best_model_path and self._scored_by == self.monitor:
            return
        kind = f"{self.monitor}{_IN_DOUBT if why else ''}"
        if kind != self._scored_by:  # the recorded best belongs to another metric
            self._scored_by = kind
            self.best_k_models, self.kth_best_model_path, self.best_model_score = {}, "", None
        super()._save_topk_checkpoint(trainer, monitor_candidates)

    def _doubt(self, trainer: Trainer, measured: dict[str, Tensor]) -> str | None:
        """Return why the deciding loss says little; None if it can be trusted, or another metric decides."""
        if self.monitor not in ("val/loss", EPOCH_LOSS) or trainer.global_step < FEW:
            return None
        place = "val" if self.monitor == "val/loss" else "health"
        return doubt({name: float(measured[f"{place}/{name}"]) for name in DOUBTED if f"{place}/{name}" in measured})


def _direction(monitor: str) -> Literal["min", "max"]:
    return "max" if monitor.removeprefix("val/") in RISING else "min"


class PicturePanel(Callback):
    """Write input, disparity, warped view and auto-mask of one validation batch after every validation.

    Args:
        folder: Where the PNG files are saved.
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
        """Draw the batch with the current networks."""
        batch, self._batch = self._batch, None
        if batch is None or trainer.sanity_checking:
            return
        with torch.no_grad():
            pyramid, _, views, terms = pl_module.step(batch)  # type: ignore[operator]
        picture = _drawn(batch, pyramid, views, terms, self.rows)
        self.folder.mkdir(parents=True, exist_ok=True)
        write_image(self.folder / f"epoch_{trainer.current_epoch:03d}.png", picture)
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                logger.experiment.add_image("panel", picture, trainer.global_step, dataformats="HWC")


def _drawn(
    batch: TrainBatch, pyramid: DepthPyramid, views: Sequence[View], terms: LossTerms, rows: int
) -> UInt8[np.ndarray, "h w 3"]:
    """Draw the first samples of a batch, one per row; loss maps are gray, and white is 1 or the largest value."""

    def array(values: Tensor) -> Any:
        return values.detach().float().cpu().numpy()

    def rgb(image: Tensor) -> UInt8[np.ndarray, "h w 3"]:
        return np.asarray((array(image).transpose(1, 2, 0).clip(0, 1) * 255).round(), dtype=np.uint8)

    tiles: dict[str, UInt8[np.ndarray, "_ _ 3"]] = {}
    count = min(rows, len(batch["name"]))
    for row in range(count):
        tag = f" {row + 1}" if count > 1 else ""
        tiles[f"input{tag}"] = rgb(batch["target"][row])
        tiles[f"disparity{tag}"] = colorize(array(pyramid.disparity[0][row, 0]))
        tiles[f"warped neighbor{tag}"] = rgb(views[0].image[row, 0])
        for name, values in terms.maps.items():
            shown = array(values[row, 0])
            top = max(float(shown.max()), 1e-6) if name not in ("automask", "visible") else 1.0
            tiles[f"{name.replace('_', ' ')}{tag}"] = colorize(shown, (0.0, top), "gray")
    return panel(tiles, columns=len(tiles) // count, tile_width=320)


class Progress(TQDMProgressBar):
    """A progress bar with the main numbers, after a line with the networks' sizes, and one line per epoch.

    The bar appears only on a terminal or in a notebook; a file or a pipe gets a line about every ten seconds.

    Args:
        refresh_rate: Steps between updates of the bar.
    """

    def __init__(self, refresh_rate: int = 5) -> None:
        super().__init__(refresh_rate=refresh_rate)
        self._lines, self._began, self._said, self._first = False, 0.0, 0.0, 0

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        super().setup(trainer, pl_module, stage)
        self._lines = not watched(Console())  # standard output, as Lightning's bar
        if self._lines:
            self.disable()

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Print how many parameters are trained."""
        counts = {
            name: sum(parameter.numel() for parameter in module.parameters()) / 1e6
            for name, module in pl_module.named_children()
        }
        parts = ", ".join(f"{name} {count:.1f} M" for name, count in counts.items() if count and name != "intrinsics")
        rank_zero_info(f"networks: {parts}; {sum(counts.values()):.1f} M parameters in total")

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        super().on_train_start(trainer, pl_module)
        self._began = self._said = time.monotonic()
        self._first = trainer.fit_loop.total_batch_idx + 1

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        super().on_train_batch_end(trainer, pl_module, outputs, batch, batch_idx)
        stops = trainer.should_stop and trainer.fit_loop._can_stop_early
        last = stops or trainer.is_last_batch or 0 <= trainer.max_steps <= trainer.global_step
        # The last step of an epoch has its line afterwards, with the new validation.
        if self._lines and not last and time.monotonic() - self._said >= EVERY:
            rank_zero_info(self._line(trainer))

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        super().on_train_epoch_end(trainer, pl_module)
        rank_zero_info(self._line(trainer))

    def _line(self, trainer: Trainer) -> str:
        self._said = time.monotonic()
        done, epochs = trainer.fit_loop.total_batch_idx + 1, trainer.max_epochs
        parts = [f"epoch {trainer.current_epoch + 1}{f'/{epochs}' if epochs and epochs > 0 else ''}"]
        parts.append(f"step {trainer.global_step}")
        for name, shown in (("train/loss", "loss"), ("val/loss", "val/loss"), ("val/abs_rel", "val/abs_rel")):
            if name in trainer.callback_metrics:
                parts.append(f"{shown} {float(trainer.callback_metrics[name]):.4f}")
        ends = [trainer.num_training_batches * epochs] if epochs and epochs > 0 else []
        ends += [trainer.max_steps * trainer.accumulate_grad_batches] if trainer.max_steps > 0 else []
        if ends and done > self._first:
            each = (self._said - self._began) / (done - self._first)
            parts.append(f"time left {timedelta(seconds=round(each * max(min(ends) - done, 0)))}")
        return ", ".join(parts)

    def get_metrics(self, trainer: Trainer, pl_module: LightningModule) -> dict[str, Any]:
        """Return the bar's metrics, without the logger's version number."""
        metrics = super().get_metrics(trainer, pl_module)
        return {name: value for name, value in metrics.items() if name != "v_num"}
