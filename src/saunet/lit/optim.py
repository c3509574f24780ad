"""How a network is optimised: optimiser, learning rate and schedule as one small recipe."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch.nn import Parameter
from torch.optim.lr_scheduler import LRScheduler

from saunet.checks import ConfigError, one_of, positive


@dataclass(frozen=True)
class Recipe:
    """Optimiser and schedule; the defaults are the paper's (section IV.B).

    Args:
        optimizer: ``adam`` or ``adamw``.
        lr: Learning rate at the start.
        betas: Adam's decay rates.
        weight_decay: Weight decay (decoupled for ``adamw``).
        schedule: ``step``: multiply by ``gamma`` at each milestone; ``cosine``: fall to zero at the end; ``constant``.
        milestones: Where ``step`` falls, as fractions of the training: 0.75 is epoch 60 of 80.
        gamma: Factor at each milestone.
        warmup: Fraction of the training over which the rate rises linearly from zero.

    Raises:
        ConfigError: for a value that makes no sense.
    """

    optimizer: Literal["adam", "adamw"] = "adam"
    lr: float = 1e-4
    betas: Sequence[float] = (0.9, 0.999)
    weight_decay: float = 0.0
    schedule: Literal["step", "cosine", "constant"] = "step"
    milestones: Sequence[float] = (0.75,)
    gamma: float = 0.1
    warmup: float = 0.0

    def __post_init__(self) -> None:
        one_of("optim.optimizer", self.optimizer, ("adam", "adamw"))
        one_of("optim.schedule", self.schedule, ("step", "cosine", "constant"))
        positive("optim.lr", self.lr)
        positive("optim.gamma", self.gamma)
        positive("optim.weight_decay", self.weight_decay, allow_zero=True)
        if len(self.betas) != 2 or not all(0 <= beta < 1 for beta in self.betas):
            raise ConfigError(
                f"optim.betas is {list(self.betas)}; two numbers in [0, 1) are needed, such as [0.9, 0.999]"
            )
        if not all(0 < milestone < 1 for milestone in self.milestones):
            raise ConfigError(
                f"optim.milestones is {list(self.milestones)}; they are fractions of the training between 0 and 1, "
                "such as 0.75 for epoch 60 of 80"
            )
        if not 0 <= self.warmup < 1:
            raise ConfigError(
                f"optim.warmup is {self.warmup}; it is a fraction of the training, at least 0 and below 1"
            )

    def factor(self, progress: float) -> float:
        """Return the learning rate relative to ``lr`` when a fraction ``progress`` (0 to 1) of the training is done."""
        if progress < self.warmup:
            return progress / self.warmup
        if self.schedule == "step":
            return float(self.gamma ** sum(progress >= milestone for milestone in self.milestones))
        if self.schedule == "cosine":
            done = (progress - self.warmup) / (1 - self.warmup)
            return 0.5 * (1 + torch.cos(torch.tensor(torch.pi * min(done, 1.0))).item())
        return 1.0

    def configure(self, parameters: Iterable[Parameter], total_steps: int) -> dict[str, Any]:
        """Return optimiser and per-step scheduler in the form that Lightning expects.

        Args:
            parameters: What is optimised.
            total_steps: Optimiser steps in the whole training.
        """
        kind = torch.optim.AdamW if self.optimizer == "adamw" else torch.optim.Adam
        optimizer = kind(
            list(parameters), lr=self.lr, betas=(self.betas[0], self.betas[1]), weight_decay=self.weight_decay
        )
        scheduler = RecipeSchedule(optimizer, self, max(total_steps, 1))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}


class RecipeSchedule(LRScheduler):
    """A recipe's learning rate, step by step; its saved state is plain numbers, so checkpoints stay safe to read.

    Args:
        optimizer: Whose rates it sets.
        recipe: The rates.
        total_steps: Steps in the whole training.
    """

    def __init__(self, optimizer: torch.optim.Optimizer, recipe: Recipe, total_steps: int) -> None:
        self.recipe, self.total_steps = recipe, total_steps
        super().__init__(optimizer)

    def get_lr(self) -> list[float]:  # type: ignore[override]
        """Return the rate of each parameter group at the present step."""
        # The first step of a warm-up must not be lost to a rate of exactly zero.
        ahead = 1 if self.recipe.warmup else 0
        factor = self.recipe.factor(min((self.last_epoch + ahead) / self.total_steps, 1.0))
        return [float(rate) * factor for rate in self.base_lrs]

    def state_dict(self) -> dict[str, Any]:
        """Return the position in the schedule; what the schedule is comes from the config."""
        return {key: value for key, value in super().state_dict().items() if key not in ("recipe", "total_steps")}
