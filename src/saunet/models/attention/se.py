"""Squeeze-and-excitation: a small bottleneck looks at all channels and weighs each."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from saunet.errors import positive
from saunet.registry import attentions


@attentions.register("se")
class SE(nn.Module):
    """Squeeze-and-excitation (Hu et al., CVPR 2018, eqs. (2)–(4)): 2·C·⌊C/r⌋ parameters (at least one hidden unit).

    s = σ(W2 relu(W1 z)) with z each channel's mean over the map; no biases, as in the paper's parameter count, eq. (5).

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
        """Return ``x`` with each channel scaled by its weight in (0, 1)."""
        weight = torch.sigmoid(self.excite(F.relu(self.squeeze(x.mean((2, 3))))))
        return x * weight[:, :, None, None]
