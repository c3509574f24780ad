"""The 3x3 mean with reflection padding under SSIM, and its derivative, fast on every device."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor


def box_mean(x: Float[Tensor, "*b h w"]) -> Float[Tensor, "*b h w"]:
    """3x3 mean with reflection padding over the last two dimensions (each at least 2)."""
    if x.device.type == "cpu":
        # Pooling is a scalar loop on CPUs, and the largest part of a training step's loss; shifted sums are vectorized.
        mean: Tensor = _ShiftedSums.apply(x)  # type: ignore[no-untyped-call]
        return mean
    flat = F.pad(x.reshape(-1, 1, *x.shape[-2:]), (1, 1, 1, 1), mode="reflect")
    return F.avg_pool2d(flat, 3, stride=1).reshape(x.shape)


class _ShiftedSums(torch.autograd.Function):
    """The mean as sums of shifted copies; written out because the derivative of a slice is a full-size copy."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        return _sum_of_three(_sum_of_three(x, -1), -2).div_(9)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        return _sum_of_three(_sum_of_three(grad, -2, adjoint=True), -1, adjoint=True) / 9


def _sum_of_three(x: Tensor, dim: int, adjoint: bool = False) -> Tensor:
    """Sum each element with its two neighbors; the first counts the second twice, and likewise at the end."""
    size = x.shape[dim]
    total = x.clone(memory_format=torch.contiguous_format)
    total.narrow(dim, 1, size - 1).add_(x.narrow(dim, 0, size - 1))
    total.narrow(dim, 0, size - 1).add_(x.narrow(dim, 1, size - 1))
    to_first, from_first = (1, 0) if adjoint else (0, 1)
    total.select(dim, to_first).add_(x.select(dim, from_first))
    total.select(dim, -1 - to_first).add_(x.select(dim, -1 - from_first))
    return total
