"""ResNet encoders (He et al. 2016) with torchvision's parameter names, for one image or several stacked frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from saunet.errors import ConfigError, one_of, positive
from saunet.models.encoders.base import StemEncoder
from saunet.models.pretrained import load_pretrained
from saunet.registry import encoders
from saunet.types import FeatureSpec

_WIDTHS = (64, 128, 256, 512)
Normalization = Literal["monodepth2", "imagenet"]
_STATISTICS = {
    "monodepth2": ((0.45,), (0.225,)),
    "imagenet": ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)),
}
"""Mean and standard deviation, for all channels or for each."""


class BasicBlock(nn.Module):
    """Two 3×3 convolutions with a shortcut, the block of ResNet-18 and 34 (He et al. 2016, fig. 5 left)."""

    expansion = 1

    def __init__(self, inputs: int, width: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, width, 3, stride, padding=1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.downsample = _shortcut(inputs, width, stride)

    def forward(self, x: Float[Tensor, "b ci h w"]) -> Float[Tensor, "b co _ _"]:
        shortcut = x if self.downsample is None else self.downsample(x)
        x = F.relu(self.bn1(self.conv1(x)), inplace=True)
        x = self.bn2(self.conv2(x))
        return F.relu(x.add_(shortcut), inplace=True)


class Bottleneck(nn.Module):
    """1×1, 3×3, 1×1 convolutions with a shortcut, the block of ResNet-50 and up; it strides in the 3×3."""

    expansion = 4

    def __init__(self, inputs: int, width: int, stride: int) -> None:
        super().__init__()
        outputs = width * self.expansion
        self.conv1 = nn.Conv2d(inputs, width, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, stride, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, outputs, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(outputs)
        self.downsample = _shortcut(inputs, outputs, stride)

    def forward(self, x: Float[Tensor, "b ci h w"]) -> Float[Tensor, "b co _ _"]:
        shortcut = x if self.downsample is None else self.downsample(x)
        x = F.relu(self.bn1(self.conv1(x)), inplace=True)
        x = F.relu(self.bn2(self.conv2(x)), inplace=True)
        x = self.bn3(self.conv3(x))
        return F.relu(x.add_(shortcut), inplace=True)


@encoders.register("resnet18", blocks=(2, 2, 2, 2))
@encoders.register("resnet34", blocks=(3, 4, 6, 3))
@encoders.register("resnet50", blocks=(3, 4, 6, 3), bottleneck=True)
@encoders.register("resnet101", blocks=(3, 4, 23, 3), bottleneck=True)
class ResNet(StemEncoder):
    """ResNet features at 1/2, 1/4, 1/8, 1/16, 1/32, the encoder of Monodepth2 (SAU-Net Table 3, first row).

    State-dict keys are torchvision's without ``fc``. Images in [0, 1] are normalized: with 0.45 and 0.225 for all
    channels as in Monodepth2, or per channel as in torchvision. The first feature follows the first ReLU, before the
    max-pooling.

    Args:
        blocks: Residual blocks in each of the four stages.
        bottleneck: Bottleneck blocks (ResNet-50 and up) instead of basic ones.
        frames: RGB images stacked in the channels of the input: 1 for depth, 2 or 3 for pose.
        weights: Public weights to start from: ``imagenet``, a name, a URL or a file; see `load_pretrained`.
        normalization: Mean and deviation of images: ``monodepth2`` (0.45 and 0.225) or ``imagenet``.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        blocks: Sequence[int] = (2, 2, 2, 2),
        bottleneck: bool = False,
        frames: int = 1,
        weights: str | None = None,
        normalization: Normalization = "monodepth2",
    ) -> None:
        super().__init__()
        blocks = tuple(blocks)
        if len(blocks) != 4 or min(blocks) < 1:
            raise ConfigError(
                f"blocks is {blocks}; a ResNet has four stages with at least one block each, such as (2, 2, 2, 2)"
            )
        positive("frames", frames)
        kind: type[BasicBlock] | type[Bottleneck] = Bottleneck if bottleneck else BasicBlock
        self.frames = frames
        self.variant = f"resnet{sum(blocks) * (3 if bottleneck else 2) + 2}"
        mean, std = _STATISTICS[one_of("normalization", normalization, tuple(_STATISTICS))]
        self.register_buffer("mean", _per_channel(mean, frames), persistent=False)
        self.register_buffer("std", _per_channel(std, frames), persistent=False)

        self.conv1 = nn.Conv2d(3 * frames, 64, 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.maxpool = nn.MaxPool2d(3, stride=2, padding=1)
        inputs, stages = 64, []
        for stage, (width, depth) in enumerate(zip(_WIDTHS, blocks, strict=True)):
            layers = []
            for block in range(depth):
                layers.append(kind(inputs, width, stride=2 if block == 0 and stage > 0 else 1))
                inputs = width * kind.expansion
            stages.append(nn.Sequential(*layers))
        self.layer1, self.layer2, self.layer3, self.layer4 = stages

        outputs = (64, *(width * kind.expansion for width in _WIDTHS))
        self.features = tuple(FeatureSpec(channels, 2 ** (i + 1)) for i, channels in enumerate(outputs))
        self.size_divisor = 32
        for module in self.modules():  # He et al.'s normal distribution (fan-out), as in torchvision
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
        if weights is not None:
            load_pretrained(self, weights)

    def begin(self, image: Float[Tensor, "b c h w"]) -> tuple[Tensor, Tensor]:
        x = F.relu(self.bn1(self.conv1((image - self.mean) / self.std)), inplace=True)
        return x, self.maxpool(x)

    def forward(self, image: Float[Tensor, "b c h w"]) -> tuple[Tensor, ...]:
        feature, x = self.begin(image)
        features = [feature]
        for stage in (self.layer1, self.layer2, self.layer3, self.layer4):
            x = stage(x)
            features.append(x)
        return tuple(features)


def _per_channel(values: tuple[float, ...], frames: int) -> Tensor:
    return torch.tensor(values[0]) if len(values) == 1 else torch.tensor(values * frames)[:, None, None]


def _shortcut(inputs: int, outputs: int, stride: int) -> nn.Sequential | None:
    if stride == 1 and inputs == outputs:
        return None
    return nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs))
