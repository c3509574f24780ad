"""Training health: figures that show early how a training fails, and what to do about it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Bool, Float
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.utilities import rank_zero_info
from torch import Tensor

from saunet.errors import in_range, positive
from saunet.geometry import full_precision
from saunet.types import DepthPyramid, LossTerms

FAR = 0.8
"""A pixel counts as near the far limit above this fraction of the largest depth that can be predicted."""
FEW = 10
"""A loss that says little is reported from this step on: before, the networks are fresh."""


def health(
    pyramid: DepthPyramid, poses: Float[Tensor, "b s 4 4"], terms: LossTerms, max_depth: float
) -> dict[str, Float[Tensor, ""]]:
    """Return the health figures of one step, detached and without waiting for the device.

    ``disparity_spread``: standard deviation of an image's disparity over its mean, 0 for a flat picture;
    ``holes``: fraction of pixels near the far limit with something nearer above them, which sky never has;
    ``translation``: mean length of the motion, in units of depth; ``rotation``: mean angle, radians;
    ``automask``: fraction of pixels used by the loss, if the objective has such a mask.
    """
    disparity = pyramid.disparity[0].detach().float().flatten(1)
    return {
        "disparity_spread": (disparity.std(1) / disparity.mean(1).clamp(min=1e-9)).mean(),
        "holes": holes(pyramid.depth[0].detach() > FAR * max_depth),
        **learned_from(poses, terms),
    }


def learned_from(poses: Float[Tensor, "b s 4 4"], terms: LossTerms) -> dict[str, Float[Tensor, ""]]:
    """Return the figures of `health` about motion and the pixels behind the loss, not those about depth."""
    figures = _motion(poses.detach())
    if "automask" in terms.maps:
        figures["automask"] = terms.maps["automask"].float().mean()
    return figures


DOUBTED = ("automask", "rotation")
"""Measurements that show whether a loss can be trusted."""


def doubt(figures: Mapping[str, float], automask: float = 0.05, rotation: float = 0.5) -> str | None:
    """Return why the loss says little about networks with these figures; None if it can be trusted.

    A mean over the few pixels that an auto-mask leaves is small even if depth and motion are wrong almost everywhere.
    """
    reasons = []
    if figures.get("automask", 1.0) < automask:
        reasons.append(f"it covers only {figures['automask']:.1%} of the pixels (auto-mask)")
    if figures.get("rotation", 0.0) > rotation:
        reasons.append(f"the predicted camera turns by {figures['rotation']:.2f} rad between frames")
    return " and ".join(reasons) or None


def holes(far: Bool[Tensor, "b 1 h w"]) -> Float[Tensor, ""]:
    """Return the fraction of far pixels with a nearer one above them in their column: holes in things, not sky."""
    nearer_above = (~far).int().cummax(2).values.bool()
    return (far & nearer_above).float().mean()


@full_precision
def _motion(T: Float[Tensor, "b s 4 4"]) -> dict[str, Tensor]:
    R = T[..., :3, :3]
    skew = R - R.transpose(-1, -2)
    sine = torch.stack((skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]), -1).norm(dim=-1) / 2
    cosine = (R.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    angle = torch.atan2(sine, cosine)  # acos of float32 reads 0 below 2e-4
    return {"translation": T[..., :3, 3].norm(dim=-1).mean(), "rotation": angle.mean()}


class HealthMonitor(Callback):
    """Warn in one sentence when depth collapses, holes open, the mask or the pose network fails, or the loss vanishes.

    The figures are always logged as ``health/...``. Each warning appears once per run, and is kept in ``run.json``
    under ``health``.

    Args:
        every_n_steps: Steps between checks of the figures; they are also checked at the end of the training.
        after: First step that is checked; fresh networks may look strange.
        spread: Smallest healthy ``disparity_spread``.
        holes: Largest healthy fraction of holes.
        automask: Smallest healthy fraction of pixels used by the loss.
        translation: Smallest healthy length of motion.
        unmasked: Largest healthy fraction of pixels used by the loss, if there is a mask.
        rotation: Largest healthy rotation between frames, radians.
        loss: Smallest healthy loss.
    """

    def __init__(
        self,
        every_n_steps: int = 100,
        after: int = 500,
        spread: float = 0.01,
        holes: float = 0.05,
        automask: float = 0.05,
        translation: float = 1e-5,
        unmasked: float = 0.9999,
        rotation: float = 0.5,
        loss: float = 1e-4,
    ) -> None:
        self.every_n_steps = int(positive("every_n_steps", every_n_steps))
        self.after = int(positive("after", after, allow_zero=True))
        self.least = {
            "disparity_spread": positive("spread", spread, allow_zero=True),
            "automask": in_range("automask", automask, 0, 1),
            "translation": positive("translation", translation, allow_zero=True),
            "loss": positive("loss", loss, allow_zero=True),
        }
        self.most = {
            "holes": in_range("holes", holes, 0, 1),
            "automask": in_range("unmasked", unmasked, 0, 1),
            "rotation": positive("rotation", rotation),
        }
        self.found: dict[str, str] = {}
        """The warnings so far, by the figure's name."""

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        if trainer.global_step >= self.after and trainer.global_step % self.every_n_steps == 0:
            self._look(trainer, pl_module)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Check a short training too; while its networks are fresh, check only whether its loss means anything."""
        if trainer.global_step >= min(self.after, self.every_n_steps):
            self._look(trainer, pl_module)
        elif trainer.global_step >= FEW:
            self._look(trainer, pl_module, fresh=True)

    def _look(self, trainer: Trainer, pl_module: LightningModule, fresh: bool = False) -> None:
        if not trainer.is_global_zero:
            return
        logged = {**{f"health/{name}": name for name in (*self.least, *self.most)}, "train/loss": "loss"}
        metrics = trainer.callback_metrics
        figures = {name: float(metrics[key]) for key, name in logged.items() if key in metrics}
        said = self.judge_loss(figures) if fresh else self.judge(figures)
        for sentence in said:
            rank_zero_info(f"step {trainer.global_step}: {sentence}")
        record = getattr(pl_module, "run_record", None)
        if said and record is not None:
            record.write(health=self.found)

    def judge(self, figures: Mapping[str, float]) -> list[str]:
        """Return a sentence for each figure that is outside its healthy range for the first time."""
        said = {}
        for name, value in figures.items():
            if name in self.found:
                continue
            if math.isnan(value):
                said[name] = f"{name} is not a number, so the training has failed; lower optim.lr and start again"
            elif value < self.least.get(name, -math.inf):
                said[name] = TOO_LOW[name].format(value)
            elif value > self.most.get(name, math.inf):
                said[name] = TOO_HIGH[name].format(value)
        self.found.update(said)
        return list(said.values())

    def judge_loss(self, figures: Mapping[str, float]) -> list[str]:
        """Return a sentence if the loss of a short training says little."""
        why = doubt(figures, self.least["automask"], self.most["rotation"])
        said = (
            f"the loss says little about this training: {why}; lower optim.lr or train longer, and do not compare "
            "runs by it"
        )
        self.found.update({"loss": said} if why else {})
        return [said] if why else []


TOO_LOW = {
    "disparity_spread": "disparity is nearly flat (it varies by {:.2%} of its mean), so depth has collapsed; lower "
    "optim.lr, check data.offsets and the intrinsics, or start from public weights",
    "automask": "only {:.1%} of the pixels are used (auto-mask), so the loss says little: the camera stands still in "
    "most frames, exposure jumps between them, or optim.lr is too high; leave static frames out, use larger "
    "data.offsets, or lower optim.lr",
    "translation": "the predicted motion is nearly zero ({:.1e}), so the pose network has collapsed; lower optim.lr, "
    "or leave static frames out",
    "loss": "the loss is nearly zero ({:.1e}), so there is nothing to learn: target and sources are the same picture; "
    "leave static and doubled frames out (data.static=drop)",
}
TOO_HIGH = {
    "holes": "{:.1%} of the pixels are holes at the far limit inside the picture, typical of cars that drive along; "
    "leave out frames in which the camera stands still, and use objective.photometric.automask=true",
    "automask": "the auto-mask drops almost no pixel ({:.2%} are used), so even wrong depth explains the frames "
    "better than no motion: the sources may not be neighbors of the target; check data.offsets and the order of "
    "the frames",
    "rotation": "the predicted camera turns by {:.2f} rad between frames, which no vehicle does, so the pose network "
    "has diverged; lower optim.lr, or check that neighboring frames are consecutive",
}
