"""The maths of the losses, as pure functions on tensors: float32 inside autocast, float64 where given, no host sync."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from saunet.errors import one_of
from saunet.geometry import full_precision

_C1, _C2 = 0.01**2, 0.03**2


@full_precision
def ssim_loss(prediction: Float[Tensor, "*b c h w"], target: Float[Tensor, "*#b c h w"]) -> Float[Tensor, "*b c h w"]:
    """Structural dissimilarity (1 - SSIM) / 2 in [0, 1], the first part of SAU-Net eq. (8), per channel.

    A 3x3 box window with reflection padding, as usual in this field; a Gaussian window gives other values.

    Args:
        prediction: Images in [0, 1].
        target: The expected images; broadcast over the leading dimensions.

    Returns:
        One map per channel.

    Examples:
        >>> image = torch.rand(1, 3, 8, 8)
        >>> float(saunet.ssim_loss(image, image).max())
        0.0
        >>> saunet.ssim_loss(image, 1 - image).shape
        torch.Size([1, 3, 8, 8])
    """
    mean_p, mean_t = box_mean(prediction), box_mean(target)
    means, squares = mean_p * mean_t, mean_p * mean_p + mean_t * mean_t
    covariance = box_mean(prediction * target) - means
    variances = box_mean(prediction * prediction + target * target) - squares  # their sum: SSIM needs no more
    similarity = (2 * means + _C1) * (2 * covariance + _C2) / ((squares + _C1) * (variances + _C2))
    return (0.5 - 0.5 * similarity).clamp(0, 1)


@full_precision
def photometric_error(
    prediction: Float[Tensor, "*b c h w"], target: Float[Tensor, "*#b c h w"], ssim_weight: float = 0.85
) -> Float[Tensor, "*b 1 h w"]:
    """Photometric error pe = w (1 - SSIM) / 2 + (1 - w) |difference|, SAU-Net eqs. (8) and (9), mean over channels.

    Args:
        prediction: Images in [0, 1].
        target: The expected images; broadcast over the leading dimensions.
        ssim_weight: w, the weight of the structural part; 0 leaves it out.

    Returns:
        One map per image.

    Examples:
        >>> black, white = torch.zeros(1, 3, 4, 4), torch.ones(1, 3, 4, 4)
        >>> error = saunet.photometric_error(black, white, ssim_weight=0.0)
        >>> error.shape, float(error.mean())
        (torch.Size([1, 1, 4, 4]), 1.0)
    """
    error = (1 - ssim_weight) * (prediction - target).abs().mean(-3, keepdim=True)
    if ssim_weight == 0:
        return error
    return error + ssim_weight * ssim_loss(prediction, target).mean(-3, keepdim=True)


@full_precision
def combine_sources(
    errors: Float[Tensor, "b s 1 h w"], valid: Bool[Tensor, "b s 1 h w"] | None = None, sources: str = "minimum"
) -> tuple[Float[Tensor, "b 1 h w"], Bool[Tensor, "b 1 h w"]]:
    """One error per pixel from one per source: the minimum of SAU-Net eq. (10), or the mean.

    Args:
        errors: Photometric error of each source.
        valid: Where a source counts; None for everywhere. A source that does not count never wins the minimum.
        sources: ``minimum`` or ``mean``.

    Returns:
        The error, 0 where no source counts, and where at least one does.

    Raises:
        ConfigError: for any other ``sources``.

    Examples:
        >>> errors = torch.tensor([0.3, 0.1]).view(1, 2, 1, 1, 1)  # two sources, one pixel
        >>> saunet.combine_sources(errors)[0].item() == errors.min().item()
        True
        >>> valid = torch.tensor([True, False]).view(1, 2, 1, 1, 1)
        >>> saunet.combine_sources(errors, valid)[0]
        tensor([[[[0.3000]]]])
    """
    one_of("sources", sources, ("minimum", "mean"))
    if valid is None:
        valid = torch.ones_like(errors, dtype=torch.bool)
    known = valid.any(1)
    if sources == "mean":
        return torch.where(valid, errors, 0.0).sum(1) / valid.sum(1).clamp(min=1), known
    best = torch.where(valid, errors, torch.inf).min(1).values
    return torch.where(known, best, 0.0), known


@full_precision
def automask(
    error: Float[Tensor, "b 1 h w"], identity: Float[Tensor, "b 1 h w"], noise: float = 0.0
) -> Bool[Tensor, "b 1 h w"]:
    """Pixels that the loss uses: warping explains them better than no motion, SAU-Net eq. (11) with its sign corrected.

    The paper prints the comparison reversed, which would keep static pixels; this one is Monodepth2's.

    Args:
        error: Error of the warped sources.
        identity: Error of the unwarped sources.
        noise: Standard deviation of the noise that decides ties; with 0 a tie is masked.

    Returns:
        The mask mu.

    Examples:
        >>> warped, unwarped = torch.full((1, 1, 1, 2), 0.2), torch.tensor([[[[0.5, 0.1]]]])
        >>> saunet.automask(warped, unwarped)
        tensor([[[[ True, False]]]])
    """
    if noise > 0:
        identity = identity + noise * torch.randn_like(identity)
    return error < identity


@full_precision
def masked_mean(
    values: Float[Tensor, " b *n"], mask: Bool[Tensor, " b *#n"] | Float[Tensor, " b *#n"]
) -> Float[Tensor, ""]:
    """Mean over the images of each image's ``sum(values * mask) / max(sum(mask), 1)``; 0 with a graph for empty masks.

    Each image has the same weight whatever its mask keeps, so the loss does not depend on how a batch is split over
    processes or passes. Values may be anything, even NaN, where the mask is 0.
    """
    mask = mask.expand_as(values).flatten(1)
    values = values.flatten(1)
    totals = torch.where(mask != 0, values, 0.0).mul(mask).sum(1)
    return (totals / mask.sum(1).clamp(min=1)).mean()


@full_precision
def smoothness_loss(disparity: Float[Tensor, "b 1 h w"], image: Float[Tensor, "b c h w"]) -> Float[Tensor, ""]:
    """Edge-aware smoothness of the mean-normalized disparity (Monodepth2 eq. (3)).

    Args:
        disparity: Disparity at any scale of the values.
        image: The image at the same size; the disparity may have edges where it has.

    Returns:
        Mean over horizontal plus mean over vertical neighbor pairs.

    Examples:
        >>> flat, image = torch.ones(1, 1, 4, 4), torch.rand(1, 3, 4, 4)
        >>> saunet.smoothness_loss(flat, image)
        tensor(0.)
    """
    normalized = disparity / (disparity.mean((2, 3), keepdim=True) + 1e-7)
    total = image.new_zeros(())
    for step, edge in zip(forward_differences(normalized), forward_differences(image), strict=True):
        total = total + (step.abs() * torch.exp(-edge.abs().mean(1, keepdim=True))).mean()
    return total


@full_precision
def forward_differences(x: Float[Tensor, "b c h w"]) -> tuple[Float[Tensor, "b c h w-1"], Float[Tensor, "b c h-1 w"]]:
    """Differences to the right and to the lower neighbor, the g of SAU-Net eq. (13)."""
    return x[..., :, 1:] - x[..., :, :-1], x[..., 1:, :] - x[..., :-1, :]


@full_precision
def sobel(x: Float[Tensor, "b c h w"], padding: str = "replicate") -> tuple[Float[Tensor, "b c h w"], ...]:
    """LapDepth's un-normalized 3x3 Sobel gradients (x: left minus right, y: top minus bottom)."""
    one_of("padding", padding, ("replicate", "zero"))
    padded = F.pad(x, (1, 1, 1, 1), mode="replicate" if padding == "replicate" else "constant")
    across = padded[..., :, :-2] - padded[..., :, 2:]
    down = padded[..., :-2, :] - padded[..., 2:, :]
    gx = across[..., :-2, :] + 2 * across[..., 1:-1, :] + across[..., 2:, :]
    gy = down[..., :, :-2] + 2 * down[..., :, 1:-1] + down[..., :, 2:]
    return gx, gy


@full_precision
def gradient_loss(
    prediction: Float[Tensor, "b 1 h w"],
    target: Float[Tensor, "b 1 h w"],
    known: Bool[Tensor, "b 1 h w"] | None = None,
    operator: str = "forward",
    padding: str = "replicate",
) -> Float[Tensor, ""]:
    """Difference of two maps' gradients, SAU-Net eq. (13): mean over horizontal plus mean over vertical gradients.

    Args:
        prediction: The predicted map.
        target: The map g* to follow.
        known: Where the target has a value; None for everywhere. A gradient counts only if all its pixels are known.
        operator: ``forward`` differences as printed, or ``sobel`` (LapDepth's).
        padding: Padding of ``sobel``: ``replicate`` or ``zero``.

    Returns:
        The loss.

    Raises:
        ConfigError: for an unknown operator or padding.

    Examples:
        >>> ramp = torch.arange(4.0).expand(1, 1, 4, 4)
        >>> saunet.gradient_loss(2 * ramp, ramp)  # one more per pixel to the right, none downwards
        tensor(1.)
    """
    one_of("operator", operator, ("forward", "sobel"))
    if known is None:
        known = torch.ones_like(target, dtype=torch.bool)
    difference = torch.where(known, prediction - target, 0.0)  # gradients are linear, so one pass does
    if operator == "forward":
        gx, gy = forward_differences(difference)
        pairs_x, pairs_y = known[..., :, 1:] & known[..., :, :-1], known[..., 1:, :] & known[..., :-1, :]
        return masked_mean(gx.abs(), pairs_x) + masked_mean(gy.abs(), pairs_y)
    gx, gy = sobel(difference, padding)
    whole = F.max_pool2d((~known).to(difference), 3, stride=1, padding=1) == 0
    return masked_mean(gx.abs(), whole) + masked_mean(gy.abs(), whole)


@full_precision
def depth_inconsistency(expected: Float[Tensor, "*n"], predicted: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Relative difference |a - b| / (a + b) of two depths, in [0, 1): SC-Depth's."""
    return (expected - predicted).abs() / (expected + predicted)


@full_precision
def pool_known(depth: Float[Tensor, "b 1 _ _"], height: int, width: int) -> Float[Tensor, "b 1 {height} {width}"]:
    """Reduce a depth map with holes (0, NaN, infinite): each pixel is the mean of the known ones it covers, or 0."""
    known = (depth > 0) & depth.isfinite()
    filled = torch.where(known, depth, 0.0)
    if filled.shape[-2:] == (height, width):
        return filled
    share = F.adaptive_avg_pool2d(known.to(filled), (height, width))
    return F.adaptive_avg_pool2d(filled, (height, width)) / torch.where(share > 0, share, 1.0)


def box_mean(x: Float[Tensor, "*b h w"]) -> Float[Tensor, "*b h w"]:
    """3x3 mean with reflection padding over the last two dimensions (each at least 2)."""
    if x.device.type == "cpu":
        # On CPUs, pooling is a scalar loop, the largest part of the loss's time; shifted sums are vectorized.
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
