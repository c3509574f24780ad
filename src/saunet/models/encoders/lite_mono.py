"""Lite-Mono's encoder (Zhang et al., CVPR 2023): local dilated convolutions, global channel attention."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from saunet.errors import ConfigError, in_range
from saunet.models.layers.conv import DropPath
from saunet.registry import encoders
from saunet.types import FeatureSpec

LAYER_SCALE = 1e-6
"""Initial value of the learned factor on each residual branch."""


@encoders.register("lite_mono")
@encoders.register("lite_mono_small", depths=(4, 4, 7))
@encoders.register("lite_mono_tiny", dims=(32, 64, 128), depths=(4, 4, 7))
@encoders.register("lite_mono_8m", dims=(64, 128, 224))
class LiteMonoEncoder(nn.Module):
    """Lite-Mono's encoder (Lite-Mono section 3.2, Table 1): features at 1/4, 1/8, 1/16.

    A stem of three 3×3 convolutions; before each stage a strided convolution over the concatenation of the previous
    stage's input and output and the average-pooled image; each stage is dilated convolutions (`DilatedBlock`) and one
    `GlobalBlock` at its end. Weights start as in the published code, from He et al.'s normal distribution (fan out).
    With ``decoder=lite_mono`` the network has 3.1 M parameters, as published.

    Args:
        dims: Channels of the three stages.
        depths: Blocks in each stage, including the global block.
        rates: Dilation rates, repeated over a stage's blocks.
        last_rates: Dilation rates of the last dilated blocks of the last stage; if empty, ``rates`` applies.
        heads: Heads of the channel attention.
        expansion: Factor by which the pointwise layers are wider.
        drop_path: Probability of stochastic depth at the last block, growing linearly from 0 at the first.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        dims: Sequence[int] = (48, 80, 128),
        depths: Sequence[int] = (4, 4, 10),
        rates: Sequence[int] = (1, 2, 3),
        last_rates: Sequence[int] = (2, 4, 6),
        heads: int = 8,
        expansion: int = 6,
        drop_path: float = 0.2,
    ) -> None:
        super().__init__()
        dims, depths, rates, last_rates = tuple(dims), tuple(depths), tuple(rates), tuple(last_rates)
        if len(dims) != 3 or len(depths) != 3 or min(depths) < 2:
            raise ConfigError(
                f"dims is {dims} and depths {depths}; Lite-Mono has three stages with at least two blocks each"
            )
        if not rates or min(rates + last_rates) < 1:
            raise ConfigError(
                f"rates is {rates} and last_rates {last_rates}; dilation rates are 1 or more, and rates is not empty"
            )
        in_range("drop_path", drop_path, 0, 0.99)
        self.register_buffer("mean", torch.tensor(0.45), persistent=False)
        self.register_buffer("std", torch.tensor(0.225), persistent=False)
        self.stem = nn.Sequential(
            *(layer for i in range(3) for layer in _conv_norm_gelu(dims[0] if i else 3, dims[0], 1 if i else 2))
        )
        inputs = (dims[0] + 3, 2 * dims[0] + 3, 2 * dims[1] + 3)
        self.reductions = nn.ModuleList(
            [nn.Conv2d(i, dim, 3, stride=2, padding=1, bias=False) for i, dim in zip(inputs, dims, strict=True)]
        )
        drops = iter([drop_path * i / (sum(depths) - 1) for i in range(sum(depths))])
        stages = []
        for stage, (dim, depth) in enumerate(zip(dims, depths, strict=True)):
            dilations = _dilations(depth - 1, rates, last_rates if stage == 2 else ())
            blocks: list[nn.Module] = [DilatedBlock(dim, rate, expansion, next(drops)) for rate in dilations]
            blocks.append(GlobalBlock(dim, heads, expansion, next(drops), position=stage == 0))
            stages.append(nn.Sequential(*blocks))
        self.stages = nn.ModuleList(stages)
        self.features = tuple(FeatureSpec(dim, 4 * 2**i) for i, dim in enumerate(dims))
        self.size_divisor = 16
        for module in self.modules():
            if isinstance(module, nn.Conv2d | nn.Linear):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> tuple[Tensor, ...]:
        pooled = (image - self.mean) / self.std
        parts = [self.stem(pooled)]
        features = []
        for reduce, stage in zip(self.reductions, self.stages, strict=True):
            pooled = F.avg_pool2d(pooled, 3, stride=2, padding=1)
            before = reduce(torch.cat([*parts, pooled], 1))
            after = stage(before)
            parts = [before, after]
            features.append(after)
        return tuple(features)


class DilatedBlock(nn.Module):
    """Dilated depthwise 3×3, then two pointwise layers, added to the input (consecutive dilated convolutions, (2))."""

    def __init__(self, dim: int, rate: int, expansion: int, drop_path: float) -> None:
        super().__init__()
        self.depthwise = nn.Conv2d(dim, dim, 3, padding=rate, dilation=rate, groups=dim, bias=False)
        self.norm = nn.BatchNorm2d(dim)
        self.expand = nn.Linear(dim, expansion * dim)
        self.reduce = nn.Linear(expansion * dim, dim)
        self.scale = nn.Parameter(torch.full((dim,), LAYER_SCALE))
        self.drop_path = DropPath(drop_path)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        if x.device.type == "cpu" and torch.is_autocast_enabled("cpu"):
            # On some processors, torch 2.13.0 and 2.14.1 compute a garbage weight gradient for a dilated depthwise
            # convolution in bfloat16 and channels-last. It is a small part of the work, so it runs in float32.
            with torch.autocast("cpu", enabled=False):
                y = self.depthwise(x.float())
        else:
            y = self.depthwise(x)
        y = self.scale * self.reduce(F.gelu(self.expand(self.norm(y).permute(0, 2, 3, 1))))
        out: Tensor = x + self.drop_path(y.permute(0, 3, 1, 2))
        return out


class GlobalBlock(nn.Module):
    """Cross-covariance attention, then two pointwise layers, added to the input (local-global features, (3)–(5))."""

    def __init__(self, dim: int, heads: int, expansion: int, drop_path: float, position: bool) -> None:
        super().__init__()
        self.position = FourierPosition(dim) if position else None
        self.norm_attention = nn.LayerNorm(dim, eps=1e-6)
        self.attention = CrossCovarianceAttention(dim, heads)
        self.scale_attention = nn.Parameter(torch.full((dim,), LAYER_SCALE))
        self.norm = nn.LayerNorm(dim, eps=1e-6)
        self.expand = nn.Linear(dim, expansion * dim)
        self.reduce = nn.Linear(expansion * dim, dim)
        self.scale = nn.Parameter(torch.full((dim,), LAYER_SCALE))
        self.drop_path = DropPath(drop_path)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        y = x if self.position is None else x + self.position(x)
        tokens = y.permute(0, 2, 3, 1).flatten(1, 2)
        tokens = tokens + self.scale_attention * self.attention(self.norm_attention(tokens))
        tokens = self.scale * self.reduce(F.gelu(self.expand(self.norm(tokens))))
        refined = tokens.unflatten(1, x.shape[-2:]).permute(0, 3, 1, 2)
        out: Tensor = x + self.drop_path(refined)
        return out


class CrossCovarianceAttention(nn.Module):
    """softmax(K̂ᵀQ̂/τ) over channels (El-Nouby et al., XCiT, NeurIPS 2021, eq. (5)), with a learned τ per head.

    Queries and keys are normalized along the pixels, in float32.
    """

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        if heads < 1 or channels % heads:
            raise ConfigError(f"heads is {heads}; it must divide the {channels} channels that it splits")
        self.heads = heads
        self.temperature = nn.Parameter(torch.ones(heads, 1, 1))
        self.qkv = nn.Linear(channels, 3 * channels)
        self.proj = nn.Linear(channels, channels)

    def forward(self, tokens: Float[Tensor, "b n c"]) -> Float[Tensor, "b n c"]:
        qkv = self.qkv(tokens).unflatten(-1, (3, self.heads, -1))  # b n 3 heads c/heads
        query, key, value = qkv.permute(2, 0, 3, 4, 1)  # b heads c/heads n
        query, key = F.normalize(query.float(), dim=-1), F.normalize(key.float(), dim=-1)
        weights = (query @ key.transpose(-1, -2) * self.temperature).softmax(-1)
        mixed = weights.to(value.dtype) @ value
        out: Tensor = self.proj(mixed.flatten(1, 2).transpose(1, 2))
        return out


class FourierPosition(nn.Module):
    """Sines and cosines of the normalized row and column, projected to the channels (XCiT section 3.4, after DETR)."""

    def __init__(self, channels: int, waves: int = 32) -> None:
        super().__init__()
        self.waves = waves
        self.project = nn.Conv2d(2 * waves, channels, 1)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "1 c h w"]:
        height, width = x.shape[-2:]
        # wavelengths 1 to 10000, each for a sine and a cosine
        exponent = torch.arange(self.waves // 2, device=x.device, dtype=torch.float32) * (2 / self.waves)
        frequency = 10000.0**-exponent
        sides = []
        for length in (height, width):
            phase = torch.arange(1, length + 1, device=x.device, dtype=torch.float32) * (2 * math.pi / length)
            angle = phase[:, None] * frequency
            sides.append(torch.stack([angle.sin(), angle.cos()], -1).flatten(1).T)  # sine, cosine, sine, ...
        rows = sides[0][:, :, None].expand(-1, -1, width)
        columns = sides[1][:, None, :].expand(-1, height, -1)
        code: Tensor = self.project(torch.cat([rows, columns])[None].to(x.dtype))
        return code


def _dilations(count: int, rates: tuple[int, ...], last: tuple[int, ...]) -> list[int]:
    """Return ``count`` dilation rates: ``rates`` repeated, with ``last`` at the end."""
    last = last[-count:]
    return [rates[i % len(rates)] for i in range(count - len(last))] + list(last)


def _conv_norm_gelu(inputs: int, outputs: int, stride: int) -> tuple[nn.Module, ...]:
    return nn.Conv2d(inputs, outputs, 3, stride, padding=1, bias=False), nn.BatchNorm2d(outputs), nn.GELU()
