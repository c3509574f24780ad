"""Lightning's loop over the steps of an epoch, except that every training ends with a validation of its weights."""

from __future__ import annotations

import math
from typing import Any

from lightning import Trainer
from lightning.pytorch.loops.training_epoch_loop import _TrainingEpochLoop


class EpochLoop(_TrainingEpochLoop):
    """Also validates after the last step of a training, wherever that falls in an epoch.

    Lightning leaves that out if ``max_steps`` ends the training, or if ``check_val_every_n_epoch`` or
    ``val_check_interval`` do not divide its length. The last row and ``best.ckpt`` would then be of older weights than
    ``last.ckpt``.
    """

    @classmethod
    def install(cls, trainer: Trainer) -> Trainer:
        """Replace the trainer's own loop with this one, and return the trainer."""
        own = trainer.fit_loop.epoch_loop
        trainer.fit_loop.epoch_loop = cls(trainer, own.min_steps, own.max_steps)
        return trainer

    def _should_check_val_fx(self, data_fetcher: Any) -> bool:
        due: bool = super()._should_check_val_fx(data_fetcher)
        return due or (self.trainer.enable_validation and self._ends())

    def _ends(self) -> bool:
        """Return whether no step follows the one just done."""
        trainer, epochs = self.trainer, self.trainer.fit_loop
        if 0 <= self.max_steps <= self.global_step or (trainer.should_stop and epochs._can_stop_early):
            return True
        done = epochs.epoch_progress.current.processed + 1
        return self._num_ready_batches_reached() and 0 < (trainer.max_epochs or 0) <= done


def total_steps(trainer: Trainer, data: Any) -> int:
    """Return the optimizer steps of a whole training on a data module.

    The trainer could count them too, but sets up its loader for that. A resumed run does not yet know its position in
    the epoch then, and would begin the epoch again.
    """
    overfit = float(getattr(trainer, "overfit_batches", 0.0)) > 0
    if data is None or overfit or trainer.max_epochs in (None, -1):
        return int(trainer.estimated_stepping_batches)
    batches, limit = len(data.train_dataloader()), trainer.limit_train_batches
    batches = min(batches, limit) if isinstance(limit, int) else int(batches * limit)
    steps = math.ceil(batches / trainer.accumulate_grad_batches) * int(trainer.max_epochs or 0)
    return min(steps, trainer.max_steps) if trainer.max_steps != -1 else steps
