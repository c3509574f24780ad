"""Pinhole intrinsics that follow an image through resize, crop and flip.

All functions expect K as ``[[fx, skew, cx], [0, fy, cy], [0, 0, 1]]`` in pixels; integer coordinates are pixel centers.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from saunet.geometry import full_precision

Number = float | int | Float[Tensor, "*b"]
GUESS = 0.5 / math.tan(math.radians(60) / 2)
"""Focal length assumed for an unknown camera, in picture widths: a 60 degree field of view."""


@full_precision
def scale_intrinsics(K: Float[Tensor, "*b 3 3"], scale_x: Number, scale_y: Number) -> Float[Tensor, "*b 3 3"]:
    """Intrinsics of an image resized by ``(scale_x, scale_y)``: a pixel u moves to ``(u + 0.5) * scale - 0.5``.

    Args:
        K: Intrinsics in pixels of the original image.
        scale_x: New width / old width; one number, or one per item of the batch.
        scale_y: New height / old height.

    Returns:
        Intrinsics in pixels of the resized image.

    Examples:
        >>> K = torch.tensor([[100.0, 0.0, 49.5], [0.0, 100.0, 29.5], [0.0, 0.0, 1.0]])
        >>> saunet.scale_intrinsics(K, 0.5, 0.5)[:2]
        tensor([[50.0000,  0.0000, 24.5000],
                [ 0.0000, 50.0000, 14.5000]])
    """
    x, y = _per_item(scale_x, K), _per_item(scale_y, K)
    across, down, last = K.unbind(-2)
    return torch.stack((x * across + (0.5 * x - 0.5) * last, y * down + (0.5 * y - 0.5) * last, last), dim=-2)


@full_precision
def crop_intrinsics(K: Float[Tensor, "*b 3 3"], left: Number, top: Number) -> Float[Tensor, "*b 3 3"]:
    """Intrinsics of an image whose first ``left`` columns and ``top`` rows were cut off.

    Args:
        K: Intrinsics in pixels of the original image.
        left: Columns removed on the left (negative where columns were added); one number, or one per item of the batch.
        top: Rows removed at the top.

    Returns:
        Intrinsics in pixels of the crop.

    Examples:
        >>> K = torch.tensor([[100.0, 0.0, 49.5], [0.0, 100.0, 29.5], [0.0, 0.0, 1.0]])
        >>> saunet.crop_intrinsics(K, left=10, top=4)[:2, 2]
        tensor([39.5000, 25.5000])
    """
    across, down, last = K.unbind(-2)
    return torch.stack((across - _per_item(left, K) * last, down - _per_item(top, K) * last, last), dim=-2)


@full_precision
def flip_intrinsics(K: Float[Tensor, "*b 3 3"], width: Number) -> Float[Tensor, "*b 3 3"]:
    """Intrinsics of a horizontally mirrored image: ``cx -> width - 1 - cx``.

    The mirrored image shows the mirrored world: a point (x, y, z) appears at (-x, y, z).

    Args:
        K: Intrinsics in pixels of the original image.
        width: Image width in pixels; one number, or one per item of the batch.

    Returns:
        Intrinsics in pixels of the mirrored image.

    Examples:
        >>> K = torch.tensor([[100.0, 0.0, 40.0], [0.0, 100.0, 29.5], [0.0, 0.0, 1.0]])
        >>> saunet.flip_intrinsics(K, width=100)[0, 2]
        tensor(59.)
    """
    across, down, last = K.unbind(-2)
    mirrored = torch.cat((across[..., :1], -across[..., 1:]), dim=-1)
    return torch.stack((mirrored + (_per_item(width, K) - 1) * last, down, last), dim=-2)


@full_precision
def zoom_intrinsics(K: Float[Tensor, "*b 3 3"], factor: Number) -> Float[Tensor, "*b 3 3"]:
    """Intrinsics of a lens with ``factor`` times the focal lengths; one number, or one per item of the batch."""
    times = torch.as_tensor(factor).to(K)[..., None, None]
    top = torch.cat((times * K[..., :2, :2], K[..., :2, 2:]), dim=-1)
    return torch.cat((top, K[..., 2:, :]), dim=-2)


def _per_item(value: Number, K: Tensor) -> Tensor | float:
    """Shape a number or a batch of numbers so that it multiplies rows of K."""
    return value.to(K)[..., None] if isinstance(value, Tensor) else float(value)
