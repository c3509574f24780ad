"""What any training needs beside its step: seeds, optimizer, averaged and frozen weights, what a checkpoint holds."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from lightning import Callback, LightningModule
from lightning.pytorch.trainer.states import TrainerFn
from lightning.pytorch.utilities import rank_zero_info

from saunet.runs.folder import RunRecord
from saunet.training.averaging import MovingAverage
from saunet.training.optim import Recipe
from saunet.training.resume import continuation, settings
from saunet.training.speed import Speed


class TrainedModule(LightningModule):
    """A module trained by a `Recipe`, that resumes after an interruption as if there had been none.

    Args:
        recipe: Optimizer and schedule.
        speed: Speed switches.
        seed: With step and process, all that dropped paths and tie-break noise depend on.
        record: Plain data stored in every checkpoint under ``"saunet"``; `saunet.load` rebuilds the networks from it.
    """

    def __init__(
        self,
        recipe: Recipe | None = None,
        speed: Speed | None = None,
        seed: int = 0,
        record: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.recipe = recipe if recipe is not None else Recipe()
        self.speed = speed if speed is not None else Speed()
        self.seed = seed
        self.record = dict(record or {})
        self.objective_node: Mapping[str, Any] | None = None
        """Config node of the objective, where it is known; kept in checkpoints."""
        self.run_record: RunRecord | None = None
        """The run's ``run.json``, where there is one."""
        self.average = MovingAverage(self.recipe.ema) if self.recipe.ema > 0 else None
        self._prepared = False

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "average": None}  # which holds a copy of this module

    def configure_callbacks(self) -> list[Callback]:
        """Let Lightning keep the average, and put it in while validating."""
        return [self.average] if self.average is not None else []

    def setup(self, stage: str) -> None:
        """Freeze and switch on what the config asks for, once, in the process that trains."""
        if self._prepared:
            return
        self._prepared = True
        for part in self.recipe.frozen(self):
            part.requires_grad_(False).eval()
            warnings.filterwarnings("ignore", message=r"Found \d+ module\(s\) in eval mode")  # as it is meant to be
        # A convolution of 1x1 has several right strides, and DDP copies a gradient that comes in another one.
        warnings.filterwarnings("ignore", message=r"Grad strides do not match bucket view strides")
        self.speed.apply(self)

    def train(self, mode: bool = True) -> TrainedModule:
        """Change between training and evaluation; frozen parts stay in evaluation."""
        super().train(mode)
        for part in self.recipe.frozen(self) if mode and self._prepared else ():
            part.eval()
        return self

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        """Make the step's randomness a function of seed, step and process: a resumed run draws what it would have."""
        micro = batch_idx % self.trainer.accumulate_grad_batches  # else accumulated batches would all draw the same
        position = [self.seed, self.global_step, self.global_rank, micro]
        torch.manual_seed(int(np.random.SeedSequence(position).generate_state(1)[0]))

    def optimizer_step(
        self,
        epoch: int,
        batch_idx: int,
        optimizer: Any,
        optimizer_closure: Callable[[], Any] | None = None,
    ) -> None:
        """Take one step, then move the average."""
        super().optimizer_step(epoch, batch_idx, optimizer, optimizer_closure)
        if self.average is not None:
            self.average.update(self)

    def configure_optimizers(self) -> Any:
        """Return the recipe's optimizer over all that is trained, and its schedule."""
        return self.recipe.configure(self.recipe.groups(self), self._total_steps())

    def _total_steps(self) -> int:
        """Return the optimizer steps of the whole training.

        The trainer could count them too, but sets up its loader for that: before a resumed run knows where in an epoch
        it was, so that it would begin the epoch again.
        """
        trainer = self.trainer
        data = getattr(trainer, "datamodule", None)
        if data is None or float(getattr(trainer, "overfit_batches", 0.0)) > 0 or trainer.max_epochs in (None, -1):
            return int(trainer.estimated_stepping_batches)
        batches, limit = len(data.train_dataloader()), trainer.limit_train_batches
        batches = min(batches, limit) if isinstance(limit, int) else int(batches * limit)
        steps = math.ceil(batches / trainer.accumulate_grad_batches) * int(trainer.max_epochs or 0)
        return min(steps, trainer.max_steps) if trainer.max_steps != -1 else steps

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Store the record from which the networks are rebuilt, and what a resumed training must share."""
        checkpoint["saunet"] = self.record
        checkpoint["saunet_training"] = self.training_state(getattr(self._trainer, "datamodule", None))

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Check that the training continues, and say what becomes of a changed recipe, network or objective."""
        if self._trainer is None or self.trainer.state.fn != TrainerFn.FITTING:
            return
        now = self.training_state(getattr(self.trainer, "datamodule", None))
        for sentence in continuation(checkpoint, self.recipe, self.record, now["settings"]):
            rank_zero_info(sentence)
        if self.average is None and "current_model_state" in checkpoint:  # it is averaged no longer
            checkpoint["state_dict"] = checkpoint["current_model_state"]

    def training_state(self, data: Any) -> dict[str, Any]:
        """Return what a checkpoint keeps of a training beside its networks."""
        return {"recipe": self.recipe.to_plain(), "settings": settings(self.seed, data, self.objective_node)}
