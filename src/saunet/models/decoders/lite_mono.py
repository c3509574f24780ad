"""Lite-Mono's decoder (Zhang et al., CVPR 2023): Monodepth2's with bilinear upsampling, stopped at half size."""

from __future__ import annotations

from collections.abc import Sequence

from torch import nn

from saunet.models.decoders.base import SkipDecoder
from saunet.models.layers.conv import ConvELU, DisparityHead
from saunet.registry import decoders
from saunet.types import FeatureSpec


@decoders.register("lite_mono")
class LiteMonoDecoder(SkipDecoder):
    """Convolve, upsample, join with the skip, convolve, at half of the encoder's channels (Lite-Mono section 3.3).

    The finest features are at half size, and a head's logits are enlarged by two before the sigmoid. So there is one
    scale fewer than in other decoders: three for Lite-Mono's own encoder, as published. Weights start as in the
    published code (truncated normal, 0.02; zero biases), except for the heads' biases: see `DisparityHead`.

    Args:
        features: The encoder's features, finest first.
        scales: Scales to predict disparity at, finest first.
    """

    def __init__(self, features: Sequence[FeatureSpec], scales: Sequence[int] = (0, 1, 2)) -> None:
        super().__init__(features, scales, finest=1)
        before, after, heads = [], [], []
        inputs = channels = self.skips[self.deepest]
        for level in range(self.deepest - 1, 0, -1):
            channels = self.skips.get(level + 1, channels) // 2
            before.append(ConvELU(inputs, channels))
            after.append(ConvELU(channels + self.skips.get(level, 0), channels))
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
