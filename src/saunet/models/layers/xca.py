"""Cross-covariance attention: channels attend to channels, so the cost is linear in the number of pixels."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from saunet.errors import ConfigError


class CrossCovarianceAttention(nn.Module):
    """softmax(K̂ᵀQ̂/τ) over channels (El-Nouby et al., XCiT, NeurIPS 2021, eq. (5)), with a learnt τ per head.

    Queries and keys are normalized along the pixels, in float32.
    """

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        if heads < 1 or channels % heads:
            raise ConfigError(f"heads is {heads}; it must divide the {channels} channels that it splits")
        self.heads = heads
        self.temperature = nn.Parameter(torch.ones(heads, 1, 1))
        self.qkv = nn.Linear(channels, 3 * channels)
        self.proj = nn.Linear(channels, channels)

    def forward(self, tokens: Float[Tensor, "b n c"]) -> Float[Tensor, "b n c"]:
        """Return each pixel's channels mixed by the attention among channels."""
        qkv = self.qkv(tokens).unflatten(-1, (3, self.heads, -1))  # b n 3 heads c/heads
        query, key, value = qkv.permute(2, 0, 3, 4, 1)  # b heads c/heads n
        query, key = F.normalize(query.float(), dim=-1), F.normalize(key.float(), dim=-1)
        weights = (query @ key.transpose(-1, -2) * self.temperature).softmax(-1)
        mixed = weights.to(value.dtype) @ value
        out: Tensor = self.proj(mixed.flatten(1, 2).transpose(1, 2))
        return out


class FourierPosition(nn.Module):
    """Sines and cosines of the normalized row and column, projected to the channels (XCiT section 3.4, after DETR)."""

    def __init__(self, channels: int, waves: int = 32) -> None:
        super().__init__()
        self.waves = waves
        self.project = nn.Conv2d(2 * waves, channels, 1)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "1 c h w"]:
        """Return the position code for a map of the size of ``x``."""
        height, width = x.shape[-2:]
        # wavelengths 1 to 10000, each for a sine and a cosine
        exponent = torch.arange(self.waves // 2, device=x.device, dtype=torch.float32) * (2 / self.waves)
        frequency = 10000.0**-exponent
        sides = []
        for length in (height, width):
            phase = torch.arange(1, length + 1, device=x.device, dtype=torch.float32) * (2 * math.pi / length)
            angle = phase[:, None] * frequency
            sides.append(torch.stack([angle.sin(), angle.cos()], -1).flatten(1).T)  # sine, cosine, sine, ...
        rows = sides[0][:, :, None].expand(-1, -1, width)
        columns = sides[1][:, None, :].expand(-1, height, -1)
        code: Tensor = self.project(torch.cat([rows, columns])[None].to(x.dtype))
        return code
