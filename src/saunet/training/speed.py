"""Switches that change how fast or in how little memory a training runs, and nothing of what it learns.

Mixed precision, gradient accumulation and the number of devices are the trainer's (``trainer.precision``,
``trainer.accumulate_grad_batches``, ``trainer.devices``), the fused optimizer is the recipe's (``optim.fused``), and
the memory format of convolutions goes by the device.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn
from torch.nn.modules.batchnorm import _BatchNorm
from torch.utils.checkpoint import checkpoint

from saunet.models.layers.conv import lay_out, training_format


@dataclass(frozen=True)
class Speed:
    """Speed switches of a training.

    Args:
        compile: Compile networks, view synthesis and losses with ``torch.compile``; the first steps take minutes.
        checkpoint_activations: Keep only the inputs of each network block and compute the rest again for the gradient:
            about a third more work for much less memory.
    """

    compile: bool = False
    checkpoint_activations: bool = False

    def apply(self, model: Any, device: torch.device) -> None:
        """Prepare a `SelfSupervisedDepth` to train on a device, in place; names of weights stay as they are."""
        parts: list[nn.Module] = [part for part in (model.depth, model.pose) if isinstance(part, nn.Module)]
        for part in parts:
            lay_out(part, training_format(part, device))
        if self.checkpoint_activations:
            for part in parts:
                for block in blocks(part):
                    block.forward = functools.partial(_recomputed, block, block.forward)
        if self.compile:
            for part in (*parts, model.objective):
                part.compile()
            model.synthesize = torch.compile(model.synthesize)


def blocks(network: nn.Module) -> list[nn.Module]:
    """Return what a network repeats: the entries of its innermost lists and sequences that hold several layers each."""
    found: list[nn.Module] = []
    for child in network.children():
        inner = blocks(child)
        if inner:
            found += inner
        elif isinstance(network, nn.ModuleList | nn.Sequential) and sum(1 for _ in child.children()) > 1:
            found.append(child)
    return found


def _recomputed(block: nn.Module, forward: Any, *args: Any, **kwargs: Any) -> Any:
    if not torch.is_grad_enabled():
        return forward(*args, **kwargs)

    return checkpoint(
        forward, *args, use_reentrant=False, context_fn=lambda: (nullcontext(), _statistics_kept(block)), **kwargs
    )


@contextmanager
def _statistics_kept(block: nn.Module) -> Iterator[None]:
    """Let batch norm use a batch's statistics without counting it a second time."""
    norms = [module for module in block.modules() if isinstance(module, _BatchNorm)]
    kept = [(buffer, buffer.clone()) for norm in norms for buffer in norm.buffers(recurse=False)]
    try:
        yield
    finally:
        for buffer, before in kept:
            buffer.copy_(before)
