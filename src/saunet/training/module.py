"""The training loop's body: four lines that read like the paper, and validation under a named protocol."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from saunet.errors import ConfigError
from saunet.geometry import warp
from saunet.geometry.depth import disparity_to_depth
from saunet.losses.base import Objective
from saunet.metrics.depth import DepthMetrics
from saunet.training.base import TrainedModule
from saunet.training.health import health
from saunet.training.optim import Recipe
from saunet.training.speed import Speed
from saunet.types import DepthPyramid, EvalBatch, LossTerms, TrainBatch, View

EPOCH_LOSS = "train/loss_epoch"
"""Name of the mean of ``train/loss`` over an epoch and all processes, which is itself the last batch's."""


class SelfSupervisedDepth(TrainedModule):
    """Depth and pose networks trained together on video by view synthesis (SAU-Net section III).

    Args:
        depth: Image -> `DepthPyramid`.
        pose: (target, sources) -> ``T_src_tgt`` of the neighbors in time; None where the stereo partner is the only
            source.
        objective: (batch, pyramid, poses, views) -> `LossTerms`.
        recipe: Optimizer and schedule.
        metrics: Scores validation batches that have ground truth.
        seed: With step and process, all that dropped paths and tie-break noise depend on.
        record: Plain data stored in every checkpoint under ``"saunet"``; `saunet.load` rebuilds the networks from it.
        speed: Speed switches.
    """

    def __init__(
        self,
        depth: nn.Module,
        pose: nn.Module | None,
        objective: Objective,
        recipe: Recipe | None = None,
        metrics: DepthMetrics | None = None,
        seed: int = 0,
        record: Mapping[str, Any] | None = None,
        speed: Speed | None = None,
    ) -> None:
        super().__init__(recipe, speed, seed, record)
        self.depth = depth
        self.pose = pose
        self.objective = objective
        self.metrics = metrics if metrics is not None else DepthMetrics()

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> DepthPyramid:
        """Return the depth of images in [0, 1]."""
        pyramid: DepthPyramid = self.depth(image)
        return pyramid

    def training_step(self, batch: TrainBatch, batch_idx: int) -> Tensor:
        """Return the loss of one batch, a scalar, eq. (14)."""
        pyramid, poses, _, terms = self.predict_and_compare(batch)
        watched = health(pyramid, poses, terms, float(getattr(self.depth, "max_depth", torch.inf)))
        figures = {**terms.named("train"), **{f"health/{name}": value for name, value in watched.items()}}
        figures = self._of_all_processes(figures)
        self.log_dict(figures, prog_bar=False, batch_size=len(batch["name"]))
        self.log("train/lr", self.trainer.optimizers[0].param_groups[0]["lr"], batch_size=len(batch["name"]))
        self.log("loss", figures["train/loss"], prog_bar=True, logger=False, batch_size=len(batch["name"]))
        # What best.ckpt is chosen by where nothing is validated: the last batch alone would be chance.
        mean: dict[str, Any] = {"on_step": False, "on_epoch": True, "sync_dist": True, "logger": False}
        self.log(EPOCH_LOSS, terms.total.detach(), batch_size=len(batch["name"]), **mean)
        return terms.total

    def _of_all_processes(self, figures: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return the means over the processes of a run, in one exchange, where somebody will look at them."""
        trainer, step = self.trainer, self.global_step + 1
        every: int = trainer.log_every_n_steps  # type: ignore[attr-defined]
        # After the last step of an epoch or training, all of them must come to the same decision about the best state.
        looked_at = (every and step % every == 0) or trainer.is_last_batch or step == trainer.max_steps
        if trainer.world_size == 1 or not looked_at:
            return figures
        stacked = torch.stack([value.float() for value in figures.values()])
        means: Tensor = trainer.strategy.reduce(stacked, reduce_op="mean")
        return dict(zip(figures, means.unbind(), strict=True))

    def step(self, batch: TrainBatch) -> tuple[DepthPyramid, tuple[View, ...], LossTerms]:
        """Return depth, the sources warped into the target, and the loss of a batch."""
        pyramid, _, views, terms = self.predict_and_compare(batch)
        return pyramid, views, terms

    def predict_and_compare(
        self, batch: TrainBatch
    ) -> tuple[DepthPyramid, Float[Tensor, "b s 4 4"], tuple[View, ...], LossTerms]:
        """Predict depth and motion, synthesize the target from its neighbors, and compare."""
        pyramid: DepthPyramid = self.depth(batch["target"])  # Z_t
        poses = self.motion(batch)  # D_{t->t'}
        views = self.synthesize(batch, pyramid, poses)  # H_{t'->t}, eq. (7)
        if self.objective.needs_source_depth:
            batch = {**batch, "source_depth": self._source_depth(batch)}
        terms: LossTerms = self.objective(batch, pyramid, poses, views)  # alpha L1 + beta L2, eq. (14)
        return pyramid, poses, views, terms

    def motion(self, batch: TrainBatch) -> Float[Tensor, "b s 4 4"]:
        """Return T_src_tgt of each source: predicted for neighbors in time, known for a stereo partner, the last."""
        target, sources = batch["target"], batch["sources"]
        if "T_stereo_tgt" not in batch:
            predicted: Tensor = self._pose(target, sources)
            return predicted
        known = batch["T_stereo_tgt"][:, None]
        if sources.shape[1] == 1:
            return known
        return torch.cat([self._pose(target, sources[:, :-1]), known], 1)

    def _pose(self, target: Tensor, sources: Tensor) -> Tensor:
        if self.pose is None:
            raise ConfigError(
                "the model has no pose network and the batch has neighbors in time; build one, or use data with a "
                "stereo partner only"
            )
        poses: Tensor = self.pose(target, sources)
        return poses

    def _source_depth(self, batch: TrainBatch) -> Float[Tensor, "b s 1 h w"]:
        """Return the depth of the source images, for terms that compare it with the target's."""
        sources = batch["sources"]
        pyramid: DepthPyramid = self.depth(sources.flatten(0, 1))
        return pyramid.depth[0].reshape(*sources.shape[:2], 1, *sources.shape[-2:])

    @staticmethod
    def synthesize(batch: TrainBatch, pyramid: DepthPyramid, poses: Float[Tensor, "b s 4 4"]) -> tuple[View, ...]:
        """Resample the source images into the target camera, once per scale, eq. (7).

        Coarse disparity is enlarged to full resolution first (Monodepth2): sampling small images would leave holes in
        the gradient and copy texture into depth.
        """
        size = batch["loss_target"].shape[-2:]
        views = []
        for disparity in pyramid.disparity:
            full = disparity
            if disparity.shape[-2:] != size:
                full = F.interpolate(disparity, size=size, mode="bilinear", align_corners=False)
            views.append(warp.synthesize(batch["loss_sources"], disparity_to_depth(full), batch["K"], poses))
        return tuple(views)

    def validation_step(self, batch: EvalBatch, batch_idx: int) -> None:
        """Score depth where there is ground truth, and the loss where the batch has neighbors."""
        count = len(batch["name"])
        if batch["sources"].shape[1] > 0:
            pyramid, _, terms = self.step(batch)
            self.log_dict(terms.named("val"), sync_dist=True, batch_size=count)
        else:
            pyramid = self(batch["target"])
        disparity = pyramid.disparity[0]
        if "depth" in batch:
            self.metrics.update(disparity, batch["depth"], batch["depth_size"])
        else:  # counted all the same: every process then has something to sum, and torchmetrics nothing to warn of
            nothing = torch.zeros(count, 2, dtype=torch.int64, device=disparity.device)
            self.metrics.update(disparity, disparity.new_zeros(count, 1, 1, 1), nothing)

    def on_validation_epoch_end(self) -> None:
        """Log the metrics over the whole validation set, exact over any number of processes."""
        result = self.metrics.compute()
        if result["images"] > 0:
            # Every process holds the same synchronized numbers; the trainer warns where they are not reduced all the
            # same, and the largest of them is each of them, to the last digit.
            named = {f"val/{name}": value.to(torch.float32) for name, value in result.items()}
            self.log_dict(named, sync_dist=True, reduce_fx="max")
            self.log("abs_rel", named["val/abs_rel"], prog_bar=True, logger=False, sync_dist=True, reduce_fx="max")
        self.metrics.reset()
