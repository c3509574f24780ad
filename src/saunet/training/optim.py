"""The training recipe: optimizer, learning rates, schedule, averaging and freezing."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import WeightAveraging
from torch import Tensor, nn
from torch.nn import Parameter
from torch.nn.modules.batchnorm import _BatchNorm
from torch.optim.lr_scheduler import LRScheduler

from saunet.errors import ConfigError, in_range, one_of, positive, suggest

OPTIMIZER_STATE = ("lr", "encoder_lr", "betas", "weight_decay", "fused")
"""Settings stored in a checkpoint's optimizer state: a resumed run keeps the checkpoint's values."""
OTHER_SETTINGS = "to continue with other settings, start from its weights with init_from= instead of resume="


@dataclass(frozen=True)
class Recipe:
    """Optimizer and schedule; the defaults are the paper's (section IV.B).

    Args:
        optimizer: ``adam`` or ``adamw``.
        lr: Learning rate at the start; the highest one with ``one_cycle``.
        betas: Adam's decay rates (beta1, beta2).
        weight_decay: Weight decay (decoupled for ``adamw``).
        schedule: ``step``: multiply by ``gamma`` at each milestone; ``cosine``: fall to zero at the end; ``one_cycle``:
            rise from 1/25 of ``lr`` over ``warmup`` and fall to 1/10000 of that, both along a cosine; ``constant``.
        milestones: Where ``step`` lowers the rate, as fractions of the training: 0.75 is epoch 60 of 80.
        gamma: Factor at each milestone.
        warmup: Fraction of the training over which the rate rises, linearly from zero except for ``one_cycle``.
        encoder_lr: Learning rate of the depth encoder, which often starts from public weights; None means ``lr``.
        freeze: Parts that are not trained, by name: ``depth.encoder``, ``pose``, ``depth.encoder.stages.0``. Their
            normalization statistics are frozen too.
        freeze_statistics: Parts, by name, that are trained but keep the running statistics of their batch
            normalization.
        ema: Decay of the moving average of the weights, such as 0.999; the average is validated and saved. 0 turns it
            off.
        fused: One kernel for the whole optimizer step; by default on a CPU, where it takes a quarter of the time.
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
    freeze_statistics: Sequence[str] = ()
    ema: float = 0.0
    fused: bool | None = None

    def __post_init__(self) -> None:
        one_of("optim.optimizer", self.optimizer, ("adam", "adamw"))
        one_of("optim.schedule", self.schedule, ("step", "cosine", "one_cycle", "constant"))
        positive("optim.lr", self.lr)
        positive("optim.gamma", self.gamma)
        positive("optim.weight_decay", self.weight_decay, allow_zero=True)
        if self.encoder_lr is not None:
            positive("optim.encoder_lr", self.encoder_lr)
        if len(self.betas) != 2 or not all(0 <= beta < 1 for beta in self.betas):
            raise ConfigError(
                f"optim.betas is {list(self.betas)}; it must be two numbers in [0, 1), such as [0.9, 0.999]"
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
            raise ConfigError(
                "optim.schedule=one_cycle rises over optim.warmup, which is 0; set it, for example to 0.3"
            )
        if in_range("optim.ema", self.ema, 0, 1) == 1:
            raise ConfigError("optim.ema is 1, so the average would never move; use a smaller number, such as 0.999")

    def factor(self, progress: float) -> float:
        """Return the learning rate relative to ``lr`` after a fraction ``progress`` (0 to 1) of the training."""
        if progress < self.warmup:
            risen = progress / self.warmup
            if self.schedule == "one_cycle":
                return 1 / 25 + (1 - 1 / 25) * (0.5 - 0.5 * math.cos(math.pi * risen))
            return risen
        if self.schedule == "step":
            return float(self.gamma ** sum(progress >= milestone for milestone in self.milestones))
        if self.schedule == "constant":
            return 1.0
        done = min((progress - self.warmup) / (1 - self.warmup), 1.0)
        falling, end = 0.5 + 0.5 * math.cos(math.pi * done), 1 / 25e4
        return falling if self.schedule == "cosine" else end + (1 - end) * falling

    def factor_at(self, step: int, total: int) -> float:
        """Return the learning rate relative to ``lr`` after so many of all steps."""
        # The first step of a warm-up must not be lost to a rate of exactly zero.
        return self.factor(min((step + bool(self.warmup)) / total, 1.0))

    def frozen(self, model: nn.Module) -> list[nn.Module]:
        """Return the parts of a model that ``freeze`` names."""
        return _parts(model, "freeze", self.freeze)

    def fixed(self, model: nn.Module) -> list[nn.Module]:
        """Return the parts that stay in evaluation mode: frozen ones, and batch normalization with fixed statistics."""
        named = _parts(model, "freeze_statistics", self.freeze_statistics)
        norms = [module for part in named for module in part.modules() if isinstance(module, _BatchNorm)]
        return self.frozen(model) + norms

    def groups(self, model: nn.Module) -> list[dict[str, Any]]:
        """Return the trainable parameters of a model, with the depth encoder's separate if it has its own rate."""
        trainable = {name: parameter for name, parameter in model.named_parameters() if parameter.requires_grad}
        if not trainable:
            raise ConfigError(
                f"optim.freeze is {list(self.freeze)}, which leaves nothing to train; remove a part from it"
            )
        if self.encoder_lr is None:
            return [{"params": list(trainable.values())}]
        encoder, rest = (
            [parameter for name, parameter in trainable.items() if name.startswith("depth.encoder.") is inside]
            for inside in (True, False)
        )
        groups: list[dict[str, Any]] = [{"params": rest}, {"params": encoder, "lr": self.encoder_lr}]
        return [group for group in groups if group["params"]]

    def configure(self, parameters: Iterable[Parameter] | Sequence[dict[str, Any]], total_steps: int) -> dict[str, Any]:
        """Return optimizer and per-step scheduler for parameters, or groups of them, in Lightning's form."""
        groups: list[Any] = list(parameters)
        kind = torch.optim.AdamW if self.optimizer == "adamw" else torch.optim.Adam
        betas = (self.betas[0], self.betas[1])
        tensors = itertools.chain.from_iterable(each["params"] if isinstance(each, dict) else [each] for each in groups)
        on_cpu = self.fused is None and all(each.device.type == "cpu" for each in tensors)
        optimizer = kind(groups, self.lr, betas, weight_decay=self.weight_decay, fused=self.fused or on_cpu or None)
        if on_cpu:  # a CPU has no scaler; with one, the kernel would need its scale before clipping
            vars(optimizer)["_step_supports_amp_scaling"] = False
        scheduler = RecipeSchedule(optimizer, self, max(total_steps, 1))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def to_plain(self) -> dict[str, Any]:
        """Return the settings as plain containers, for a checkpoint."""
        return {key: list(value) if isinstance(value, tuple | list) else value for key, value in asdict(self).items()}

    def resumed_from(self, before: Mapping[str, Any]) -> str | None:
        """Describe in a sentence what happens to settings that differ from a resumed checkpoint's; None if none do."""
        now = self.to_plain()
        changed = [key for key in now if key in before and before[key] != now[key]]
        for key in ("optimizer", "freeze", "encoder_lr"):
            if key in changed and (key != "encoder_lr" or None in (before[key], now[key])):
                raise ConfigError(
                    f"optim.{key} is {now[key]} but the checkpoint was trained with {before[key]}, so its optimizer "
                    "state does not fit; keep the setting, or start a new training from its weights with init_from= "
                    "instead of resume="
                )
        kept = [f"optim.{key} {before[key]} (not {now[key]})" for key in changed if key in OPTIMIZER_STATE]
        taken = [f"optim.{key} {now[key]} (it was {before[key]})" for key in changed if key not in OPTIMIZER_STATE]
        parts = [f"keeps the checkpoint's {', '.join(kept)}"] * bool(kept)
        parts += [f"uses the new {', '.join(taken)}"] * bool(taken)
        return f"the resumed run {' and '.join(parts)}; {OTHER_SETTINGS}" if parts else None


def _parts(model: nn.Module, key: str, names: Sequence[str]) -> list[nn.Module]:
    parts = dict(model.named_modules())
    for name in names:
        allowed = [part for part in parts if part.startswith(("depth", "pose"))]
        if name not in allowed:
            upper = ", ".join(part for part in allowed if part.count(".") < 2)
            hint = suggest(name, allowed) or ","
            raise ConfigError(f"optim.{key} is '{name}'{hint} allowed: {upper}, and parts of these by their names")
    return [parts[name] for name in names]


class RecipeSchedule(LRScheduler):
    """A recipe's learning rate, step by step; its saved state is plain numbers, so checkpoints stay safe to read."""

    def __init__(self, optimizer: torch.optim.Optimizer, recipe: Recipe, total_steps: int) -> None:
        self.recipe, self.total_steps = recipe, total_steps
        super().__init__(optimizer)

    def get_lr(self) -> list[float]:  # type: ignore[override]
        factor = self.recipe.factor_at(self.last_epoch, self.total_steps)
        return [float(rate) * factor for rate in self.base_lrs]

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue from a position; in a schedule of another length, the next step has the rate of that one already."""
        super().load_state_dict(state_dict)
        rates = self.get_lr()
        self._last_lr = [*rates]
        for group, rate in zip(self.optimizer.param_groups, rates, strict=True):
            group["lr"] = rate

    def state_dict(self) -> dict[str, Any]:
        """Return the position in the schedule; the schedule itself comes from the config."""
        return {key: value for key, value in super().state_dict().items() if key not in ("recipe", "total_steps")}


class MovingAverage(WeightAveraging):
    """Exponential moving average of a model's parameters and buffers, which Lightning validates and saves.

    The first steps weigh more than ``decay`` says, so the fresh weights are soon forgotten: after n steps the decay is
    at most (1 + n) / (10 + n). Tensors that are not floating-point (a counter) are copied. A checkpoint holds the
    average as ``state_dict`` and the trained weights as ``current_model_state``.
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
        self._device = trainer.strategy.root_device  # the model is not on this device yet
        super().setup(trainer, pl_module, stage)
        if self._average_model is not None:
            # At 0, the first step would be copied instead of averaged; on the CPU, reading it does not wait for a
            # device.
            self._average_model.n_averaged = torch.ones((), dtype=torch.long)

    def update(self, model: LightningModule) -> None:
        """Move the average towards the weights, after a step."""
        assert self._average_model is not None
        self._average_model.update_parameters(model)

    def on_train_batch_end(self, *_: Any) -> None:
        """Do nothing: callbacks called before this one would have saved an average without the last step."""

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Leave the module with its own weights; for the average, load a checkpoint."""

    def _update(self, averages: Any, weights: Any, _: Any) -> None:
        assert self._average_model is not None
        steps = int(self._average_model.n_averaged) - 1
        if averages[0].is_floating_point():  # all are of one type
            torch._foreach_lerp_(averages, weights, 1 - min(self.decay, (1 + steps) / (10 + steps)))
        else:
            torch._foreach_copy_(averages, weights)
