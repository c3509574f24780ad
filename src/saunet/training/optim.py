"""How a network is optimized: optimizer, learning rates, schedule, averaging and freezing as one small recipe."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import torch
from torch import nn
from torch.nn import Parameter
from torch.optim.lr_scheduler import LRScheduler

from saunet.errors import ConfigError, in_range, one_of, positive, suggest

SCHEDULES = ("step", "cosine", "one_cycle", "constant")
OPTIMIZER_STATE = ("lr", "encoder_lr", "betas", "weight_decay", "fused")
"""Settings that live on in a checkpoint's optimizer state: a resumed run goes on with the checkpoint's."""


@dataclass(frozen=True)
class Recipe:
    """Optimizer and schedule; the defaults are the paper's (section IV.B).

    Args:
        optimizer: ``adam`` or ``adamw``.
        lr: Learning rate at the start; the highest one with ``one_cycle``.
        betas: Adam's decay rates.
        weight_decay: Weight decay (decoupled for ``adamw``).
        schedule: ``step``: multiply by ``gamma`` at each milestone; ``cosine``: fall to zero at the end; ``one_cycle``:
            rise from 1/25 of ``lr`` over ``warmup`` and fall to 1/10000 of that, both along a cosine; ``constant``.
        milestones: Where ``step`` falls, as fractions of the training: 0.75 is epoch 60 of 80.
        gamma: Factor at each milestone.
        warmup: Fraction of the training over which the rate rises, linearly from zero but for ``one_cycle``.
        encoder_lr: Learning rate of the depth encoder, which often starts from public weights; ``lr`` if None.
        freeze: Parts that are not trained, by name: ``depth.encoder``, ``pose``, ``depth.encoder.stages.0``. Their
            normalization statistics stay too.
        ema: Decay of the moving average of the weights, such as 0.999; the average is what is validated and saved. 0
            keeps none.
        fused: One kernel for the whole optimizer step.

    Raises:
        ConfigError: for a value that makes no sense.
    """

    optimizer: Literal["adam", "adamw"] = "adam"
    lr: float = 1e-4
    betas: Sequence[float] = (0.9, 0.999)
    weight_decay: float = 0.0
    schedule: Literal["step", "cosine", "one_cycle", "constant"] = "step"
    milestones: Sequence[float] = (0.75,)
    gamma: float = 0.1
    warmup: float = 0.0
    encoder_lr: float | None = None
    freeze: Sequence[str] = ()
    ema: float = 0.0
    fused: bool = False

    def __post_init__(self) -> None:
        one_of("optim.optimizer", self.optimizer, ("adam", "adamw"))
        one_of("optim.schedule", self.schedule, SCHEDULES)
        positive("optim.lr", self.lr)
        positive("optim.gamma", self.gamma)
        positive("optim.weight_decay", self.weight_decay, allow_zero=True)
        if self.encoder_lr is not None:
            positive("optim.encoder_lr", self.encoder_lr)
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
        if self.schedule == "one_cycle" and self.warmup == 0:
            raise ConfigError("optim.schedule=one_cycle rises over optim.warmup, which is 0; set it, such as 0.3")
        if in_range("optim.ema", self.ema, 0, 1) == 1:
            raise ConfigError("optim.ema is 1, so the average would never move; use a number below, such as 0.999")

    def factor(self, progress: float) -> float:
        """Return the learning rate relative to ``lr`` when a fraction ``progress`` (0 to 1) of the training is done."""
        if self.schedule == "one_cycle":
            low, end = 1 / 25, 1 / 25e4
            if progress < self.warmup:
                return low + (1 - low) * (0.5 - 0.5 * math.cos(math.pi * progress / self.warmup))
            done = (progress - self.warmup) / (1 - self.warmup)
            return end + (1 - end) * (0.5 + 0.5 * math.cos(math.pi * min(done, 1.0)))
        if progress < self.warmup:
            return progress / self.warmup
        if self.schedule == "step":
            return float(self.gamma ** sum(progress >= milestone for milestone in self.milestones))
        if self.schedule == "cosine":
            done = (progress - self.warmup) / (1 - self.warmup)
            return 0.5 + 0.5 * math.cos(math.pi * min(done, 1.0))
        return 1.0

    def frozen(self, model: nn.Module) -> list[nn.Module]:
        """Return the parts of a model that are not trained.

        Raises:
            ConfigError: if a name in ``freeze`` is no part of the model.
        """
        parts = dict(model.named_modules())
        for name in self.freeze:
            allowed = [part for part in parts if part.startswith(("depth", "pose"))]
            if name not in allowed:
                upper = ", ".join(part for part in allowed if part.count(".") < 2)
                hint = suggest(name, allowed) or ","
                raise ConfigError(f"optim.freeze is '{name}'{hint} allowed: {upper}, and parts of these by their names")
        return [parts[name] for name in self.freeze]

    def groups(self, model: nn.Module) -> list[dict[str, Any]]:
        """Return the trainable parameters of a model, the depth encoder's apart where it has a rate of its own.

        Raises:
            ConfigError: if nothing is left to train.
        """
        trainable = [(name, parameter) for name, parameter in model.named_parameters() if parameter.requires_grad]
        if not trainable:
            raise ConfigError(f"optim.freeze is {list(self.freeze)}, which leaves nothing to train; leave a part out")
        if self.encoder_lr is None:
            return [{"params": [parameter for _, parameter in trainable]}]
        encoder = [parameter for name, parameter in trainable if name.startswith("depth.encoder.")]
        rest = [parameter for name, parameter in trainable if not name.startswith("depth.encoder.")]
        groups: list[dict[str, Any]] = [{"params": rest}, {"params": encoder, "lr": self.encoder_lr}]
        return [group for group in groups if group["params"]]

    def configure(self, parameters: Iterable[Parameter] | Sequence[dict[str, Any]], total_steps: int) -> dict[str, Any]:
        """Return optimizer and per-step scheduler in the form that Lightning expects.

        Args:
            parameters: What is optimized, or groups of it.
            total_steps: Optimizer steps in the whole training.
        """
        groups: list[Any] = list(parameters)
        kind = torch.optim.AdamW if self.optimizer == "adamw" else torch.optim.Adam
        optimizer = kind(
            groups,
            lr=self.lr,
            betas=(self.betas[0], self.betas[1]),
            weight_decay=self.weight_decay,
            fused=self.fused or None,
        )
        scheduler = RecipeSchedule(optimizer, self, max(total_steps, 1))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def to_plain(self) -> dict[str, Any]:
        """Return the settings as plain containers, for a checkpoint."""
        return {key: list(value) if isinstance(value, tuple | list) else value for key, value in asdict(self).items()}

    def resumed_from(self, before: Mapping[str, Any]) -> str | None:
        """Say what becomes of settings that differ from those of the checkpoint that is resumed.

        Args:
            before: The settings in the checkpoint.

        Returns:
            One sentence; None if nothing differs.

        Raises:
            ConfigError: if the checkpoint cannot be continued with these settings.
        """
        now = self.to_plain()
        changed = [key for key in now if key in before and before[key] != now[key]]
        if any(key in changed for key in ("optimizer", "freeze")) or (
            (before.get("encoder_lr") is None) != (self.encoder_lr is None)
        ):
            key = next(key for key in ("optimizer", "freeze", "encoder_lr") if key in changed)
            raise ConfigError(
                f"optim.{key} is {now[key]} and the checkpoint was trained with {before[key]}, so its optimizer state "
                "does not fit; keep the setting, or start a new training from its weights with init_from= instead of "
                "resume="
            )
        kept = [f"optim.{key} {before[key]} (not {now[key]})" for key in changed if key in OPTIMIZER_STATE]
        taken = [f"optim.{key} {now[key]} (it was {before[key]})" for key in changed if key not in OPTIMIZER_STATE]
        if not changed:
            return None
        parts = [f"keeps the checkpoint's {', '.join(kept)}"] * bool(kept)
        parts += [f"uses the new {', '.join(taken)}"] * bool(taken)
        return (
            f"the resumed run {' and '.join(parts)}; "
            "to train on with other settings, start from its weights with init_from= instead of resume="
        )


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
