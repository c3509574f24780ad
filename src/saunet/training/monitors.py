"""What watches a training: figures that show early how it fails, how long it waits for data, NaN and infinity."""

from __future__ import annotations

import contextlib
import math
import os
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import torch
from jaxtyping import Bool, Float
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.utilities import rank_zero_info
from torch import Tensor, distributed
from torch.nn.modules.batchnorm import _BatchNorm

from saunet.data.loading.module import DepthDataModule
from saunet.data.loading.sampling import share
from saunet.errors import CheckpointError, DataError, SaunetError, in_range, one_of, positive
from saunet.geometry import full_precision
from saunet.runs.checkpoint import atomic_save
from saunet.threads import SETTINGS, Usage, available_cores, free
from saunet.training.pace import first_change, measure
from saunet.types import DepthPyramid, LossTerms

FAR = 0.8
"""Fraction of the largest depth that can be predicted from which a pixel counts as near the limit."""
DUMPS = 5
"""Bad batches kept at most in one run, on each process."""
NAMED = 3
"""Bad batches named at most in one message."""
AHEAD = 8
"""Batches that the device may lag behind before their flags are waited for."""
FEW = 10
"""Steps from which on it is said that a loss says little: before, networks are fresh and nobody looks at it."""
_ENOUGH = 20
"""Steps from which a training says what set its pace."""
_LOOK = 0.5
"""Seconds over which the use of the cores is measured before the first step."""


def health(
    pyramid: DepthPyramid, poses: Float[Tensor, "b s 4 4"], terms: LossTerms, max_depth: float
) -> dict[str, Float[Tensor, ""]]:
    """Return what to watch of one step, detached and without waiting for the device.

    ``disparity_spread``: standard deviation of an image's disparity over its mean, 0 for a flat picture;
    ``holes``: fraction of pixels near the far limit with something nearer above them, which sky has not;
    ``translation``: mean length of the motion, in units of depth; ``rotation``: mean angle, radians;
    ``automask``: fraction of pixels that teach, where the objective has such a mask.
    """
    disparity = pyramid.disparity[0].detach().float().flatten(1)
    return {
        "disparity_spread": (disparity.std(1) / disparity.mean(1).clamp(min=1e-9)).mean(),
        "holes": holes(pyramid.depth[0].detach() > FAR * max_depth),
        **learned_from(poses, terms),
    }


def learned_from(poses: Float[Tensor, "b s 4 4"], terms: LossTerms) -> dict[str, Float[Tensor, ""]]:
    """Return the part of `health` that concerns the motion and the pixels behind the loss, not the depth."""
    figures = _motion(poses.detach())
    if "automask" in terms.maps:
        figures["automask"] = terms.maps["automask"].float().mean()
    return figures


DOUBTED = ("automask", "rotation")
"""Measurements that show whether a loss can be trusted."""


def doubt(figures: Mapping[str, float], automask: float = 0.05, rotation: float = 0.5) -> str | None:
    """Say why the loss tells little about networks with these figures; None if nothing speaks against it.

    A mean over the few pixels that an auto-mask leaves is small where depth and motion are wrong almost everywhere.
    """
    reasons = []
    if figures.get("automask", 1.0) < automask:
        reasons.append(f"it is of {figures['automask']:.1%} of the pixels (auto-mask)")
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
        """What was sick so far: the sentence by the figure's name."""

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        if trainer.global_step >= self.after and trainer.global_step % self.every_n_steps == 0:
            self._look(trainer, pl_module)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Look at a short training too; where its networks are still fresh, only at whether its loss means anything."""
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
                said[name] = f"{name} is not a number, so the training is broken; lower optim.lr and start again"
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
            f"the loss says little about this training: {why}; lower optim.lr or train longer, and do not compare by it"
        )
        self.found.update({"loss": said} if why else {})
        return [said] if why else []


TOO_LOW = {
    "disparity_spread": "disparity is nearly flat (it varies by {:.2%} of its mean), so depth has collapsed; lower "
    "optim.lr, check data.offsets and the intrinsics, or start from public weights",
    "automask": "only {:.1%} of the pixels teach (auto-mask), so the loss says little: the camera stands still in most "
    "frames, exposure jumps between them, or optim.lr is too high; leave static frames out, use larger data.offsets, "
    "or lower optim.lr",
    "translation": "the predicted motion is nearly zero ({:.1e}), so the pose network has collapsed; lower optim.lr, "
    "or leave static frames out",
    "loss": "the loss is nearly zero ({:.1e}), so there is nothing to learn: target and sources are the same picture; "
    "leave static and doubled frames out (data.static=drop)",
}
TOO_HIGH = {
    "holes": "{:.1%} of the pixels are holes at the far limit inside the picture, as cars driving along leave them; "
    "leave out frames in which the camera stands still, and use objective.photometric.automask=true",
    "automask": "the auto-mask drops no pixel ({:.2%} teach), so even the wrong depth explains the frames better than "
    "no motion: the sources may not be neighbors of the target; check data.offsets and the order of the frames",
    "rotation": "the predicted camera turns by {:.2f} rad between frames, which no vehicle does, so the pose network "
    "has diverged; lower optim.lr, or check that neighboring frames follow each other",
}


@dataclass(frozen=True, slots=True)
class Loading:
    """How fast images came and how fast they could have been used, over some steps of one process."""

    images: int
    seconds: float
    waited: float

    def __add__(self, other: Loading) -> Loading:
        return Loading(self.images + other.images, self.seconds + other.seconds, self.waited + other.waited)

    @property
    def share(self) -> float:
        """Fraction of the time that was spent waiting for the loader."""
        return self.waited / self.seconds if self.seconds > 0 else 0.0

    @property
    def reached(self) -> float:
        """Images a second that arrived."""
        return self.images / self.seconds if self.seconds > 0 else 0.0

    @property
    def needed(self) -> float:
        """Images a second that the model could use if none were waited for."""
        return self.images / max(self.seconds - self.waited, 1e-9)


class LoaderMonitor(Callback):
    """Log the loader's images a second and its share of the time, and say once when it is the bottleneck.

    At the end it says where the time of a step went and what to change first.
    The first step of an epoch, before which worker processes start and validation runs, is left out. Time that the
    loader needs beside a busy device costs nothing and is not counted: only what the training step waits for is.

    Args:
        every_n_steps: Steps over which is measured, of several epochs where these are shorter.
        share: Part of the time from where the loader is called a bottleneck.
    """

    def __init__(self, every_n_steps: int = 50, share: float = 0.1) -> None:
        self.every_n_steps = int(positive("every_n_steps", every_n_steps))
        self.share = in_range("share", share, 0, 1)
        self._since: tuple[float, float] | None = None
        """When the step before ended, and what had been waited by then; None before the first step of an epoch."""
        self._measured = Loading(0, 0.0, 0.0)
        self._steps = 0
        self._all = Loading(0, 0.0, 0.0)
        self._all_steps = 0
        self._said = False

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Measure no pause between epochs; what was measured before it counts on."""
        self._since = None

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        waited = getattr(trainer.train_dataloader, "waited", None)
        if waited is None:
            return
        since, self._since = self._since, (time.monotonic(), waited)
        if since is None:
            return
        count, neighbors = batch["sources"].shape[:2]
        latest = Loading(int(count * (1 + neighbors)), self._since[0] - since[0], waited - since[1])
        loading = self._measured = self._measured + latest
        self._all, self._steps, self._all_steps = self._all + latest, self._steps + 1, self._all_steps + 1
        if self._steps < self.every_n_steps:
            return
        self._measured, self._steps = Loading(0, 0.0, 0.0), 0
        figures = {"loader/images_per_second": loading.reached, "loader/share": loading.share}
        pl_module.log_dict(figures, batch_size=1)
        if loading.share > self.share and not self._said:
            self._said = True
            rank_zero_info(sentence(loading, trainer))

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Say what set the pace, unless there were too few steps to know."""
        data = getattr(trainer, "datamodule", None)
        if self._all_steps < _ENOUGH or not trainer.is_global_zero or not isinstance(data, DepthDataModule):
            return
        step, waiting = (total / self._all_steps for total in (self._all.seconds, self._all.waited))
        with contextlib.suppress(DataError):  # a file that is gone by now is no reason to fail a finished training
            pace = measure(step, waiting, data, share(data.batch_size, trainer.world_size), pl_module.device)
            change = first_change(
                pace,
                share=self.share,
                workers=getattr(trainer.train_dataloader, "num_workers", 0),
                cacheable=data.cacheable and data.copies is None,
                device=pl_module.device.type,
                precision=str(trainer.precision),
                compiled=getattr(pl_module, "compiled", False),
            )
            rank_zero_info(f"{pace}; to make it faster: {change}")


class Threads(Callback):
    """Compute with as many threads as find a core, measured before the first step and again while training.

    More threads than free cores wait for each other most of the time. The user's ``OMP_NUM_THREADS`` or
    ``MKL_NUM_THREADS`` is left alone, and there are never more threads than torch had before.

    Args:
        every: Seconds over which the use of the cores is measured again.
    """

    def __init__(self, every: float = 20.0) -> None:
        self.every = positive("every", every)
        self._before = (0, 0)
        self._since: Usage | None = None

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._before = (torch.get_num_threads(), cv2.getNumThreads())
        self._since = None
        given = next((name for name in SETTINGS if name in os.environ), None)
        if given or trainer.num_devices > 1:  # several processes would measure each other
            rank_zero_info(f"{count(self._before[0])} per process{f', as {given} says' if given else ''}")
            return
        began = Usage.now()
        time.sleep(_LOOK)
        self._since = Usage.now()
        # The load average remembers a minute, in which this program may have worked itself; a moment may be unlucky.
        taken = min(self._since.taken_since(began), os.getloadavg()[0]) if began and self._since else 0.0
        cores = available_cores()
        self._use(free(cores, taken))
        others = f", of which other programs use {taken:.1f}" if taken >= 0.1 else ""
        said = f"{count(torch.get_num_threads())}: this process may use {cores} cores{others}"
        rank_zero_info(f"{said}; OMP_NUM_THREADS sets another number")

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        since = self._since
        if since is None or time.monotonic() - since.moment < self.every:
            return
        self._since = Usage.now()
        if self._since is not None:
            self._use(free(available_cores(), self._since.taken_since(since)))

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Give the process back the threads that it had."""
        if self._before[0]:
            torch.set_num_threads(self._before[0])
            cv2.setNumThreads(self._before[1])

    def _use(self, wanted: int) -> None:
        threads, own = (max(1, min(wanted, most)) for most in self._before)
        if threads != torch.get_num_threads():
            torch.set_num_threads(threads)
        if own != cv2.getNumThreads():
            cv2.setNumThreads(own)


def count(threads: int) -> str:
    return f"computing with {threads} thread{'s' * (threads > 1)}"


def sentence(loading: Loading, trainer: Trainer) -> str:
    """Say that the loader is the bottleneck, with its figures and what to do."""
    workers = getattr(trainer.train_dataloader, "num_workers", 0)
    cores = available_cores()
    each = " on this process" if trainer.world_size > 1 else ""
    data = getattr(trainer, "datamodule", None)
    advice = [f"raise data.workers (now {workers}, there are {cores} cores)"] if workers < cores else []
    if getattr(data, "cacheable", False) and data.copies is None:  # type: ignore[union-attr]
        advice.append("load smaller copies made once with saunet prepare cache")
    return (
        f"the loader is the bottleneck: {loading.reached:.0f} images/s arrive{each} and the model could use "
        f"{loading.needed:.0f} ({loading.share:.0%} of the time is spent waiting); "
        f"{', or '.join(advice or ['use a faster disk or more cores'])}"
    )


@dataclass
class _Step:
    """An optimizer step whose flags may not have arrived on the host yet."""

    number: int
    batches: Sequence[Mapping[str, Any]]
    flags: Tensor
    """Bad are: a loss of any process, the step, then the loss of each batch of this process."""
    arrived: torch.cuda.Event | None


class NonFinite(Callback):
    """Watch loss and gradients; on NaN or infinity keep the batch with its names, then stop the run or skip the step.

    ``stop`` costs nothing: flags travel to the host while the device works, and are read when they are there, at the
    latest before anything is saved. ``skip`` reads them before every step, which waits for the device; weights,
    optimizer and batch statistics stay as they were. All processes of a run do the same, and name the batch of the one
    whose loss was bad. With a loss scaler (``trainer.precision=16-mixed``) an infinite gradient is routine, and the
    scaler leaves that step out; only the loss counts there.

    Args:
        folder: Where bad batches go, as files that ``torch.load`` reads.
        action: ``stop`` or ``skip``.
        patience: Steps skipped in a row after which the run stops all the same.
    """

    def __init__(self, folder: str, action: Literal["stop", "skip"] = "stop", patience: int = 20) -> None:
        self.folder = Path(folder)
        self.action = one_of("action", action, ("stop", "skip"))
        self.patience = int(positive("patience", patience))
        self._pending: deque[_Step] = deque()
        self._batches: list[Mapping[str, Any]] = []  # since the last optimizer step, with the flags of their losses
        self._losses: list[Tensor] = []
        self._kept: list[tuple[Tensor, Tensor]] = []
        self._in_a_row = self._dumped = 0

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Keep the batch in reach, and the batch statistics that a bad one would spoil."""
        if batch_idx % trainer.accumulate_grad_batches == 0:
            self._batches, self._losses = [], []
            if self.action == "skip":
                norms = [module for module in pl_module.modules() if isinstance(module, _BatchNorm)]
                buffers = [buffer for norm in norms for buffer in norm.buffers(recurse=False)]
                self._kept = [(buffer, buffer.clone()) for buffer in buffers]
        self._batches.append(batch)

    def on_before_backward(self, trainer: Trainer, pl_module: LightningModule, loss: Tensor) -> None:
        self._losses.append(~torch.isfinite(loss.detach()))

    def on_before_optimizer_step(
        self, trainer: Trainer, pl_module: LightningModule, optimizer: torch.optim.Optimizer
    ) -> None:
        """Send the step's flags on their way, or take a bad step back before it is made."""
        parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
        flags = self._flags(trainer, [each.grad for each in parameters if each.grad is not None])
        arrived = None
        if self.action == "stop" and flags.is_cuda:
            flags = torch.empty_like(flags, device="cpu", pin_memory=True).copy_(flags, non_blocking=True)
            arrived = torch.cuda.Event()  # type: ignore[no-untyped-call]
            arrived.record()
        step = _Step(trainer.global_step + 1, self._batches, flags, arrived)
        if self.action == "stop":
            self._pending.append(step)  # from here on nothing is saved before it is read
        elif bool(flags[1]):
            self._skip(trainer, step, parameters)
        else:
            self._in_a_row = 0

    def on_train_batch_end(self, trainer: Trainer, *_: Any) -> None:
        """Read the flags that have arrived."""
        while self._pending and self._due(trainer):
            self._read_oldest(trainer)

    def _read(self, trainer: Trainer, *_: Any, **__: Any) -> None:
        """Look before broken weights are scored, saved in place of good ones, or count as finished."""
        while self._pending:
            self._read_oldest(trainer)

    on_validation_start = on_train_epoch_end = on_save_checkpoint = on_train_end = _read

    def _flags(self, trainer: Trainer, gradients: list[Tensor]) -> Tensor:
        """Return the flags of the step at hand, without waiting for the device."""
        losses = torch.stack(self._losses)
        loss = losses.any()
        bad = loss
        if gradients and getattr(trainer.precision_plugin, "scaler", None) is None:
            bad = bad | ~torch.isfinite(torch.stack(torch._foreach_norm(gradients)).sum())
        shared = torch.stack([loss, bad])
        if trainer.world_size > 1:  # else each would do something else, and wait for the others
            counted = shared.int()
            distributed.all_reduce(counted, distributed.ReduceOp.MAX)
            shared = counted.bool()
        return torch.cat([shared, losses])

    def _skip(self, trainer: Trainer, step: _Step, parameters: list[Tensor]) -> None:
        for parameter in parameters:
            parameter.grad = None  # what has no gradient is left alone by the optimizer, moments included
        for buffer, before in self._kept:
            buffer.copy_(before)
        self._in_a_row += 1
        what = self._describe(trainer, step)
        if self._in_a_row >= self.patience:
            raise SaunetError(f"{what}; {self._in_a_row} steps in a row were skipped, so the run ends: {_ADVICE}")
        rank_zero_info(f"{what}; the step is skipped")

    def _due(self, trainer: Trainer) -> bool:
        arrived = self._pending[0].arrived
        if arrived is None or (len(self._pending) > 1 and sum(len(each.batches) for each in self._pending) > AHEAD):
            return True
        # When a flag arrives is chance, and processes that tell each other about it must read it in the same step.
        return trainer.world_size == 1 and bool(arrived.query())  # type: ignore[no-untyped-call]

    def _read_oldest(self, trainer: Trainer) -> None:
        oldest = self._pending.popleft()
        if oldest.arrived is not None:
            oldest.arrived.synchronize()
        if bool(oldest.flags[1]):
            self._pending.clear()
            raise SaunetError(f"{self._describe(trainer, oldest)}; {_ADVICE}")

    def _describe(self, trainer: Trainer, step: _Step) -> str:
        """Keep the bad batches and say which they are; all processes come here at the same time."""
        loss, _, *own = step.flags.tolist()
        # Where only a gradient is bad, any batch of the step may be the reason.
        said = [self._keep(trainer, step, index) for index, bad in enumerate(own) if bad or not loss]
        if trainer.world_size > 1:
            gathered: list[list[str]] = [[] for _ in range(trainer.world_size)]
            distributed.all_gather_object(gathered, said)
            said = [each for part in gathered for each in part]
        more = f"; and {len(said) - NAMED} more batches" if len(said) > NAMED else ""
        what = "the loss" if loss else "the loss is finite, but its gradient"
        return f"{what} became NaN or infinite at step {step.number} ({'; '.join(said[:NAMED])}{more})"

    def _keep(self, trainer: Trainer, step: _Step, index: int) -> str:
        batch = step.batches[index]
        names = [str(name) for name in batch.get("name", [])]
        shown = ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
        of = f" of process {trainer.global_rank}" if trainer.world_size > 1 else ""
        said = f"batch{of}: {shown}"
        if self._dumped >= DUMPS:
            return said
        self._dumped += 1
        part = f"_batch_{index + 1}" if len(step.batches) > 1 else ""
        path = self.folder / f"step_{step.number}_process_{trainer.global_rank}{part}.pt"
        plain = {key: value.detach().cpu() if isinstance(value, Tensor) else value for key, value in batch.items()}
        try:
            atomic_save({"step": step.number, "epoch": trainer.current_epoch, "batch": plain}, path)
        except CheckpointError as reason:
            return f"{said}; {reason}"
        return f"{said}; kept as {path}"


_ADVICE = "look at the images, lower optim.lr, or train with trainer.precision=32"
