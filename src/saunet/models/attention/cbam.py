"""Convolutional block attention: which channel matters, then where."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from saunet.errors import ConfigError, positive
from saunet.registry import attentions


@attentions.register("cbam")
class CBAM(nn.Module):
    """Convolutional block attention module (Woo et al., ECCV 2018, eqs. (1)–(3)): 2·C·⌊C/r⌋ + 2·k² parameters.

    Channel: M_c = σ(W1 relu(W0 mean) + W1 relu(W0 max)) over the map. Then space: M_s = σ(f^{k×k}([mean; max])) over
    the channels. No biases, as in the paper's equations.

    Args:
        channels: Channels C of the map.
        reduction: r, how much narrower the hidden layer is.
        kernel_size: k, side of the spatial convolution, odd.

    Raises:
        ConfigError: if k is even.
    """

    def __init__(self, channels: int, reduction: int = 16, kernel_size: int = 7) -> None:
        super().__init__()
        positive("channels", channels)
        positive("reduction", reduction)
        if kernel_size < 1 or kernel_size % 2 == 0:
            raise ConfigError(f"kernel_size is {kernel_size}; it must be an odd number, such as 7")
        hidden = max(1, channels // reduction)
        self.squeeze = nn.Linear(channels, hidden, bias=False)
        self.excite = nn.Linear(hidden, channels, bias=False)
        self.spatial = nn.Conv2d(2, 1, kernel_size, padding=kernel_size // 2, bias=False)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        """Return ``x`` scaled by a channel weight and a pixel weight, both in (0, 1)."""
        pooled = torch.stack([x.mean((2, 3)), x.amax((2, 3))])
        channel = torch.sigmoid(self.excite(F.relu(self.squeeze(pooled))).sum(0))
        x = x * channel[:, :, None, None]
        where = torch.cat([x.mean(1, keepdim=True), x.amax(1, keepdim=True)], 1)
        return x * torch.sigmoid(self.spatial(where))
