"""Figures that show early how a training fails, and a monitor that says so in a sentence."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.utilities import rank_zero_info
from torch import Tensor

from saunet.errors import in_range, positive
from saunet.geometry import full_precision
from saunet.types import DepthPyramid, LossTerms

FAR = 0.8
"""Part of the largest depth that can be predicted from where a pixel counts as near the limit."""


def health(
    pyramid: DepthPyramid, poses: Float[Tensor, "b s 4 4"], terms: LossTerms, max_depth: float
) -> dict[str, Float[Tensor, ""]]:
    """Return what to watch of one step, detached and without waiting for the device.

    Args:
        pyramid: The predicted depth.
        poses: The predicted motion.
        terms: The objective's result.
        max_depth: The largest depth that the network can predict.

    Returns:
        ``disparity_spread``: standard deviation of an image's disparity over its mean, 0 for a flat picture;
        ``holes``: share of pixels near the far limit with something nearer above them, which sky has not;
        ``translation``: mean length of the motion, in units of depth; ``rotation``: mean angle, radians;
        ``automask``: share of pixels that teach, where the objective has such a mask.
    """
    disparity = pyramid.disparity[0].detach().float().flatten(1)
    figures = {
        "disparity_spread": (disparity.std(1) / disparity.mean(1).clamp(min=1e-9)).mean(),
        "holes": holes(pyramid.depth[0].detach() > FAR * max_depth),
        **_motion(poses.detach()),
    }
    if "automask" in terms.maps:
        figures["automask"] = terms.maps["automask"].float().mean()
    return figures


def holes(far: Bool[Tensor, "b 1 h w"]) -> Float[Tensor, ""]:
    """Share of far pixels that have a nearer one above them in their column: holes in things, not sky."""
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


@dataclass(frozen=True)
class Limit:
    """When a figure is sick, and what to say then; ``{}`` in the sentence is the figure."""

    least: float
    most: float
    below: str
    above: str = ""


class HealthMonitor(Callback):
    """Say in one sentence when depth collapses, holes open, the mask or the pose network fails, or the loss is nothing.

    The figures are in the log as ``health/...`` all the time. Each sentence is said once a run, and stands in
    ``run.json`` under ``health``.

    Args:
        every_n_steps: How often the figures are looked at, and once more at the end of the training.
        after: Step from which on they are; fresh networks may look strange.
        spread: Smallest healthy ``disparity_spread``.
        holes: Largest healthy fraction of holes.
        automask: Smallest healthy fraction of pixels that teach.
        translation: Smallest healthy length of motion.
        unmasked: Largest healthy fraction of pixels that teach, where there is a mask.
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
        spread, translation = (
            positive(name, value, allow_zero=True) for name, value in (("spread", spread), ("translation", translation))
        )
        loss, rotation = positive("loss", loss, allow_zero=True), positive("rotation", rotation)
        holes, automask = in_range("holes", holes, 0, 1), in_range("automask", automask, 0, 1)
        self.limits = {
            "disparity_spread": Limit(spread, math.inf, _FLAT),
            "holes": Limit(-math.inf, holes, "", _HOLES),
            "automask": Limit(automask, in_range("unmasked", unmasked, 0, 1), _MASKED, _UNMASKED),
            "translation": Limit(translation, math.inf, _FROZEN),
            "rotation": Limit(-math.inf, rotation, "", _TURNING),
            "loss": Limit(loss, math.inf, _NOTHING),
        }
        self.found: dict[str, str] = {}
        """What was sick so far: the sentence by the figure's name."""

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: object, batch: object, batch_idx: int
    ) -> None:
        """Look at the figures now and then."""
        if trainer.global_step >= self.after and trainer.global_step % self.every_n_steps == 0:
            self._look(trainer, pl_module)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Look at a short training too, unless its networks are still fresh."""
        if trainer.global_step >= min(self.after, self.every_n_steps):
            self._look(trainer, pl_module)

    def _look(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if not trainer.is_global_zero:
            return
        logged = {**{f"health/{name}": name for name in self.limits}, "train/loss": "loss"}
        metrics = trainer.callback_metrics
        said = self.judge({name: float(metrics[key]) for key, name in logged.items() if key in metrics})
        for sentence in said:
            rank_zero_info(f"step {trainer.global_step}: {sentence}")
        record = getattr(pl_module, "run_record", None)
        if said and record is not None:
            record.write(health=self.found)

    def judge(self, figures: Mapping[str, float]) -> list[str]:
        """Return a sentence for each figure that is outside its healthy range for the first time."""
        said = {}
        for name, value in figures.items():
            limit = self.limits.get(name)
            if limit is None or name in self.found:
                continue
            if math.isnan(value):
                said[name] = f"{name} is not a number, so the training is broken; lower optim.lr and start again"
            elif value < limit.least:
                said[name] = limit.below.format(value)
            elif value > limit.most:
                said[name] = limit.above.format(value)
        self.found.update(said)
        return list(said.values())


_FLAT = (
    "disparity is nearly flat (it varies by {:.2%} of its mean), so depth has collapsed; lower optim.lr, check "
    "data.offsets and the intrinsics, or start from public weights"
)
_HOLES = (
    "{:.1%} of the pixels are holes at the far limit inside the picture, as cars driving along leave them; leave out "
    "frames in which the camera stands still, and use objective.photometric.automask=true"
)
_MASKED = (
    "only {:.1%} of the pixels teach (auto-mask): the camera stands still in most frames, or exposure jumps between "
    "them; leave static frames out, or use larger data.offsets"
)
_UNMASKED = (
    "the auto-mask drops no pixel ({:.2%} teach), so even the wrong depth explains the frames better than no motion: "
    "the sources may not be neighbors of the target; check data.offsets and the order of the frames"
)
_FROZEN = (
    "the predicted motion is nearly zero ({:.1e}), so the pose network has collapsed; lower optim.lr, or leave static "
    "frames out"
)
_TURNING = (
    "the predicted camera turns by {:.2f} rad between frames, which no vehicle does, so the pose network has "
    "diverged; lower optim.lr, or check that neighboring frames follow each other"
)
_NOTHING = (
    "the loss is nearly zero ({:.1e}), so there is nothing to learn: target and sources are the same picture; leave "
    "static and doubled frames out (data.static=drop)"
)
