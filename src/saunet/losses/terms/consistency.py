"""Depth agrees between frames: one scale for a whole drive."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from saunet.geometry.warp import FAR, backproject, project_each, sample, visible
from saunet.losses.base import Term, TermResult, require
from saunet.losses.functional import depth_inconsistency, masked_mean
from saunet.registry import terms
from saunet.types import DepthPyramid, TrainBatch, View


@terms.register("consistency")
class Consistency(Term):
    """Geometry consistency of SC-Depth: a target point's depth in a source camera against the depth predicted there.

    Compared at full resolution where the point is visible in the source. It needs the depth network's answer for the
    sources, one more forward pass each.

    Raises:
        ConfigError: in `forward`, if the batch has no ``source_depth``.
    """

    needs_source_depth = True

    def __init__(self) -> None:
        super().__init__()

    def forward(
        self,
        batch: TrainBatch,
        pyramid: DepthPyramid,
        poses: Float[Tensor, "b s 4 4"],
        views: Sequence[View],
    ) -> TermResult:
        """Return the mean relative difference over visible pixels of all sources."""
        depth = require(
            batch, "source_depth", "the consistency term", "use a training step that predicts depth for the sources"
        )
        points = backproject(pyramid.depth[0].clamp(max=FAR), batch["K"])
        pixels, z = project_each(points, batch["K"], poses)
        found = sample(depth.clamp(max=FAR), pixels)[:, :, 0]
        seen = visible(pixels, z, *depth.shape[-2:])
        expected = torch.where(seen, z, 1.0)
        return TermResult(value=masked_mean(depth_inconsistency(expected, found), seen))
