"""Lite-Mono's decoder (Zhang et al., CVPR 2023): Monodepth2's with bilinear upsampling, stopped at half size."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from saunet.errors import ConfigError
from saunet.models.decoders.base import by_level, check_scales
from saunet.models.layers.conv import ConvELU, DisparityHead, upsample
from saunet.registry import decoders
from saunet.types import FeatureSpec


@decoders.register("lite_mono")
class LiteMonoDecoder(nn.Module):
    """Convolve, upsample, join with the skip, convolve, at half of the encoder's channels (Lite-Mono section 3.3).

    The finest features are at half size; a head's logits are enlarged by two before the sigmoid. So there is one scale
    less than in other decoders: three for Lite-Mono's own encoder, as published. Weights start as in the published code
    (truncated normal, 0.02; zero biases), but for the heads' biases: see `DisparityHead`.

    Args:
        features: The encoder's features, finest first.
        scales: Scales to predict disparity at, finest first.

    Raises:
        ConfigError: if the features' strides or the scales cannot work.
    """

    def __init__(self, features: Sequence[FeatureSpec], scales: Sequence[int] = (0, 1, 2)) -> None:
        super().__init__()
        skips = by_level(features)
        deepest = max(skips)
        if deepest < 2:
            raise ConfigError("the encoder's deepest stride is 2; decoder 'lite_mono' needs at least 4")
        self.skip_levels = tuple(skips)
        self.scales = check_scales(scales, deepest - 1)
        before, after, heads = [], [], []
        inputs = channels = skips[deepest]
        for level in range(deepest - 1, 0, -1):
            channels = skips.get(level + 1, channels) // 2
            before.append(ConvELU(inputs, channels))
            after.append(ConvELU(channels + skips.get(level, 0), channels))
            if level <= len(self.scales):
                heads.append(DisparityHead(channels, enlarge=2))
            inputs = channels
        self.before = nn.ModuleList(before)
        self.after = nn.ModuleList(after)
        self.heads = nn.ModuleList(reversed(heads))
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.trunc_normal_(module.weight, std=0.02)
        for block in (*before, *after):
            nn.init.zeros_(block[0].bias)  # type: ignore[arg-type]

    def forward(self, features: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Return sigmoid disparity, b 1 h/2**s w/2**s, for each scale s."""
        skips = dict(zip(self.skip_levels, features, strict=True))
        level = self.skip_levels[-1]
        x = skips[level]
        maps = []
        for before, after in zip(self.before, self.after, strict=True):
            level -= 1
            x = upsample(before(x))
            x = after(torch.cat([x, skips[level]], 1) if level in skips else x)
            if level <= len(self.heads):
                maps.append(self.heads[level - 1](x))
        return tuple(reversed(maps))
