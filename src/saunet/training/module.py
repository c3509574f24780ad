"""The LightningModule: a training step that reads like the paper, validation under a named protocol, and resuming."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from lightning import Callback, LightningModule
from lightning.pytorch.trainer.states import TrainerFn
from lightning.pytorch.utilities import rank_zero_info
from torch import Tensor, nn

from saunet.errors import ConfigError
from saunet.geometry import warp
from saunet.geometry.depth import disparity_to_depth, enlarge
from saunet.geometry.pose import scaled_motion
from saunet.losses.base import Objective
from saunet.metrics.depth import DepthMetrics
from saunet.runs.folder import RunRecord
from saunet.runs.record import Intrinsics
from saunet.training.health import DOUBTED, health, learned_from
from saunet.training.intrinsics import FocalLengths
from saunet.training.loop import total_steps
from saunet.training.optim import MovingAverage, Recipe
from saunet.training.resume import continuation, owe_validation, stretched, validation_due
from saunet.training.speed import Speed
from saunet.types import DepthPyramid, EvalBatch, LossTerms, TrainBatch, View, Views

EPOCH_LOSS = "train/loss_epoch"
"""Name of the mean of ``train/loss`` over an epoch and all processes (``train/loss`` itself is the last batch's)."""


class SelfSupervisedDepth(LightningModule):
    """Depth and pose networks trained together on video by view synthesis (SAU-Net section III).

    Args:
        depth: Image -> `DepthPyramid`.
        pose: (target, sources) -> ``T_src_tgt`` of the neighbors in time; None if the stereo view is the only source.
        objective: (batch, pyramid, poses, views) -> `LossTerms`.
        recipe: Optimizer and schedule.
        metrics: Scores validation batches that have ground truth.
        seed: Dropped paths and tie-break noise depend on it, the step and the process, and nothing else.
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
        super().__init__()
        self.depth = depth
        self.pose = pose
        self.objective = objective
        self.recipe = recipe if recipe is not None else Recipe()
        self.metrics = metrics if metrics is not None else DepthMetrics()
        self.seed = seed
        self.record = dict(record or {})
        self.speed = speed if speed is not None else Speed()
        self.objective_node: Mapping[str, Any] | None = None
        """Config node of the objective, if known; kept in checkpoints."""
        self.run_record: RunRecord | None = None
        """The run's ``run.json``, if there is one."""
        self.average = MovingAverage(self.recipe.ema) if self.recipe.ema > 0 else None
        self.intrinsics: FocalLengths | None = None
        """Learns the focal lengths; None if the data's are fixed."""
        self._prepared = False
        self._steps: int | None = None  # of the whole training
        self._owed = False  # a validation that a killed run did not finish

    @property
    def compiled(self) -> bool:
        """Whether networks, view synthesis and losses are compiled."""
        return self.speed.compile

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> DepthPyramid:
        """Return the depth of images in [0, 1]."""
        pyramid: DepthPyramid = self.depth(image)
        return pyramid

    def training_step(self, batch: TrainBatch, batch_idx: int) -> Tensor:
        """Return the loss of one batch, a scalar, eq. (14)."""
        pyramid, poses, _, terms = self.step(batch)
        watched = health(pyramid, poses, terms, float(getattr(self.depth, "max_depth", torch.inf)))
        figures = {**terms.named("train"), **{f"health/{name}": value for name, value in watched.items()}}
        figures, count = self._of_all_processes(figures), len(batch["name"])
        self.log_dict(figures, prog_bar=False, batch_size=count)
        self.log("train/lr", self.trainer.optimizers[0].param_groups[0]["lr"], batch_size=count)
        self.log("loss", figures["train/loss"], prog_bar=True, logger=False, batch_size=count)
        # Without validation, best.ckpt is chosen by this: the last batch alone would be chance.
        mean: dict[str, Any] = {"on_step": False, "on_epoch": True, "sync_dist": True, "logger": False}
        self.log(EPOCH_LOSS, terms.total.detach(), batch_size=count, **mean)
        return terms.total

    def _of_all_processes(self, figures: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return the means over the processes of a run, in one exchange, if they are going to be used."""
        trainer, step = self.trainer, self.global_step + 1
        every: int = trainer.log_every_n_steps  # type: ignore[attr-defined]
        # After the last step of an epoch or training, all processes must choose the same best checkpoint.
        looked_at = (every and step % every == 0) or trainer.is_last_batch or step == trainer.max_steps
        if trainer.world_size == 1 or not looked_at:
            return figures
        stacked = torch.stack([value.float() for value in figures.values()])
        means: Tensor = trainer.strategy.reduce(stacked, reduce_op="mean")
        return dict(zip(figures, means.unbind(), strict=True))

    def step(self, batch: TrainBatch) -> tuple[DepthPyramid, Float[Tensor, "b s 4 4"], Sequence[View], LossTerms]:
        """Predict depth and motion, synthesize the target from its neighbors, and compare."""
        if "target" not in batch:
            raise ConfigError(
                f"the batch has {', '.join(batch)} and no target: it holds the loader's bytes; prepare it first: "
                "batch = data.on_after_batch_transfer(batch, 0)"
            )
        if self.intrinsics is not None:
            batch = {**batch, "K": self.intrinsics(batch["K"], batch["name"], batch["target"].shape[-1])}
        pyramid: DepthPyramid = self.depth(batch["target"])  # Z_t
        poses = self.motion(batch)  # D_{t->t'}
        if "T_tracked" in batch:
            batch, poses = self._tracked(batch, pyramid, poses)
        synthesize = functools.partial(self.synthesize, batch, pyramid, poses)  # H_{t'->t}, eq. (7)
        views = synthesize() if self.speed.compile else Views(len(pyramid.disparity), synthesize)
        if self.objective.needs_source_depth:
            near: DepthPyramid = self.depth(batch["sources"].flatten(0, 1))
            shape = (*batch["sources"].shape[:2], *near.depth[0].shape[1:])
            batch = {**batch, "source_depth": near.depth[0].reshape(shape)}
        terms: LossTerms = self.objective(batch, pyramid, poses, views)  # alpha L1 + beta L2, eq. (14)
        return pyramid, poses, views, terms

    def motion(self, batch: TrainBatch) -> Float[Tensor, "b s 4 4"]:
        """Return T_src_tgt of each source: predicted for neighbors in time, known for a stereo view, the last."""
        sources = batch["sources"]
        known = [batch["T_stereo_tgt"][:, None]] if "T_stereo_tgt" in batch else []
        if known and sources.shape[1] == 1:
            return known[0]
        if self.pose is None:
            raise ConfigError(
                "the batch has neighbors in time but the model has no pose network; build one, or use data with a "
                "stereo view only"
            )
        predicted: Tensor = self.pose(batch["target"], sources[:, : sources.shape[1] - len(known)])
        return torch.cat([predicted, *known], 1) if known else predicted

    @staticmethod
    def _tracked(batch: TrainBatch, pyramid: DepthPyramid, poses: Tensor) -> tuple[TrainBatch, Tensor]:
        """Replace the predicted motion with that of tracked points, with its length taken from depth."""
        tracked = scaled_motion(batch["T_tracked"], batch["track_points"], pyramid.depth[0])
        own, rest = poses[:, : tracked.shape[1]], poses[:, tracked.shape[1] :]
        known = tracked.isfinite().flatten(-2).all(-1)[..., None, None]
        used = torch.where(known, tracked, own)
        return {**batch, "T_tracked": tracked.detach(), "T_predicted": own}, torch.cat([used, rest], 1)

    @staticmethod
    def synthesize(batch: TrainBatch, pyramid: DepthPyramid, poses: Float[Tensor, "b s 4 4"]) -> tuple[View, ...]:
        """Resample the source images into the target camera, once per scale, eq. (7).

        Coarse disparity is enlarged to full resolution first (Monodepth2): sampling small images would leave holes in
        the gradient and copy texture into depth.
        """
        height, width = batch["loss_target"].shape[-2:]
        depths = [disparity_to_depth(enlarge(disparity, height, width)) for disparity in pyramid.disparity]
        return tuple(warp.synthesize(batch["loss_sources"], depth, batch["K"], poses) for depth in depths)

    def validation_step(self, batch: EvalBatch, batch_idx: int) -> None:
        """Score depth if there is ground truth, and the loss if the batch has neighbors."""
        count = len(batch["name"])
        if batch["sources"].shape[1] > 0:
            pyramid, poses, _, terms = self.step(batch)
            watched = learned_from(poses, terms)
            figures = {f"val/{name}": watched[name] for name in DOUBTED if name in watched}
            self.log_dict({**terms.named("val"), **figures}, sync_dist=True, batch_size=count)
        else:
            pyramid = self(batch["target"])
        disparity = pyramid.disparity[0]
        if "depth" in batch:
            self.metrics.update(disparity, batch["depth"], batch["depth_size"])
        else:  # counted anyway: every process then has something to sum, and torchmetrics nothing to warn about
            nothing = torch.zeros(count, 2, dtype=torch.int64, device=disparity.device)
            self.metrics.update(disparity, disparity.new_zeros(count, 1, 1, 1), nothing)

    def on_validation_start(self) -> None:
        """Count the batches of a postponed validation again."""
        if self._owed and not self.trainer.sanity_checking:
            self._owed = False
            self.trainer.fit_loop.epoch_loop.val_loop.batch_progress.total.reset()

    def on_validation_epoch_end(self) -> None:
        """Log the metrics over the whole validation set, exact over any number of processes."""
        result = self.metrics.compute()
        if result["images"] > 0:
            # Every process holds the same synchronized numbers, but the trainer warns if they are not reduced. Their
            # maximum equals each of them to the last digit.
            named = {f"val/{name}": value.to(torch.float32) for name, value in result.items()}
            self.log_dict(named, sync_dist=True, reduce_fx="max")
            self.log("abs_rel", named["val/abs_rel"], prog_bar=True, logger=False, sync_dist=True, reduce_fx="max")
        self.metrics.reset()

    def setup(self, stage: str) -> None:
        """Apply freezing and speed switches from the config, once, in the process that trains."""
        if self._prepared:
            return
        self._prepared = True
        for part in self.recipe.frozen(self):
            part.requires_grad_(False)
        for part in self.recipe.fixed(self):
            part.eval()
            warnings.filterwarnings("ignore", message=r"Found \d+ module\(s\) in eval mode")  # on purpose
        # A 1x1 convolution has several valid strides, and DDP copies a gradient with other strides than its own.
        warnings.filterwarnings("ignore", message=r"Grad strides do not match bucket view strides")
        self.speed.apply(self, self.trainer.strategy.root_device)

    def train(self, mode: bool = True) -> SelfSupervisedDepth:
        """Switch between training and evaluation; frozen parts and statistics stay in evaluation mode."""
        super().train(mode)
        for part in self.recipe.fixed(self) if mode and self._prepared else ():
            part.eval()
        return self

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "average": None}  # which holds a copy of this module

    def configure_callbacks(self) -> list[Callback]:
        """Let Lightning keep the average of the weights, and use it for validation."""
        return [self.average] if self.average is not None else []

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        """Make the step's randomness a function of seed, step and process, so a resumed run draws the same numbers."""
        micro = batch_idx % self.trainer.accumulate_grad_batches  # or accumulated batches would all draw the same
        position = [self.seed, self.global_step, self.global_rank, micro]
        torch.manual_seed(int(np.random.SeedSequence(position).generate_state(1)[0]))

    def optimizer_step(
        self, epoch: int, batch_idx: int, optimizer: Any, optimizer_closure: Callable[[], Any] | None = None
    ) -> None:
        """Take one step, then move the average."""
        super().optimizer_step(epoch, batch_idx, optimizer, optimizer_closure)
        if self.average is not None:
            self.average.update(self)

    def configure_optimizers(self) -> Any:
        total = total_steps(self.trainer, getattr(self.trainer, "datamodule", None))
        self._steps = total
        return self.recipe.configure(self.recipe.groups(self), total)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Store the record that rebuilds the networks, and the settings that a resumed training must share."""
        checkpoint["saunet"] = self.record
        if self.intrinsics is not None:
            found = self.found_intrinsics(checkpoint["state_dict"])
            checkpoint["saunet"] = {**self.record, "intrinsics": found.to_plain()}
        checkpoint["saunet_training"] = self.training_state(getattr(self._trainer, "datamodule", None))

    def found_intrinsics(self, state: Mapping[str, Tensor] | None = None) -> Intrinsics:
        """Return the learned focal lengths, from a state of this module, or the current or averaged ones."""
        assert self.intrinsics is not None
        if state is None:
            state = self.average.values if self.average is not None else self.state_dict()
        return self.intrinsics.found(state["intrinsics.change"])

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Check that the same training continues, and report changes of recipe, networks or objective."""
        if self._trainer is None or self.trainer.state.fn != TrainerFn.FITTING:
            return
        for sentence in continuation(checkpoint, self, getattr(self.trainer, "datamodule", None)):
            rank_zero_info(sentence)
        total = total_steps(self.trainer, getattr(self.trainer, "datamodule", None))
        if moved := stretched(checkpoint, self.recipe, total, self.trainer.ckpt_path):
            rank_zero_info(moved)
        self._owed = validation_due(checkpoint)
        if self._owed:
            owe_validation(checkpoint["loops"]["fit_loop"])
        if self.average is None and "current_model_state" in checkpoint:  # no longer averaged
            checkpoint["state_dict"] = checkpoint["current_model_state"]

    def training_state(self, data: Any) -> dict[str, Any]:
        """Return what a checkpoint keeps of a training besides its networks; unknown entries are left out."""
        settings: dict[str, Any] = {"seed": self.seed}
        if self.objective_node:
            settings["objective"] = dict(self.objective_node)
        if getattr(data, "batch_size", None) is not None:
            settings["batch_size"] = data.batch_size
        if "train" in getattr(data, "datasets", {}):
            settings["train_split"] = data.datasets["train"].fingerprint()
        due, row = self._to_come()
        known: dict[str, Any] = {"recipe": self.recipe.to_plain(), "settings": settings, "validation_due": due}
        if self._steps is not None:
            known["steps"] = self._steps
        return {**known, "unlogged": row} if row else known

    def _to_come(self) -> tuple[bool, dict[str, float]]:
        """Return whether a validation follows the step just done, and the step's row of the curves if due.

        Lightning logs a step after the callbacks that save it. A kill in between would lose the row.
        """
        trainer = self._trainer
        if trainer is None or trainer.state.fn != TrainerFn.FITTING or not trainer.training:
            return False, {}
        loop, fetcher, logs = trainer.fit_loop.epoch_loop, trainer.fit_loop._data_fetcher, trainer._logger_connector
        done: Any = loop.batch_progress.current
        if fetcher is None or done.completed >= done.processed:
            return False, {}
        row = {key: float(value) for key, value in logs.metrics["log"].items()} if logs.should_update_logs else {}
        row = {**row, "epoch": trainer.current_epoch, "step": loop._batches_that_stepped} if row else {}
        return loop._should_check_val_fx(fetcher), row
