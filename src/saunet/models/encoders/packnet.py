"""PackNet's encoder (Guizilini et al., "3D Packing for Self-Supervised Monocular Depth Estimation", CVPR 2020)."""

from __future__ import annotations

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor, nn

from saunet.errors import ConfigError
from saunet.models.layers.packing import GROUPS, ConvNormELU, Packing, ResidualConv, initialize
from saunet.registry import encoders
from saunet.types import FeatureSpec


@encoders.register("packnet")
class PackNetEncoder(nn.Module):
    """Five packing stages, the encoder of PackNet01 (PackNet Table 1): features at 1/1, 1/2, ... 1/32.

    A 5×5 convolution of the unnormalized image at full size, then a block (a 7×7 convolution in the first stage,
    residual blocks after it) and a `Packing` per stage. The features are the packed maps, which PackNet's decoder joins
    as skips. With ``decoder=packnet`` and the defaults the network has 128.3 M parameters; PackNet publishes 128 M.
    (SAU-Net's Table 2 says 118.5.)

    Four fifths of the weights are in the 2-D convolutions after packing, which see 32 times their channels.

    Args:
        channels: Channels of the five stages, multiples of 16.
        blocks: Residual blocks in stages 2 to 5.
    """

    def __init__(self, channels: Sequence[int] = (64, 64, 128, 256, 512), blocks: Sequence[int] = (2, 2, 3, 3)) -> None:
        super().__init__()
        channels, blocks = tuple(channels), tuple(blocks)
        if len(channels) != 5 or len(blocks) != 4 or min(blocks) < 1:
            raise ConfigError(
                f"channels is {channels} and blocks {blocks}; PackNet has five stages, and blocks in the last four"
            )
        if any(c < 1 or c % GROUPS for c in channels):
            raise ConfigError(
                f"channels is {channels}; PackNet normalizes over {GROUPS} groups, so give multiples of {GROUPS}"
            )
        self.stem = ConvNormELU(3, channels[0], kernel=5)
        stages: list[nn.Module] = [ConvNormELU(channels[0], channels[0], kernel=7)]
        for inputs, outputs, depth in zip(channels[:-1], channels[1:], blocks, strict=True):
            stages.append(nn.Sequential(*[ResidualConv(outputs if i else inputs, outputs) for i in range(depth)]))
        self.stages = nn.ModuleList(stages)
        self.packings = nn.ModuleList([Packing(c, kernel=3 if i else 5) for i, c in enumerate(channels)])
        self.features = tuple(FeatureSpec(c, 2**i) for i, c in enumerate((channels[0], *channels)))
        self.size_divisor = 32
        initialize(self)

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> tuple[Tensor, ...]:
        x = self.stem(image)
        features = [x]
        for stage, packing in zip(self.stages, self.packings, strict=True):
            x = packing(stage(x))
            features.append(x)
        return tuple(features)
