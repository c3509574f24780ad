"""Switches for the speed and memory of a training that do not change what it learns.

Mixed precision, gradient accumulation and the number of devices are the trainer's (``trainer.precision``,
``trainer.accumulate_grad_batches``, ``trainer.devices``), the fused optimizer is the recipe's (``optim.fused``), and
the memory format of convolutions depends on the device.
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

from saunet.models.decoders.base import SkipDecoder
from saunet.models.encoders.base import StemEncoder
from saunet.models.layers.conv import lay_out, training_format


@dataclass(frozen=True)
class Speed:
    """Speed switches of a training.

    Args:
        compile: Compile networks, view synthesis and losses with ``torch.compile``; the first steps take minutes.
        checkpoint_activations: Keep only the inputs of each network block, of an encoder's first layers, and of each
            level of a skip decoder, and recompute the rest for the gradient: about a third more work for much less
            memory.
    """

    compile: bool = False
    checkpoint_activations: bool = False

    def apply(self, model: Any, device: torch.device) -> None:
        """Prepare a `SelfSupervisedDepth` to train on a device, in place; weight names do not change."""
        parts: list[nn.Module] = [part for part in (model.depth, model.pose) if isinstance(part, nn.Module)]
        for part in parts:
            lay_out(part, training_format(part, device))
        if self.checkpoint_activations:
            for part in parts:
                for module, method in recomputable(part):
                    setattr(module, method, functools.partial(_recomputed, module, getattr(module, method)))
        if self.compile:
            for part in (*parts, model.objective):
                part.compile()
            model.synthesize = torch.compile(model.synthesize)


def recomputable(network: nn.Module) -> list[tuple[nn.Module, str]]:
    """Return the modules of a network whose results can be recomputed, with the methods that do so.

    They are `StemEncoder.begin`, `SkipDecoder.level`, and a network's repeated blocks: the entries of its innermost
    lists and sequences that hold several layers each.
    """
    if isinstance(network, SkipDecoder):
        return [(network, "level")]
    found: list[tuple[nn.Module, str]] = [(network, "begin")] if isinstance(network, StemEncoder) else []
    for child in network.children():
        inner = recomputable(child)
        if inner:
            found += inner
        elif isinstance(network, nn.ModuleList | nn.Sequential) and sum(1 for _ in child.children()) > 1:
            found.append((child, "forward"))
    return found


def _recomputed(module: nn.Module, method: Any, *args: Any, **kwargs: Any) -> Any:
    if not torch.is_grad_enabled():
        return method(*args, **kwargs)

    return checkpoint(
        method, *args, use_reentrant=False, context_fn=lambda: (nullcontext(), _statistics_kept(module)), **kwargs
    )


@contextmanager
def _statistics_kept(network: nn.Module) -> Iterator[None]:
    """Let batch norm use a batch's statistics without counting it a second time."""
    norms = [module for module in network.modules() if isinstance(module, _BatchNorm)]
    kept = [(buffer, buffer.clone()) for norm in norms for buffer in norm.buffers(recurse=False)]
    try:
        yield
    finally:
        for buffer, before in kept:
            buffer.copy_(before)
