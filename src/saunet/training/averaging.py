"""A moving average of the weights: smoother than any single step's, so it is what is validated and saved."""

from __future__ import annotations

from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import WeightAveraging
from torch import Tensor


class MovingAverage(WeightAveraging):
    """Exponential moving average of a model's parameters and buffers, kept by Lightning.

    The first steps weigh more than ``decay`` says, so that the fresh weights are soon forgotten: after n steps the
    decay is at most (1 + n) / (10 + n). What is no floating-point number (a counter) is copied. A checkpoint holds the
    average as ``state_dict`` and the weights that are trained as ``current_model_state``.

    Args:
        decay: Weight of the average so far, 0 to 1.
    """

    def __init__(self, decay: float) -> None:
        super().__init__(multi_avg_fn=self._update)
        self.decay = decay

    @property
    def values(self) -> dict[str, Tensor]:
        """The average, by name."""
        assert self._average_model is not None
        return dict(self._average_model.module.state_dict())

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Begin at the fresh weights."""
        self._device = trainer.strategy.root_device  # where the model will be, but is not yet
        super().setup(trainer, pl_module, stage)
        if self._average_model is not None:
            # At 0, the first step would be copied instead of averaged; on the CPU, reading it waits for no device.
            self._average_model.n_averaged = torch.ones((), dtype=torch.long)

    def update(self, model: LightningModule) -> None:
        """Move the average towards the weights, after a step."""
        assert self._average_model is not None
        self._average_model.update_parameters(model)

    def on_train_batch_end(self, *_: Any) -> None:
        """Do nothing: callbacks that came before this one would have saved an average without the last step."""

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Leave the module its own weights; whoever wants the average loads a checkpoint."""

    def _update(self, averages: Any, weights: Any, _: Any) -> None:
        assert self._average_model is not None
        steps = int(self._average_model.n_averaged) - 1
        if averages[0].is_floating_point():  # all are of one type
            torch._foreach_lerp_(averages, weights, 1 - min(self.decay, (1 + steps) / (10 + steps)))
        else:
            torch._foreach_copy_(averages, weights)
