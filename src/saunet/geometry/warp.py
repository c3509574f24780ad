"""View synthesis: resample source images into the target camera, given its depth and the motion between them.

The pixel convention of the whole project lives here: integer coordinates are pixel centres, and a sampling grid is
normalised by (W - 1, H - 1) with ``align_corners=True``. Everything is plain multiplication instead of matrix products,
because a float32 matrix product may run in TF32 on a GPU, where the coordinate of a pixel is good to half a pixel only.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from saunet.geometry.precision import full_precision
from saunet.types import View

MIN_Z = 1e-3
"""Metres in front of a camera from where a point counts as visible; nearer, 1/z and its gradient explode."""
FAR = 1e6
"""Metres that stand for infinity: no parallax is left, and 0 * infinity does not occur."""
BORDER = 1e-2
"""Pixels beyond the outermost pixel centres still inside: more than float32 rounding, too little to see."""
_BEHIND = -2.0


@full_precision
def backproject(depth: Float[Tensor, "b 1 h w"], K: Float[Tensor, "b 3 3"]) -> Float[Tensor, "b 3 h w"]:
    """3-D points of every pixel in its camera's frame: D(p) K^-1 p, the inner part of SAU-Net eq. (7).

    Args:
        depth: Depth along the optical axis, metres.
        K: Intrinsics, pixels.

    Returns:
        Points (x right, y down, z forward), metres.
    """
    height, width = depth.shape[-2:]
    u = torch.arange(width, dtype=depth.dtype, device=depth.device)
    v = torch.arange(height, dtype=depth.dtype, device=depth.device)[:, None]
    fx, skew, cx, fy, cy = _entries(K)
    y = ((v - cy) / fy).expand(-1, -1, width)
    x = (u - cx - skew * y) / fx
    return torch.stack((x, y, torch.ones_like(x)), dim=1) * depth


@full_precision
def project(
    points: Float[Tensor, "b 3 h w"], K: Float[Tensor, "b 3 3"], T: Float[Tensor, "b 4 4"]
) -> tuple[Float[Tensor, "b h w 2"], Float[Tensor, "b h w"]]:
    """Pixels where points are seen by another camera: K T p, the outer part of SAU-Net eq. (7).

    Args:
        points: Points in the target camera's frame, metres.
        K: Intrinsics of the source camera, pixels.
        T: ``T_src_tgt``: a target point times it is a source point.

    Returns:
        Pixels (u, v) in the source image, and depth z in the source camera. A point less than `MIN_Z` in front of the
        camera gets a pixel outside every image, and no gradient.
    """
    pixels, z = _project(points, K, T[:, None])
    return pixels[:, 0], z[:, 0]


@full_precision
def synthesize(
    sources: Float[Tensor, "b s 3 h w"],
    depth: Float[Tensor, "b 1 h w"],
    K: Float[Tensor, "b 3 3"],
    T_src_tgt: Float[Tensor, "b s 4 4"],
) -> View:
    """Resample the sources into the target camera: H_{t'->t} of SAU-Net eq. (7).

    Bilinear, with the border colour outside the picture. Infinite depth is a point that only rotation moves.

    Args:
        sources: Source images.
        depth: Depth of the target, metres.
        K: Intrinsics of target and sources, pixels.
        T_src_tgt: Motion: a target point times it is a source point.

    Returns:
        The warped images, and where a point lies in front of the source camera and inside its image.
    """
    batch, count, _, height, width = sources.shape
    pixels, z = _project(backproject(depth.clamp(max=FAR), K), K, T_src_tgt)
    u, v = pixels.unbind(-1)
    inside = (u >= -BORDER) & (u <= width - 1 + BORDER) & (v >= -BORDER) & (v <= height - 1 + BORDER)
    grid = torch.stack((2 * u / max(width - 1, 1) - 1, 2 * v / max(height - 1, 1) - 1), dim=-1)
    image = F.grid_sample(
        sources.flatten(0, 1), grid.flatten(0, 1), mode="bilinear", padding_mode="border", align_corners=True
    )
    return View(image=image.reshape(batch, count, *image.shape[1:]), valid=(inside & (z > MIN_Z))[:, :, None])


def _project(points: Tensor, K: Tensor, T: Tensor) -> tuple[Tensor, Tensor]:
    """Project points (b 3 h w) with several motions T (b s 4 4): pixels (b s h w 2), z (b s h w)."""
    x, y, z = points[:, None, None].unbind(3)
    columns = T[:, :, :3, :, None, None].unbind(3)
    moved = columns[0] * x + columns[1] * y + columns[2] * z + columns[3]
    x, y, z = moved.unbind(2)
    front = z > MIN_Z
    safe = torch.where(front, z, torch.ones_like(z))
    fx, skew, cx, fy, cy = (entry[:, None] for entry in _entries(K))
    x, y = x / safe, y / safe
    pixels = torch.stack((fx * x + skew * y + cx, fy * y + cy), dim=-1)
    return torch.where(front[..., None], pixels, torch.full_like(pixels, _BEHIND)), z


def _entries(K: Tensor) -> tuple[Tensor, ...]:
    """Return fx, skew, cx, fy, cy of K, each b 1 1."""
    return tuple(K[:, row, column, None, None] for row, column in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2)))
