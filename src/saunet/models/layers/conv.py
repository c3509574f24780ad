"""Layers shared by several networks: reflection-padded 3×3, upsampling, the disparity head, stochastic depth."""

from __future__ import annotations

import math
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from saunet.errors import ConfigError

START = 0.3
"""Average sigmoid disparity predicted by an untrained `DisparityHead`."""


class Conv3x3(nn.Conv2d):
    """3×3 convolution with one pixel of reflection padding, as in Monodepth2's decoder: no border artifacts."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs, 3)

    def forward(self, x: Float[Tensor, "b ci h w"]) -> Float[Tensor, "b co h w"]:
        mode = "reflect" if min(x.shape[-2:]) > 1 else "replicate"  # a single pixel has nothing to reflect
        # Autocast on a CPU would pad in float32, and the convolution cast it back: two needless copies of the map.
        with torch.autocast(device_type=x.device.type, enabled=False):
            padded = F.pad(x, (1, 1, 1, 1), mode=mode)
        return F.conv2d(padded, self.weight, self.bias)


class ConvELU(nn.Sequential):
    """Reflection-padded 3×3 convolution and ELU, Monodepth2's decoder block."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(Conv3x3(inputs, outputs), nn.ELU(inplace=True))


class DisparityHead(nn.Module):
    """Sigmoid disparity in (0, 1) from a feature map: a 3×3 convolution and the logistic function.

    The bias starts at logit(0.3) instead of 0. With the usual limits of 0.1 and 100, an untrained network then predicts
    a depth of a third of a unit, three times the nearest depth: there is room on both sides, and networks trained from
    video settle about there. Logit 0 would be only twice the nearest depth, and most of a road scene is farther away.

    With ``enlarge``, the logits are upsampled by that factor.
    """

    def __init__(self, inputs: int, enlarge: int = 1, padding: Literal["reflect", "zeros"] = "reflect") -> None:
        super().__init__()
        self.enlarge = enlarge
        self.conv = Conv3x3(inputs, 1) if padding == "reflect" else nn.Conv2d(inputs, 1, 3, padding=1)
        self.start_bias()

    def start_bias(self) -> None:
        nn.init.constant_(self.conv.bias, math.log(START / (1 - START)))  # type: ignore[arg-type]

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b 1 _ _"]:
        # Outside autocast: a logit of bfloat16 near -4, a far pixel, would round depth to about two percent.
        with torch.autocast(device_type=x.device.type, enabled=False):
            logits: Tensor = self.conv(x.to(self.conv.weight.dtype))
            return (upsample(logits, self.enlarge) if self.enlarge > 1 else logits).sigmoid()


class DropPath(nn.Module):
    """Stochastic depth (Huang et al. 2016): drop a residual branch for a whole sample in training, keeping the mean."""

    def __init__(self, rate: float = 0.0) -> None:
        super().__init__()
        if not 0 <= rate < 1:
            raise ConfigError(f"drop_path is {rate}; it must be at least 0 and less than 1")
        self.rate = rate

    def forward(self, x: Float[Tensor, "b ..."]) -> Float[Tensor, "b ..."]:
        if not self.training or self.rate == 0:
            return x
        keep = 1 - self.rate
        kept = torch.bernoulli(torch.full((x.shape[0], *[1] * (x.ndim - 1)), keep, device=x.device, dtype=x.dtype))
        return x * kept / keep


def upsample(x: Float[Tensor, "b c h w"], factor: int = 2) -> Float[Tensor, "b c _ _"]:
    """Enlarge bilinearly; a pixel covers its area (``align_corners=False``), as in resizing images."""
    return F.interpolate(x, scale_factor=factor, mode="bilinear", align_corners=False)


def sum_of(fresh: Float[Tensor, "b c h w"], x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
    """Return ``fresh + x``, in place in ``fresh`` (which nothing else uses) if no gradient is needed.

    New memory for a large map costs more than the sum. With gradients, the layer's map is left intact for hooks that
    look at it.
    """
    if torch.is_grad_enabled() or fresh.dtype != x.dtype:
        return fresh + x
    return fresh.add_(x)


def lay_out(network: nn.Module, memory_format: torch.memory_format = torch.channels_last) -> None:
    """Store the weights of 2-D convolutions in a memory format, so that no forward pass has to reorder them.

    The network gives its input the same format, ``network.memory_format``.
    """
    network.memory_format = memory_format  # type: ignore[assignment]
    for parameter in network.parameters():
        if parameter.ndim == 4:  # 3-D convolutions have their own such format, which gains nothing here
            # a 1x1 kernel counts as contiguous in both formats, but its strides still decide the output's format
            parameter.data = torch.empty_like(parameter, memory_format=memory_format).copy_(parameter.data)


def training_format(network: nn.Module, device: torch.device) -> torch.memory_format:
    """Return the memory format in which a network's convolutions train fastest on a device.

    Without AVX-512 oneDNN (torch 2.13) has no fast gradient of dense kernels for channels-last maps: that of a 3x3
    convolution of 64 channels takes 1.8 times as long as for contiguous maps, ResNet-18's whole step 1.28 times.
    Pointwise and depthwise convolutions are nevertheless faster channels-last (EfficientNet-Lite0's step: 0.8).
    """
    if device.type != "cpu" or torch.backends.cpu.get_cpu_capability() != "AVX2":
        return torch.channels_last
    convolutions = [module for module in network.modules() if isinstance(module, nn.Conv2d)]
    dense = [each for each in convolutions if each.groups == 1 and max(each.kernel_size) > 1]
    mostly = sum(each.weight.numel() for each in dense) > 0.5 * sum(each.weight.numel() for each in convolutions)
    return torch.contiguous_format if mostly else torch.channels_last
