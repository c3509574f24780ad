"""PackNet's blocks: folding space into channels and back with 3-D convolutions, instead of strides."""

from __future__ import annotations

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

GROUPS = 16
"""Groups of every group normalization in PackNet."""
FOLDS = 8
"""Channels D of the 3-D convolution, PackNet section 3.1."""


class ConvNormELU(nn.Module):
    """2-D convolution, group normalization over 16 groups, ELU."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 3) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, kernel, padding=kernel // 2)
        self.norm = nn.GroupNorm(GROUPS, outputs)

    def forward(self, x: Float[Tensor, "b ci h w"]) -> Float[Tensor, "b co h w"]:
        return F.elu(self.norm(self.conv(x)), inplace=True)


class ResidualConv(nn.Module):
    """Two 3×3 convolutions beside a 1×1, summed, normalized and activated: PackNet's residual block."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.conv1 = ConvNormELU(inputs, outputs)
        self.conv2 = ConvNormELU(outputs, outputs)
        self.shortcut = nn.Conv2d(inputs, outputs, 1)
        self.norm = nn.GroupNorm(GROUPS, outputs)

    def forward(self, x: Float[Tensor, "b ci h w"]) -> Float[Tensor, "b co h w"]:
        return F.elu(self.norm(self.conv2(self.conv1(x)) + self.shortcut(x)), inplace=True)


class Packing(nn.Module):
    """Halve a map, losing no pixel (PackNet section 3.1, fig. 3a): fold 2×2 into channels, 3-D, 2-D convolution."""

    def __init__(self, channels: int, kernel: int = 3) -> None:
        super().__init__()
        self.expand = nn.Conv3d(1, FOLDS, 3, padding=1)
        self.reduce = ConvNormELU(4 * channels * FOLDS, channels, kernel)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c _ _"]:
        folded = F.pixel_unshuffle(x, 2)
        packed: Tensor = self.reduce(self.expand(folded[:, None]).flatten(1, 2))
        return packed


class Unpacking(nn.Module):
    """Double a map (PackNet section 3.1, fig. 3b): 2-D then 3-D convolution, unfold channels into 2×2 pixels."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.reduce = ConvNormELU(inputs, 4 * outputs // FOLDS)
        self.expand = nn.Conv3d(1, FOLDS, 3, padding=1)

    def forward(self, x: Float[Tensor, "b ci h w"]) -> Float[Tensor, "b co _ _"]:
        return F.pixel_shuffle(self.expand(self.reduce(x)[:, None]).flatten(1, 2), 2)


def initialize(network: nn.Module) -> None:
    """Initialize convolutions with Glorot and Bengio's uniform distribution and zero biases, as PackNet was trained."""
    for module in network.modules():
        if isinstance(module, nn.Conv2d | nn.Conv3d):
            nn.init.xavier_uniform_(module.weight)
            if module.bias is not None:
                nn.init.zeros_(module.bias)
