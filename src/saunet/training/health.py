"""Figures that show early how a training fails, and a monitor that says so in a sentence."""

from __future__ import annotations

import math
from collections.abc import Mapping

from jaxtyping import Bool, Float
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.utilities import rank_zero_info
from torch import Tensor

from saunet.errors import in_range, positive
from saunet.geometry.precision import full_precision
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
    trace = T[..., 0, 0] + T[..., 1, 1] + T[..., 2, 2]
    angle = ((trace - 1) / 2).clamp(-1, 1).acos()
    return {"translation": T[..., :3, 3].norm(dim=-1).mean(), "rotation": angle.mean()}


class HealthMonitor(Callback):
    """Say in one sentence when depth collapses, holes open, hardly a pixel teaches, or the camera seems not to move.

    The figures are in the log as ``health/...`` all the time. Each sentence is said once a run.

    Args:
        every_n_steps: How often the figures are looked at.
        after: Step from which on they are; fresh networks may look strange.
        spread: Smallest healthy ``disparity_spread``.
        holes: Largest healthy share of holes.
        automask: Smallest healthy share of pixels that teach.
        translation: Smallest healthy length of motion.
    """

    def __init__(
        self,
        every_n_steps: int = 100,
        after: int = 500,
        spread: float = 0.01,
        holes: float = 0.05,
        automask: float = 0.05,
        translation: float = 1e-5,
    ) -> None:
        self.every_n_steps = int(positive("every_n_steps", every_n_steps))
        self.after = int(positive("after", after, allow_zero=True))
        self.least = {
            "disparity_spread": positive("spread", spread, allow_zero=True),
            "automask": in_range("automask", automask, 0, 1),
            "translation": positive("translation", translation, allow_zero=True),
        }
        self.most = {"holes": in_range("holes", holes, 0, 1)}
        self._said: set[str] = set()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: object, batch: object, batch_idx: int
    ) -> None:
        """Look at the figures now and then."""
        step = trainer.global_step
        if step < self.after or step % self.every_n_steps or not trainer.is_global_zero:
            return
        names = [name for name in (*self.least, *self.most) if f"health/{name}" in trainer.callback_metrics]
        for said in self.judge({name: float(trainer.callback_metrics[f"health/{name}"]) for name in names}):
            rank_zero_info(f"step {step}: {said}")

    def judge(self, figures: Mapping[str, float]) -> list[str]:
        """Return a sentence for each figure that is outside its healthy range for the first time.

        Args:
            figures: Figures of `health`, by name.
        """
        sick = [
            name
            for name, value in figures.items()
            if name not in self._said
            and (value < self.least.get(name, -math.inf) or value > self.most.get(name, math.inf))
        ]
        self._said.update(sick)
        return [_SENTENCES[name].format(figures[name]) for name in sick]


_SENTENCES = {
    "disparity_spread": "disparity is nearly flat (it varies by {:.2%} of its mean), so depth has collapsed; lower "
    "optim.lr, check data.offsets and the intrinsics, or start from public weights",
    "holes": "{:.1%} of the pixels are holes at the far limit inside the picture, as cars driving along leave them; "
    "leave frames out in which the camera stands still, and use objective.photometric.automask=true",
    "automask": "only {:.1%} of the pixels teach (auto-mask): the camera stands still in most frames, or exposure "
    "jumps between them; leave static frames out, or use larger data.offsets",
    "translation": "the predicted motion is nearly zero ({:.1e}), so the pose network has collapsed; lower optim.lr, "
    "or leave static frames out",
}
