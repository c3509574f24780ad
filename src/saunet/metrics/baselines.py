"""Predictors that use no image: a network that does not beat them has not learned anything useful."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import interpolate

from saunet.errors import DataError, positive


class ConstantDepth(nn.Module):
    """The same depth in meters everywhere; under median scaling, the best possible without information."""

    def __init__(self, depth: float = 10.0) -> None:
        super().__init__()
        self.depth = positive("depth", depth)

    def forward(self, image: Float[Tensor, "b c h w"]) -> Float[Tensor, "b 1 h w"]:
        return image.new_full((image.shape[0], 1, *image.shape[-2:]), 1 / self.depth, dtype=torch.float32)


class MeanDepthMap(nn.Module):
    """The mean depth of the training ground truth at each position in the image: "the road is below, the sky above".

    Ground truths of any size are collected on one grid over the image, which is coarse because they may be sparse.
    Cells without measurements get the mean of their row, and rows without any get the nearest row with some.
    Measurements at or beyond ``max_depth`` meters are left out, as the protocols do.
    """

    depth_sum: Tensor
    count: Tensor

    def __init__(self, height: int = 48, width: int = 160, max_depth: float = 80.0) -> None:
        super().__init__()
        self.max_depth = positive("max_depth", max_depth)
        size = (int(positive("height", height)), int(positive("width", width)))
        self.register_buffer("depth_sum", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("count", torch.zeros(size, dtype=torch.float64))

    @torch.no_grad()
    def update(self, depth: Float[Tensor, "b 1 hg wg"], depth_size: Int[Tensor, "b 2"]) -> None:
        """Add the ground truths of a batch, as in `saunet.types.EvalBatch`."""
        height, width = self.depth_sum.shape
        depth = depth.to(self.depth_sum)
        for padded, (rows, columns) in zip(depth[:, 0], depth_size.tolist(), strict=True):
            truth = padded[:rows, :columns]
            known = (truth > 0) & (truth < self.max_depth)
            row, column = known.nonzero(as_tuple=True)
            # The cell that contains the pixel's center, (u + 0.5) * s.
            cell = ((2 * row + 1) * height // (2 * rows), (2 * column + 1) * width // (2 * columns))
            values = truth[known]
            self.depth_sum.index_put_(cell, values, accumulate=True)
            self.count.index_put_(cell, torch.ones_like(values), accumulate=True)

    def depth_map(self) -> Float[Tensor, "h w"]:
        """Return the mean depth on the grid in meters, every cell filled."""
        seen = self.count > 0
        cells = seen.sum(1)
        known_rows = cells.nonzero()[:, 0]
        if len(known_rows) == 0:
            raise DataError("the mean depth map has seen no ground truth; give it data with ground truth")
        mean = self.depth_sum / self.count.clamp(min=1)
        row_mean = mean.sum(1) / cells.clamp(min=1)
        distance = (torch.arange(len(cells), device=cells.device)[:, None] - known_rows[None]).abs()
        row_mean = row_mean[known_rows[distance.argmin(1)]]
        return torch.where(seen, mean, row_mean[:, None]).float()

    def forward(self, image: Float[Tensor, "b c h w"]) -> Float[Tensor, "b 1 h w"]:
        disparity = 1 / self.depth_map()[None, None].to(image.device)
        size = (image.shape[-2], image.shape[-1])
        resized = interpolate(disparity, size=size, mode="bilinear", align_corners=False)
        return resized.expand(image.shape[0], -1, -1, -1)
