"""Gated channel transformation: channels compete or cooperate through their norms."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from saunet.errors import positive
from saunet.registry import attentions


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
        """Return ``x`` with each channel scaled by its gate in (0, 2)."""
        embedding = self.alpha * (x.float().square().sum((2, 3), keepdim=True) + self.eps).sqrt()
        # √C·s/‖s‖₂ is s over its root mean square
        normalized = embedding * (embedding.square().mean(1, keepdim=True) + self.eps).rsqrt()
        gate = 1 + torch.tanh(self.gamma * normalized + self.beta)
        return x * gate.to(x.dtype)
