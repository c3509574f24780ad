"""AU-Net, the decoder of SAU-Net: features of all scales in one space, summed, with attention on the smallest."""

from __future__ import annotations

from collections.abc import Sequence

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from saunet.errors import positive
from saunet.models.decoders.base import Decoder
from saunet.models.layers.conv import DisparityHead, sum_of, upsample
from saunet.registry import attentions, decoders
from saunet.types import FeatureSpec


@decoders.register("aunet")
class AUNetDecoder(Decoder):
    """AU-Net (SAU-Net section III-C, eq. (5), fig. 3): project, add the upsampled deeper map, refine, enlarge.

    - *Projection*: a 1×1 convolution brings each feature f_k to a common width ("projected onto the same dimensional
      space"), so that features join by addition instead of concatenation.
    - *Bottleneck* (`AttentionBottleneck`), at the deepest level only: "the size of the feature map is reduced to half,
      crucial features are captured through the attention mechanism, and a 2× upsampling restores the size".
    - *Sum*, eq. (5): x_s = Σ_{k≤s} (f_k)↑, kept as a running sum, bilinearly doubled from level to level.
    - *Mapping* (`Mapping`), at every level: added to its input, so that the plain sum of eq. (5) is passed up.
    - *Heads*: 3×3 convolution and sigmoid at 1/1, 1/2, 1/4, 1/8.

    Full resolution has three times the pixels of all other levels together but no feature of its own, so it is narrower
    (``fine``).

    Args:
        features: The encoder's features, finest first.
        width: The common width of all levels but the full-size one.
        fine: Width at full resolution.
        attention: Name of a registered attention: ``eca``, ``se``, ``gct``, ``cbam`` or ``none``.
        scales: Scales to predict disparity at, finest first.
    """

    def __init__(
        self,
        features: Sequence[FeatureSpec],
        width: int = 64,
        fine: int = 16,
        attention: str = "eca",
        scales: Sequence[int] = (0, 1, 2, 3),
    ) -> None:
        positive("width", width)
        positive("fine", fine)
        super().__init__(features, scales)
        widths = [fine] + [width] * self.deepest
        projections = [nn.Conv2d(channels, widths[level], 1) for level, channels in self.skips.items()]
        self.projections = nn.ModuleList(projections)
        self.bottleneck = AttentionBottleneck(width, attention)
        self.narrow = nn.Conv2d(width, fine, 1)
        self.mappings = nn.ModuleList([Mapping(channels) for channels in widths])
        self.heads = nn.ModuleList([DisparityHead(widths[scale]) for scale in self.scales])

    def forward(self, features: Sequence[Tensor]) -> tuple[Tensor, ...]:
        projected = {
            level: project(feature)
            for level, project, feature in zip(self.skips, self.projections, features, strict=True)
        }
        x = self.mappings[self.deepest](self.bottleneck(projected[self.deepest]))
        maps = []
        for level in range(self.deepest - 1, -1, -1):
            # a 1×1 convolution and upsampling commute: narrowing first is cheaper
            x = upsample(self.narrow(x) if level == 0 else x)
            if level in projected:
                x = sum_of(x, projected[level])
            x = self.mappings[level](x)
            if level < len(self.heads):
                maps.append(self.heads[level](x))
        return tuple(reversed(maps))


class AttentionBottleneck(nn.Module):
    """Halve the map, attend, restore the size, and join with the input (SAU-Net section III-C, its first layer)."""

    def __init__(self, channels: int, attention: str) -> None:
        super().__init__()
        self.reduce = nn.Conv2d(channels, channels, 3, stride=2, padding=1)
        self.attention: nn.Module = attentions.build(attention, channels=channels)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        key = self.attention(F.relu(self.reduce(x), inplace=True))
        return x + F.interpolate(key, size=x.shape[-2:], mode="bilinear", align_corners=False)


class Mapping(nn.Module):
    """3×3 convolution, ReLU and 1×1 convolution, added to the input (SAU-Net's feature mapping module).

    Padded with zeros, not by reflection: a window encoder does not know its position in the image, and the zero border
    tells the decoder; on a road, the height in the image says much about depth.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.spatial = nn.Conv2d(channels, channels, 3, padding=1)
        self.mix = nn.Conv2d(channels, channels, 1)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        refined: Tensor = self.mix(F.relu(self.spatial(x), inplace=True))
        return sum_of(refined, x)
