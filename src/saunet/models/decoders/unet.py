"""The plain skip decoder of Monodepth2 (Godard et al. 2019), the "+UNet" of SAU-Net's Table 3."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from saunet.errors import ConfigError
from saunet.models.decoders.base import by_level, check_scales
from saunet.models.layers.conv import ConvELU, DisparityHead
from saunet.registry import decoders
from saunet.types import FeatureSpec


@decoders.register("unet")
class UNetDecoder(nn.Module):
    """Upsample, join with the skip feature, convolve: Monodepth2's depth decoder for any encoder.

    At each level, coarse to fine: 3×3 convolution, nearest upsampling by 2, concatenation with the encoder's feature of
    that size where it has one, 3×3 convolution; ELU after each and reflection padding before each convolution. A
    3×3 convolution and a sigmoid give the disparity of a scale. With a ResNet's five features this is Monodepth2's
    network layer for layer.

    Args:
        features: The encoder's features, finest first.
        channels: Channels at 1/1, 1/2, 1/4, 1/8, 1/16; an encoder whose deepest stride is 16 uses the first four.
        scales: Scales to predict disparity at, finest first.

    Raises:
        ConfigError: if the features' strides, the channels or the scales cannot work.
    """

    def __init__(
        self,
        features: Sequence[FeatureSpec],
        channels: Sequence[int] = (16, 32, 64, 128, 256),
        scales: Sequence[int] = (0, 1, 2, 3),
    ) -> None:
        super().__init__()
        skips = by_level(features)
        deepest = max(skips)
        if len(channels) < deepest:
            raise ConfigError(
                f"channels is {list(channels)}; the encoder's stride of {2**deepest} needs {deepest} levels"
            )
        self.skip_levels = tuple(skips)
        self.scales = check_scales(scales, deepest)
        before, after, inputs = [], [], skips[deepest]
        for level in range(deepest - 1, -1, -1):
            before.append(ConvELU(inputs, channels[level]))
            after.append(ConvELU(channels[level] + skips.get(level, 0), channels[level]))
            inputs = channels[level]
        self.before = nn.ModuleList(before)
        self.after = nn.ModuleList(after)
        self.heads = nn.ModuleList([DisparityHead(channels[scale]) for scale in self.scales])

    def forward(self, features: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Return sigmoid disparity, b 1 h/2**s w/2**s, for each scale s."""
        skips = dict(zip(self.skip_levels, features, strict=True))
        level = self.skip_levels[-1]
        x = skips[level]
        maps = []
        for before, after in zip(self.before, self.after, strict=True):
            level -= 1
            x = F.interpolate(before(x), scale_factor=2, mode="nearest")
            x = after(torch.cat([x, skips[level]], 1) if level in skips else x)
            if level < len(self.heads):
                maps.append(self.heads[level](x))
        return tuple(reversed(maps))
