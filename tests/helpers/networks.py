"""What several tests of networks check."""

from __future__ import annotations

import importlib.util
import io
import pickle
from typing import Any

import torch
from torch import nn

from saunet.models.depth import DepthNet
from saunet.models.encoders.resnet import BasicBlock, Bottleneck
from saunet.registry import decoders, encoders

TINY: dict[str, dict[str, Any]] = {
    "StratifiedTransformer": {"dim": 8, "depths": (2, 1, 1, 1), "heads": (1, 1, 2, 2), "window": (4, 4, 4, 4)},
    "SwinTransformer": {"dim": 8, "depths": (2, 1, 1, 1), "heads": (1, 1, 2, 2), "window": (4, 4, 4, 4)},
    "ResNet": {"blocks": (1, 1, 1, 1)},
    "PackNetEncoder": {"channels": (16, 16, 16, 16, 16), "blocks": (1, 1, 1, 1)},
    "LiteMonoEncoder": {"dims": (8, 16, 16), "depths": (2, 2, 2), "rates": (2,), "last_rates": (2,), "heads": 2},
}
"""What makes an encoder of each kind small; its layers stay the same."""


def small_network(encoder: str, decoder: str) -> DepthNet:
    """Return the depth network of two registered parts, small, for evaluation."""
    tiny = TINY.get(encoders.entry(encoder).target.__name__, {})
    return DepthNet(encoders.build(encoder, **tiny), decoders.partial(decoder)).eval()


def buildable_encoders() -> list[str]:
    """Return the names of encoders, timm's where its package can be imported: the session ``timm`` has it."""
    return [name for name in encoders.names() if name != "timm" or importlib.util.find_spec("timm")]


def assert_all_have_gradients(module: nn.Module) -> None:
    """Check that a backward pass has reached every parameter with finite numbers."""
    without = [name for name, p in module.named_parameters() if p.requires_grad and p.grad is None]
    assert not without, f"no gradient reaches {without}"
    broken = [name for name, p in module.named_parameters() if p.grad is not None and not p.grad.isfinite().all()]
    assert not broken, f"gradient is not finite in {broken}"


def assert_pickles(module: nn.Module) -> None:
    """Check that a module can be pickled, without keeping the bytes."""

    class Nowhere(io.RawIOBase):
        def writable(self) -> bool:
            return True

        def write(self, data: object) -> int:
            return len(data)  # type: ignore[arg-type]

    pickle.dump(module, Nowhere())


def settle(encoder: nn.Module, image: torch.Tensor) -> nn.Module:
    """Make an untrained encoder as tame as a trained one, where rounding does not grow from block to block.

    Batch normalization gets the statistics of one batch, and a ResNet's residual branches become small.
    """
    for module in encoder.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.momentum = 1.0
        if isinstance(module, BasicBlock | Bottleneck):
            nn.init.constant_((module.bn2 if isinstance(module, BasicBlock) else module.bn3).weight, 0.2)
    with torch.no_grad():
        encoder.train()(image)
    return encoder.eval()
