"""Efficient channel attention: neighboring channels weigh each other."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from saunet.errors import positive
from saunet.registry import attentions


@attentions.register("eca")
class ECA(nn.Module):
    """Efficient channel attention (Wang et al., "ECA-Net", CVPR 2020, eqs. (5)–(7) and (11)): k parameters.

    Each channel's mean over the map passes a 1-D convolution of k weights along the channels and a sigmoid, and scales
    the channel. k is the odd number next to log2(C)/γ + b/γ; no channel reduction, no bias.

    Args:
        channels: Channels C of the map.
        gamma: γ, how slowly k grows with log2 C.
        offset: b, the offset of k.
    """

    def __init__(self, channels: int, gamma: float = 2.0, offset: float = 1.0) -> None:
        super().__init__()
        positive("channels", channels)
        positive("gamma", gamma)
        nearest = int(abs(math.log2(channels) / gamma + offset / gamma))
        self.kernel_size = nearest if nearest % 2 else nearest + 1
        self.conv = nn.Conv1d(1, 1, self.kernel_size, padding=self.kernel_size // 2, bias=False)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        """Return ``x`` with each channel scaled by its weight in (0, 1)."""
        weight = torch.sigmoid(self.conv(x.mean((2, 3))[:, None]))
        return x * weight[:, 0, :, None, None]
