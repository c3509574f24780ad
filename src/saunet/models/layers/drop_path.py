"""Stochastic depth (Huang et al. 2016)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from saunet.errors import ConfigError


class DropPath(nn.Module):
    """Stochastic depth: drop a residual branch for a whole sample in training, scaled so that the mean is kept."""

    def __init__(self, rate: float = 0.0) -> None:
        super().__init__()
        if not 0 <= rate < 1:
            raise ConfigError(f"drop_path is {rate}; it must be at least 0 and less than 1")
        self.rate = rate

    def forward(self, x: Float[Tensor, "b ..."]) -> Float[Tensor, "b ..."]:
        """Drop or scale each sample of ``x``; the identity in evaluation."""
        if not self.training or self.rate == 0:
            return x
        keep = 1 - self.rate
        kept = torch.bernoulli(torch.full((x.shape[0], *[1] * (x.ndim - 1)), keep, device=x.device, dtype=x.dtype))
        return x * kept / keep
