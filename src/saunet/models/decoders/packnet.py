"""PackNet's decoder (Guizilini et al., CVPR 2020): unpacking instead of interpolation."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from saunet.errors import ConfigError
from saunet.models.decoders.base import Decoder
from saunet.models.layers.conv import DisparityHead
from saunet.models.layers.packing import GROUPS, ConvNormELU, Unpacking, initialize
from saunet.registry import decoders
from saunet.types import FeatureSpec

_MIN_DEPTH = 0.5
"""Limit of PackNet's inverse depth, sigmoid / 0.5, which each level passes to the next finer one."""


@decoders.register("packnet")
class PackNetDecoder(Decoder):
    """Unpack, join with the skip and the coarser disparity, convolve (PackNet Table 1, version with concatenation).

    As in the published code, a level passes sigmoid / 0.5 to the next finer one, the heads pad with zeros, and weights
    start from Glorot and Bengio's uniform distribution. Two things differ, as in all decoders of this library: the
    heads' biases start as in `DisparityHead` instead of at 0, and `DepthNet` maps the sigmoid to depth with its own
    limits, while PackNet uses sigmoid / 0.5 as inverse depth.

    Args:
        features: The encoder's features, finest first.
        channels: Channels at 1/1, 1/2, 1/4, 1/8, 1/16, multiples of 32; a deepest stride of 16 needs only four.
        scales: Scales to predict disparity at, finest first.
    """

    def __init__(
        self,
        features: Sequence[FeatureSpec],
        channels: Sequence[int] = (64, 64, 128, 256, 512),
        scales: Sequence[int] = (0, 1, 2, 3),
    ) -> None:
        super().__init__(features, scales)
        if len(channels) < self.deepest or any(c < 1 or c % (2 * GROUPS) for c in channels):
            raise ConfigError(
                f"channels is {list(channels)}; it must be {self.deepest} multiples of {2 * GROUPS}, one per level"
            )
        unpackings, joins, inputs = [], [], self.skips[self.deepest]
        for level in range(self.deepest - 1, -1, -1):
            coarser_disparity = 1 if level + 1 < len(self.scales) else 0
            unpackings.append(Unpacking(inputs, channels[level]))
            joins.append(ConvNormELU(channels[level] + self.skips.get(level, 0) + coarser_disparity, channels[level]))
            inputs = channels[level]
        self.unpackings = nn.ModuleList(unpackings)
        self.joins = nn.ModuleList(joins)
        self.heads = nn.ModuleList([DisparityHead(channels[scale], padding="zeros") for scale in self.scales])
        initialize(self)
        for head in self.heads:
            head.start_bias()  # type: ignore[operator]

    def forward(self, features: Sequence[Tensor]) -> tuple[Tensor, ...]:
        skips = dict(zip(self.skips, features, strict=True))
        level = self.deepest
        x = skips[level]
        maps: list[Tensor] = []
        for unpack, join in zip(self.unpackings, self.joins, strict=True):
            level -= 1
            parts = [unpack(x)]
            if level in skips:
                parts.append(skips[level])
            if maps:
                coarser = F.interpolate(maps[-1] / _MIN_DEPTH, scale_factor=2, mode="nearest")
                parts.append(coarser.to(parts[0].dtype))
            x = join(torch.cat(parts, 1))
            if level < len(self.heads):
                maps.append(self.heads[level](x))
        return tuple(reversed(maps))
