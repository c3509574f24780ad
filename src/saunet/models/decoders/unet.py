"""The plain skip decoder of Monodepth2 (Godard et al. 2019), the "+UNet" of SAU-Net's Table 3."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch.nn.functional as F
from torch import Tensor, nn

from saunet.errors import ConfigError, one_of
from saunet.models.decoders.base import SkipDecoder
from saunet.models.layers.conv import ConvELU, DisparityHead, upsample
from saunet.registry import decoders
from saunet.types import FeatureSpec


@decoders.register("unet")
@decoders.register("unet_narrow", channels=(16, 24, 40, 80, 128))
class UNetDecoder(SkipDecoder):
    """Upsample, join with the skip feature, convolve: Monodepth2's depth decoder for any encoder.

    At each level, coarse to fine: 3×3 convolution, nearest upsampling by 2, concatenation with the encoder's feature of
    that size if there is one, 3×3 convolution; ELU after each and reflection padding before each convolution. A 3×3
    convolution and a sigmoid give the disparity of a scale. With a ResNet's five features this is Monodepth2's network
    layer for layer.

    Args:
        features: The encoder's features, finest first.
        channels: Channels at 1/1, 1/2, 1/4, 1/8, 1/16; an encoder whose deepest stride is 16 uses the first four.
        scales: Scales to predict disparity at, finest first.
        upsampling: How maps are enlarged: ``nearest`` as in Monodepth2, or ``bilinear`` as in SC-Depth.
    """

    def __init__(
        self,
        features: Sequence[FeatureSpec],
        channels: Sequence[int] = (16, 32, 64, 128, 256),
        scales: Sequence[int] = (0, 1, 2, 3),
        upsampling: Literal["nearest", "bilinear"] = "nearest",
    ) -> None:
        super().__init__(features, scales)
        self.upsampling = one_of("upsampling", upsampling, ("nearest", "bilinear"))
        if len(channels) < self.deepest:
            stride = 2**self.deepest
            raise ConfigError(
                f"channels is {list(channels)}; the encoder's stride of {stride} needs {self.deepest} numbers, one "
                "per level"
            )
        before, after, inputs = [], [], self.skips[self.deepest]
        for level in range(self.deepest - 1, -1, -1):
            before.append(ConvELU(inputs, channels[level]))
            after.append(ConvELU(channels[level] + self.skips.get(level, 0), channels[level]))
            inputs = channels[level]
        self.before = nn.ModuleList(before)
        self.after = nn.ModuleList(after)
        self.heads = nn.ModuleList([DisparityHead(channels[scale]) for scale in self.scales])

    def enlarge(self, x: Tensor) -> Tensor:
        return upsample(x) if self.upsampling == "bilinear" else F.interpolate(x, scale_factor=2, mode="nearest")
