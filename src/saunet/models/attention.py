"""Registered channel attentions: each scales a map's channels (CBAM also pixels) by weights computed from the map."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from saunet.errors import ConfigError, positive
from saunet.registry import attentions


@attentions.register("none")
class NoAttention(nn.Module):
    """The identity, with 0 parameters: AU-Net's bottleneck without attention (SAU-Net Table 3).

    Args:
        channels: Channels of the map.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        positive("channels", channels)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        return x


@attentions.register("se")
class SE(nn.Module):
    """Squeeze-and-excitation (Hu et al., CVPR 2018, eqs. (2)–(4)): 2·C·⌊C/r⌋ parameters (at least one hidden unit).

    s = σ(W2 relu(W1 z)), where z is each channel's mean over the map; no biases, as in the paper's parameter count, eq.
    (5).

    Args:
        channels: Channels C of the map.
        reduction: r, how much narrower the hidden layer is.
    """

    def __init__(self, channels: int, reduction: int = 16) -> None:
        super().__init__()
        positive("channels", channels)
        positive("reduction", reduction)
        hidden = max(1, channels // reduction)
        self.squeeze = nn.Linear(channels, hidden, bias=False)
        self.excite = nn.Linear(hidden, channels, bias=False)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        weight = torch.sigmoid(self.excite(F.relu(self.squeeze(x.mean((2, 3))))))
        return x * weight[:, :, None, None]


@attentions.register("cbam")
class CBAM(SE):
    """Convolutional block attention module (Woo et al., ECCV 2018, eqs. (1)–(3)): 2·C·⌊C/r⌋ + 2·k² parameters.

    Channel: M_c = σ(W1 relu(W0 mean) + W1 relu(W0 max)) over the map. Then space: M_s = σ(f^{k×k}([mean; max])) over
    the channels. No biases, as in the paper's equations.

    Args:
        channels: Channels C of the map.
        reduction: r, how much narrower the hidden layer is.
        kernel_size: k, side of the spatial convolution, odd.
    """

    def __init__(self, channels: int, reduction: int = 16, kernel_size: int = 7) -> None:
        super().__init__(channels, reduction)
        if kernel_size < 1 or kernel_size % 2 == 0:
            raise ConfigError(f"kernel_size is {kernel_size}; it must be an odd number, such as 7")
        self.spatial = nn.Conv2d(2, 1, kernel_size, padding=kernel_size // 2, bias=False)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        pooled = torch.stack([x.mean((2, 3)), x.amax((2, 3))])
        channel = torch.sigmoid(self.excite(F.relu(self.squeeze(pooled))).sum(0))
        x = x * channel[:, :, None, None]
        where = torch.cat([x.mean(1, keepdim=True), x.amax(1, keepdim=True)], 1)
        return x * torch.sigmoid(self.spatial(where))


@attentions.register("eca")
class ECA(nn.Module):
    """Efficient channel attention (Wang et al., "ECA-Net", CVPR 2020, eqs. (5)–(7) and (11)): k parameters.

    Each channel's mean over the map goes through a 1-D convolution with k weights along the channels and a sigmoid, and
    then scales the channel. k is the nearest odd number to log2(C)/γ + b/γ; no channel reduction, no bias.

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
        weight = torch.sigmoid(self.conv(x.mean((2, 3))[:, None]))
        return x * weight[:, 0, :, None, None]


@attentions.register("gct")
class GCT(nn.Module):
    """Gated channel transformation (Yang et al., CVPR 2020, eqs. (2)–(5)): 3·C parameters.

    Embedding s_c = α_c·‖x_c‖₂, channel normalization ŝ_c = √C·s_c/‖s‖₂, gate x_c·(1 + tanh(γ_c·ŝ_c + β_c)). It starts
    as the identity (α = 1, γ = β = 0). The norms are taken in float32: a sum of squares over a map overflows float16.

    Args:
        channels: Channels C of the map.
        eps: ε under both roots.
    """

    def __init__(self, channels: int, eps: float = 1e-5) -> None:
        super().__init__()
        positive("channels", channels)
        positive("eps", eps)
        self.eps = eps
        self.alpha = nn.Parameter(torch.ones(channels, 1, 1))
        self.gamma = nn.Parameter(torch.zeros(channels, 1, 1))
        self.beta = nn.Parameter(torch.zeros(channels, 1, 1))

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        embedding = self.alpha * (x.float().square().sum((2, 3), keepdim=True) + self.eps).sqrt()
        # √C·s/‖s‖₂ is s over its root mean square
        normalized = embedding * (embedding.square().mean(1, keepdim=True) + self.eps).rsqrt()
        gate = 1 + torch.tanh(self.gamma * normalized + self.beta)
        return x * gate.to(x.dtype)
