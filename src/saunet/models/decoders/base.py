"""What every decoder requires of its encoder and its scales."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from saunet.errors import ConfigError
from saunet.models.layers.conv import upsample
from saunet.types import FeatureSpec


class Decoder(nn.Module):
    """Feature maps, finest first -> sigmoid disparity, b 1 h/2**s w/2**s, for each scale s, finest first.

    Args:
        features: The encoder's features, finest first: strides are powers of two.
        scales: Scales to predict disparity at, finest first, without gaps.
        finest: The level used for scale 0; level l has stride 2**l.

    Attributes:
        skips: Level -> channels of the encoder's feature there.
        deepest: The last of these levels.
    """

    def __init__(self, features: Sequence[FeatureSpec], scales: Sequence[int], finest: int = 0) -> None:
        super().__init__()
        strides = [feature.stride for feature in features]
        powers = all(stride > 0 and stride & (stride - 1) == 0 for stride in strides)
        if not strides or sorted(set(strides)) != strides or not powers or strides[-1] < 2:
            raise ConfigError(
                f"the encoder's features have strides {strides}; a decoder needs ascending powers of two, such as "
                "[2, 4, 8]"
            )
        self.skips = {feature.stride.bit_length() - 1: feature.channels for feature in features}
        self.deepest = max(self.skips)
        self.finest = finest
        self.scales = tuple(scales)
        if self.deepest <= finest:
            least = 2 ** (finest + 1)
            raise ConfigError(f"the encoder's deepest stride is {strides[-1]}; this decoder needs at least {least}")
        levels = list(range(self.deepest - finest))
        if not self.scales or list(self.scales) != levels[: len(self.scales)]:
            reason = f"the encoder's {len(strides)} maps end at stride {strides[-1]}"
            fix = f"set model.decoder.scales=[{','.join(map(str, levels))}]"
            raise ConfigError(f"scales is {list(scales)}; allowed: {levels} or its first entries, as {reason}: {fix}")


class SkipDecoder(Decoder):
    """Per level, coarse to fine: convolve (``before``), enlarge, join with the skip, convolve (``after``), a head."""

    before: nn.ModuleList
    after: nn.ModuleList
    heads: nn.ModuleList

    def enlarge(self, x: Tensor) -> Tensor:
        return upsample(x)

    def level(self, place: int, x: Tensor, skip: Tensor | None) -> Tensor:
        """Return the map of the next finer level; training may recompute it for the gradient."""
        x = self.enlarge(self.before[place](x))
        joined: Tensor = self.after[place](x if skip is None else torch.cat([x, skip], 1))
        return joined

    def forward(self, features: Sequence[Tensor]) -> tuple[Tensor, ...]:
        skips = dict(zip(self.skips, features, strict=True))
        level = self.deepest
        x = skips[level]
        maps = []
        for place in range(len(self.before)):
            level -= 1
            x = self.level(place, x, skips.get(level))
            if level - self.finest < len(self.heads):
                maps.append(self.heads[level - self.finest](x))
        return tuple(reversed(maps))
