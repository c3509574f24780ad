"""View synthesis: resample source images into the target camera, given its depth and the motion between them.

The pixel convention of the whole project lives here: integer coordinates are pixel centers, and a sampling grid is
normalized by (W - 1, H - 1) with ``align_corners=True``. As in `saunet.geometry.pose` nothing is a matrix product.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from saunet.geometry import full_precision
from saunet.types import View

MIN_Z = 1e-3
"""Smallest distance in front of a camera, in meters, for a visible point; nearer, 1/z and its gradient explode."""
FAR = 1e6
"""Distance in meters used for infinity: there is no parallax left, and 0 * infinity does not occur."""
BORDER = 1e-2
"""Pixels beyond the outermost pixel centers that still count as inside: more than float32 rounding, but invisible."""
BEHIND = -2.0
"""Coordinate, on both axes, of a point that no source sees: outside every image."""


@full_precision
def backproject(depth: Float[Tensor, "b 1 h w"], K: Float[Tensor, "b 3 3"]) -> Float[Tensor, "b 3 h w"]:
    """3-D points of every pixel in its camera's frame: D(p) K^-1 p, the inner part of SAU-Net eq. (7).

    Args:
        depth: Depth along the optical axis, meters.
        K: Intrinsics, pixels.

    Returns:
        Points (x right, y down, z forward), meters.

    Examples:
        >>> K = torch.tensor([[[2.0, 0.0, 1.0], [0.0, 2.0, 0.0], [0.0, 0.0, 1.0]]])
        >>> points = saunet.backproject(torch.full((1, 1, 1, 3), 4.0), K)
        >>> points[0, :, 0]  # x, y and z of three pixels in a row
        tensor([[-2.,  0.,  2.],
                [ 0.,  0.,  0.],
                [ 4.,  4.,  4.]])
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
    """Pixels where another camera sees points: K T p, the outer part of SAU-Net eq. (7).

    Args:
        points: Points in the target camera's frame, meters.
        K: Intrinsics of the source camera, pixels.
        T: ``T_src_tgt``, which maps target points to source points.

    Returns:
        Pixels (u, v) in the source image, and depth z in the source camera. A point that is NaN, or less than `MIN_Z`
        in front of the camera, gets a pixel outside every image and no gradient.

    Examples:
        >>> K = torch.tensor([[[2.0, 0.0, 1.0], [0.0, 2.0, 0.0], [0.0, 0.0, 1.0]]])
        >>> points = saunet.backproject(torch.full((1, 1, 1, 3), 4.0), K)
        >>> pixels, z = saunet.project(points, K, torch.eye(4)[None])
        >>> pixels[0, 0]
        tensor([[0., 0.],
                [1., 0.],
                [2., 0.]])
    """
    pixels, z = project_each(points, K, T[:, None])
    return pixels[:, 0], z[:, 0]


@full_precision
def project_each(
    points: Float[Tensor, "b 3 h w"], K: Float[Tensor, "b 3 3"], T_src_tgt: Float[Tensor, "b s 4 4"]
) -> tuple[Float[Tensor, "b s h w 2"], Float[Tensor, "b s h w"]]:
    """Same as `project`, for several source cameras with the same intrinsics."""
    x, y, z = points[:, None, None].unbind(3)
    columns = T_src_tgt[:, :, :3, :, None, None].unbind(3)
    moved = columns[0] * x + columns[1] * y + columns[2] * z + columns[3]
    x, y, z = moved.unbind(2)
    front = (z > MIN_Z) & ~(x + y).isnan()  # NaN must not reach the sampler
    safe = torch.where(front, z, torch.ones_like(z))
    fx, skew, cx, fy, cy = (entry[:, None] for entry in _entries(K))
    x, y = x / safe, y / safe
    pixels = torch.stack((fx * x + skew * y + cx, fy * y + cy), dim=-1)
    return torch.where(front[..., None], pixels, torch.full_like(pixels, BEHIND)), z


@full_precision
def sample(images: Float[Tensor, "b s c h w"], pixels: Float[Tensor, "b s hp wp 2"]) -> Float[Tensor, "b s c hp wp"]:
    """Look images up at pixels (u, v): bilinear, with the border value outside the picture."""
    batch, count, _, height, width = images.shape
    u, v = pixels.unbind(-1)
    grid = torch.stack((2 * u / max(width - 1, 1) - 1, 2 * v / max(height - 1, 1) - 1), dim=-1)
    found = F.grid_sample(
        images.flatten(0, 1), grid.flatten(0, 1), mode="bilinear", padding_mode="border", align_corners=True
    )
    return found.reshape(batch, count, *found.shape[1:])


def visible(pixels: Float[Tensor, "*b 2"], z: Float[Tensor, "*b"], height: int, width: int) -> Bool[Tensor, "*b"]:
    """Where a projected point lies in front of the camera and inside an image of this size."""
    u, v = pixels.unbind(-1)
    inside = (u >= -BORDER) & (u <= width - 1 + BORDER) & (v >= -BORDER) & (v <= height - 1 + BORDER)
    return inside & (z > MIN_Z)


@full_precision
def synthesize(
    sources: Float[Tensor, "b s 3 h w"],
    depth: Float[Tensor, "b 1 h w"],
    K: Float[Tensor, "b 3 3"],
    T_src_tgt: Float[Tensor, "b s 4 4"],
) -> View:
    """Resample the sources into the target camera: H_{t'->t} of SAU-Net eq. (7).

    Bilinear, with the border color outside the picture. A point at infinite depth only moves by rotation.

    Args:
        sources: Source images.
        depth: Depth of the target, meters.
        K: Intrinsics of target and sources, pixels.
        T_src_tgt: Motion, which maps target points to source points.

    Returns:
        The warped images, and where a point lies in front of the source camera and inside its image.

    Examples:
        >>> K = torch.tensor([[[2.0, 0.0, 1.0], [0.0, 2.0, 0.0], [0.0, 0.0, 1.0]]])
        >>> source = torch.tensor([0.1, 0.2, 0.3]).expand(1, 1, 3, 1, 3)
        >>> shift = saunet.pose_matrix(torch.zeros(1, 1, 3), torch.tensor([[[2.0, 0.0, 0.0]]]))  # 2 m: one pixel at 4 m
        >>> view = saunet.synthesize(source, torch.full((1, 1, 1, 3), 4.0), K, shift)
        >>> view.image[0, 0, 0], view.valid[0, 0, 0]
        (tensor([[0.2000, 0.3000, 0.3000]]), tensor([[ True,  True, False]]))
    """
    pixels, z = project_each(backproject(depth.clamp(max=FAR), K), K, T_src_tgt)
    return View(image=sample(sources, pixels), valid=visible(pixels, z, *sources.shape[-2:])[:, :, None])


def _entries(K: Tensor) -> tuple[Tensor, ...]:
    """Return fx, skew, cx, fy, cy of K, each b 1 1."""
    return tuple(K[:, row, column, None, None] for row, column in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2)))
