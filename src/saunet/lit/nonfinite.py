"""What happens when a loss is NaN or infinite: the batch is kept for a look, and the run stops or leaves it out."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.utilities import rank_zero_info
from torch import Tensor
from torch.nn.modules.batchnorm import _BatchNorm

from saunet.checkpoint import atomic_save
from saunet.checks import CheckpointError, SaunetError, one_of, positive

DUMPS = 5
"""Batches kept at most in one run."""
AHEAD = 8
"""Steps that the device may lag behind before their flags are waited for."""


@dataclass
class _Pending:
    """A step whose loss may not have arrived on the host yet."""

    step: int
    batch: Mapping[str, Any]
    bad: Tensor
    arrived: torch.cuda.Event | None


class NonFinite(Callback):
    """Watch the loss; on NaN or infinity keep the batch with its names, then stop the run or skip the step.

    ``stop`` costs nothing: flags travel to the host while the device works, and are read when they are there. ``skip``
    looks at the gradients before every step, which waits for the device; weights, optimiser and batch statistics stay
    as they were, on every process alike.

    Args:
        folder: Where bad batches go, as files that ``torch.load`` reads.
        action: ``stop`` or ``skip``.
        patience: Steps skipped in a row after which the run stops all the same.
    """

    def __init__(self, folder: str, action: Literal["stop", "skip"] = "stop", patience: int = 20) -> None:
        self.folder = Path(folder)
        self.action = one_of("action", action, ("stop", "skip"))
        self.patience = int(positive("patience", patience))
        self._pending: deque[_Pending] = deque()
        self._batch: Mapping[str, Any] = {}
        self._bad: Tensor | None = None
        self._kept: list[tuple[Tensor, Tensor]] = []
        self._in_a_row = self._dumped = 0

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Keep the batch in reach, and the batch statistics that a bad one would spoil."""
        self._batch = batch
        if self.action == "skip":
            norms = [module for module in pl_module.modules() if isinstance(module, _BatchNorm)]
            buffers = [buffer for norm in norms for buffer in norm.buffers(recurse=False)]
            self._kept = [(buffer, buffer.clone()) for buffer in buffers]

    def on_before_backward(self, trainer: Trainer, pl_module: LightningModule, loss: Tensor) -> None:
        """Note whether the loss, a scalar, is finite."""
        self._bad = ~torch.isfinite(loss.detach())

    def on_before_optimizer_step(
        self, trainer: Trainer, pl_module: LightningModule, optimizer: torch.optim.Optimizer
    ) -> None:
        """Take a bad step back before it is made."""
        if self.action != "skip":
            return
        parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
        gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
        # Processes have exchanged gradients by now, so all of them come to the same decision. With a loss scaler, an
        # overflow of the gradients alone is routine, and the scaler deals with it.
        scaled = str(trainer.precision).startswith("16")
        if not gradients or (scaled and not bool(self._bad)):
            return
        if bool(torch.isfinite(torch.stack(torch._foreach_norm(gradients)).sum())):
            self._in_a_row = 0
            return
        for parameter in parameters:
            parameter.grad = None  # what has no gradient is left alone by the optimiser, moments included
        for buffer, before in self._kept:
            buffer.copy_(before)
        self._in_a_row += 1
        what = self._describe(trainer, trainer.global_step, self._batch)
        if self._in_a_row >= self.patience:
            raise SaunetError(f"{what}; {self._in_a_row} steps in a row were skipped, so the run ends: {_ADVICE}")
        rank_zero_info(f"{what}; the step is skipped")

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Send the flag on its way, and read those that have arrived."""
        bad, self._bad = self._bad, None
        if self.action == "skip" or bad is None:
            return
        arrived = None
        if bad.is_cuda:
            host = torch.empty_like(bad, device="cpu", pin_memory=True).copy_(bad, non_blocking=True)
            arrived = torch.cuda.Event()  # type: ignore[no-untyped-call]
            arrived.record()
            bad = host
        self._pending.append(_Pending(trainer.global_step, batch, bad, arrived))
        self._read(trainer, everything=False)

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Look before broken weights are scored and saved."""
        self._read(trainer)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Look before broken weights are saved."""
        self._read(trainer)

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Look before broken weights take the place of good ones."""
        self._read(trainer)

    def _read(self, trainer: Trainer, everything: bool = True) -> None:
        while self._pending:
            oldest = self._pending[0]
            if oldest.arrived is not None and not oldest.arrived.query():  # type: ignore[no-untyped-call]
                if not everything and len(self._pending) <= AHEAD:
                    return
                oldest.arrived.synchronize()
            self._pending.popleft()
            if bool(oldest.bad):
                self._pending.clear()
                raise SaunetError(f"{self._describe(trainer, oldest.step, oldest.batch)}; {_ADVICE}")

    def _describe(self, trainer: Trainer, step: int, batch: Mapping[str, Any]) -> str:
        names = [str(name) for name in batch.get("name", [])]
        shown = ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
        return f"the loss became NaN or infinite at step {step} (batch: {shown}{self._dump(trainer, step, batch)})"

    def _dump(self, trainer: Trainer, step: int, batch: Mapping[str, Any]) -> str:
        if self._dumped >= DUMPS:
            return ""
        self._dumped += 1
        path = self.folder / f"step_{step}_process_{trainer.global_rank}.pt"
        plain = {key: value.detach().cpu() if isinstance(value, Tensor) else value for key, value in batch.items()}
        try:
            atomic_save({"step": step, "epoch": trainer.current_epoch, "batch": plain}, path)
        except CheckpointError as reason:
            return f"; {reason}"
        return f"; kept as {path}"


_ADVICE = "look at the images, lower optim.lr, or train with trainer.precision=32"
