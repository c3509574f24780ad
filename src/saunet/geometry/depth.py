"""From a network's sigmoid to disparity and depth, and the scale between two depth maps."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from saunet.geometry import full_precision


@full_precision
def sigmoid_to_disparity(sigmoid: Float[Tensor, "*b"], min_depth: float, max_depth: float) -> Float[Tensor, "*b"]:
    """Map a sigmoid in [0, 1] linearly onto disparities between ``1 / max_depth`` and ``1 / min_depth``.

    As in Monodepth2 (Godard et al., 2019).

    Args:
        sigmoid: The network's output.
        min_depth: Depth at sigmoid 1, meters.
        max_depth: Depth at sigmoid 0, meters.

    Returns:
        Disparity (inverse depth), 1/meter.

    Examples:
        >>> saunet.sigmoid_to_disparity(torch.tensor([0.0, 1.0]), min_depth=0.1, max_depth=10.0)
        tensor([ 0.1000, 10.0000])
    """
    low, high = 1 / max_depth, 1 / min_depth
    return low + (high - low) * sigmoid


@full_precision
def disparity_to_depth(disparity: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Depth in meters of a disparity in 1/meter: its reciprocal.

    Args:
        disparity: Inverse depth; greater than 0.

    Returns:
        Depth.

    Examples:
        >>> saunet.disparity_to_depth(torch.tensor([0.5, 0.1]))
        tensor([ 2., 10.])
    """
    return disparity.reciprocal()


@full_precision
def enlarge(disparity: Float[Tensor, "b 1 _ _"], height: int, width: int) -> Float[Tensor, "b 1 {height} {width}"]:
    """Disparity of a coarse scale at full size, bilinear."""
    if disparity.shape[-2:] == (height, width):
        return disparity
    return F.interpolate(disparity, size=(height, width), mode="bilinear", align_corners=False)


@full_precision
def median_ratio(
    prediction: Float[Tensor, "b 1 h w"], target: Float[Tensor, "b 1 h w"], mask: Bool[Tensor, "b 1 h w"]
) -> Float[Tensor, " b"]:
    """Per-image scale median(target) / median(prediction) over the mask, without leaving the device.

    The median of an even count is the mean of the two middle values, as in NumPy and unlike ``torch.median``.
    """
    ratio = _median(target, mask) / _median(prediction, mask)
    return torch.where(mask.flatten(1).any(1), ratio, torch.ones_like(ratio))


def _median(values: Tensor, mask: Tensor) -> Tensor:
    """Per-item median over the mask; 1 where the mask is empty."""
    count = mask.flatten(1).sum(1, keepdim=True)
    ordered = torch.where(mask, values, torch.inf).flatten(1).sort(dim=1).values
    middle = torch.cat(((count - 1).clamp(min=0) // 2, count // 2), dim=1)
    median = ordered.gather(1, middle.clamp(max=ordered.shape[1] - 1)).mean(1)
    return torch.where(count[:, 0] > 0, median, torch.ones_like(median))
