"""Gradients in bfloat16 point where those in float32 do, for every registered encoder and pose network."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from networks import buildable_encoders
from torch import nn

import saunet
from saunet.models.depth import DepthNet

FAST = {"lite_mono_tiny", "stratified_nano"}
"""The rest are tested in the slow session."""


def gradients(network: nn.Module, inputs: tuple[torch.Tensor, ...], half: bool) -> dict[str, torch.Tensor]:
    network.zero_grad()
    torch.manual_seed(1)
    with torch.autocast("cpu", torch.bfloat16, enabled=half):
        out = network(*inputs)
    maps = out.sigmoid if hasattr(out, "sigmoid") and not isinstance(out, torch.Tensor) else (out,)
    torch.manual_seed(2)
    sum((each.float() * torch.randn(each.shape)).mean() for each in maps).backward()  # type: ignore[union-attr]
    return {name: each.grad.clone() for name, each in network.named_parameters() if each.grad is not None}


def check(network: nn.Module, *inputs: torch.Tensor) -> None:
    network.eval()  # batch statistics of a tiny batch would amplify every rounding
    whole, half = (gradients(network, inputs, half) for half in (False, True))
    assert whole.keys() == half.keys()
    largest = max(float(each.abs().max()) for each in whole.values())
    wrong = {}
    for name, expected in whole.items():
        if float(expected.abs().max()) < 1e-4 * largest:  # nothing but rounding
            continue
        cosine = float(F.cosine_similarity(expected.flatten(), half[name].flatten(), dim=0))
        if not cosine > 0.9:
            wrong[name] = cosine
    assert not wrong


def test_a_dilated_depthwise_convolution_runs_in_float32() -> None:
    from saunet.models.encoders.lite_mono import DilatedBlock

    block, seen = DilatedBlock(8, 2, 2, 0.0), []
    block.depthwise.register_forward_hook(lambda module, given, out: seen.append(out.dtype))
    with torch.autocast("cpu", torch.bfloat16):
        block(torch.rand(1, 8, 6, 8).to(memory_format=torch.channels_last))
    assert seen == [torch.float32]


@pytest.mark.parametrize(
    "name",
    [name if name in FAST else pytest.param(name, marks=pytest.mark.slow) for name in buildable_encoders()],
)
def test_depth_gradients_in_bfloat16(name: str) -> None:
    torch.manual_seed(0)
    encoder = saunet.build("encoder", name)
    network = DepthNet(encoder, lambda features: saunet.build("decoder", "unet", features=features), 0.1, 100.0)
    check(network, torch.rand(1, 3, 64, 96))
