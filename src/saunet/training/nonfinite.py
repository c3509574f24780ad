"""NaN and infinity in losses and gradients: keep the batch, then stop the run or skip the step."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.utilities import rank_zero_info
from torch import Tensor, distributed
from torch.nn.modules.batchnorm import _BatchNorm

from saunet.errors import CheckpointError, SaunetError, one_of, positive
from saunet.runs.checkpoint import atomic_save

DUMPS = 5
"""At most this many bad batches are kept per run and process."""
NAMED = 3
"""At most this many bad batches are named per message."""
AHEAD = 8
"""Batches that the device may lag behind before the host waits for their flags."""


@dataclass
class _Step:
    """An optimizer step whose flags may not have arrived on the host yet."""

    number: int
    batches: Sequence[Mapping[str, Any]]
    flags: Tensor
    """Flags of a bad loss on any process, a bad step, then a bad loss of each batch of this process."""
    arrived: torch.cuda.Event | None


class NonFinite(Callback):
    """Watch loss and gradients; on NaN or infinity, keep the batch with its names, then stop the run or skip the step.

    ``stop`` costs nothing: flags are copied to the host while the device works, and read once they have arrived, at the
    latest before anything is saved. ``skip`` reads them before every step, which waits for the device; weights,
    optimizer and batch statistics stay unchanged. All processes of a run do the same, and name the batch of the process
    whose loss was bad. With a loss scaler (``trainer.precision=16-mixed``) an infinite gradient is routine, and the
    scaler skips that step; only the loss counts there.

    Args:
        folder: Where bad batches are saved, as files for ``torch.load``.
        action: ``stop`` or ``skip``.
        patience: The run stops after this many skipped steps in a row.
    """

    def __init__(self, folder: str, action: Literal["stop", "skip"] = "stop", patience: int = 20) -> None:
        self.folder = Path(folder)
        self.action = one_of("action", action, ("stop", "skip"))
        self.patience = int(positive("patience", patience))
        self._pending: deque[_Step] = deque()
        self._batches: list[Mapping[str, Any]] = []  # batches since the last optimizer step, with their losses' flags
        self._losses: list[Tensor] = []
        self._kept: list[tuple[Tensor, Tensor]] = []
        self._in_a_row = self._dumped = 0

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Hold on to the batch, and to the batch statistics that a bad batch would spoil."""
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
        """Send the step's flags to the host, or cancel a bad step before it is taken."""
        parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
        flags = self._flags(trainer, [each.grad for each in parameters if each.grad is not None])
        arrived = None
        if self.action == "stop" and flags.is_cuda:
            flags = torch.empty_like(flags, device="cpu", pin_memory=True).copy_(flags, non_blocking=True)
            arrived = torch.cuda.Event()  # type: ignore[no-untyped-call]
            arrived.record()
        step = _Step(trainer.global_step + 1, self._batches, flags, arrived)
        if self.action == "stop":
            self._pending.append(step)  # from here on, flags are read before anything is saved
        elif bool(flags[1]):
            self._skip(trainer, step, parameters)
        else:
            self._in_a_row = 0

    def on_train_batch_end(self, trainer: Trainer, *_: Any) -> None:
        """Read the flags that have arrived."""
        while self._pending and self._due(trainer):
            self._read_oldest(trainer)

    def _read(self, trainer: Trainer, *_: Any, **__: Any) -> None:
        """Check before broken weights are scored, replace good ones, or count as finished."""
        while self._pending:
            self._read_oldest(trainer)

    on_validation_start = on_train_epoch_end = on_save_checkpoint = on_train_end = _read

    def _flags(self, trainer: Trainer, gradients: list[Tensor]) -> Tensor:
        """Return the flags of the current step, without waiting for the device."""
        losses = torch.stack(self._losses)
        loss = losses.any()
        bad = loss
        if gradients and getattr(trainer.precision_plugin, "scaler", None) is None:
            bad = bad | ~torch.isfinite(torch.stack(torch._foreach_norm(gradients)).sum())
        shared = torch.stack([loss, bad])
        if trainer.world_size > 1:  # otherwise each would act differently, and wait for the others
            counted = shared.int()
            distributed.all_reduce(counted, distributed.ReduceOp.MAX)
            shared = counted.bool()
        return torch.cat([shared, losses])

    def _skip(self, trainer: Trainer, step: _Step, parameters: list[Tensor]) -> None:
        for parameter in parameters:
            parameter.grad = None  # without a gradient the optimizer leaves it alone, moments included
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
        # Flags arrive at random times, but processes that communicate about them must read them in the same step.
        return trainer.world_size == 1 and bool(arrived.query())  # type: ignore[no-untyped-call]

    def _read_oldest(self, trainer: Trainer) -> None:
        oldest = self._pending.popleft()
        if oldest.arrived is not None:
            oldest.arrived.synchronize()
        if bool(oldest.flags[1]):
            self._pending.clear()
            raise SaunetError(f"{self._describe(trainer, oldest)}; {_ADVICE}")

    def _describe(self, trainer: Trainer, step: _Step) -> str:
        """Keep and name the bad batches; all processes get here at the same time."""
        loss, _, *own = step.flags.tolist()
        # If only a gradient is bad, any batch of the step may be the cause.
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


_ADVICE = "check the images, lower optim.lr, or train with trainer.precision=32"
