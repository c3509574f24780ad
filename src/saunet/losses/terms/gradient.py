"""The auxiliary loss: depth changes where a target map changes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from saunet.errors import ConfigError, one_of
from saunet.geometry.depth import median_ratio
from saunet.losses.base import Term, TermResult, require
from saunet.losses.functional import gradient_loss, pool_known
from saunet.losses.terms.smoothness import multiscale_smoothness
from saunet.registry import terms
from saunet.types import DepthPyramid, TrainBatch, View

_SOURCES = {
    "lidar": ("target_depth", "set data.target_depth=true, or target: image, which needs no ground truth"),
    "teacher": ("target_teacher", "set data.teacher=true with data=kitti, or target: image, which needs none"),
}


@terms.register("gradient")
class Gradient(Term):
    """Gradient loss, SAU-Net eq. (13), against a target g* that can be swapped, averaged over scales.

    Every scale is compared at its own size (a target pixel is the mean of the known pixels it covers) and weighted by
    1/2**scale, which makes a difference between neighbors one per pixel of the image. Only gradients between known
    pixels count, so the target may be sparse.

    Args:
        target: ``image``: no ground truth, edge-aware smoothness of the mean-normalized disparity (of the other
            parameters only ``scales`` applies); ``lidar``: depth measured by a scanner, meters; ``teacher``: depth
            predicted by another model.
        domain: What is compared: ``depth`` as printed (metric, so it sets the scale of the network); ``log_depth`` and
            ``aligned`` (prediction times the median ratio, which does not learn), which leave the scale free;
            ``disparity``.
        operator: ``forward`` differences as printed, or ``sobel`` (LapDepth's, un-normalized).
        padding: Of ``sobel``: ``replicate``, or ``zero`` (LapDepth's), which supervises values at the border.
        scales: Which scales to compare; all if None. LapDepth's is ``[0]``.

    Raises:
        ConfigError: for an unknown word, or no scale.
    """

    def __init__(
        self,
        target: Literal["image", "lidar", "teacher"] = "image",
        domain: Literal["depth", "log_depth", "disparity", "aligned"] = "aligned",
        operator: Literal["forward", "sobel"] = "forward",
        padding: Literal["replicate", "zero"] = "replicate",
        scales: Sequence[int] | None = None,
    ) -> None:
        super().__init__()
        self.target = one_of("target", target, ("image", *_SOURCES))
        self.domain = one_of("domain", domain, ("depth", "log_depth", "disparity", "aligned"))
        self.operator = one_of("operator", operator, ("forward", "sobel"))
        self.padding = one_of("padding", padding, ("replicate", "zero"))
        self.scales = None if scales is None else tuple(scales)
        if self.scales == ():
            raise ConfigError("gradient.scales is empty; name at least one scale, such as [0], or null for all")

    def forward(
        self,
        batch: TrainBatch,
        pyramid: DepthPyramid,
        poses: Float[Tensor, "b s 4 4"],
        views: Sequence[View],
    ) -> TermResult:
        """Return the mean over scales."""
        chosen = range(len(pyramid.depth)) if self.scales is None else self.scales
        for scale in chosen:
            if not 0 <= scale < len(pyramid.depth):
                raise ConfigError(
                    f"gradient.scales holds {scale} but the network predicts scales 0 to {len(pyramid.depth) - 1}"
                )
        if self.target == "image":
            disparities = [pyramid.disparity[scale] for scale in chosen]
            return TermResult(value=multiscale_smoothness(disparities, batch["loss_target"]))
        key, fix = _SOURCES[self.target]
        full = require(batch, key, f"the gradient term with target '{self.target}'", fix)
        values = []
        for scale in chosen:
            depth = pyramid.depth[scale]
            target = pool_known(full, depth.shape[-2], depth.shape[-1])
            values.append(self.compare(depth, target) * (depth.shape[-1] / full.shape[-1]))
        return TermResult(value=torch.stack(values).mean())

    def compare(self, depth: Float[Tensor, "b 1 h w"], target: Float[Tensor, "b 1 h w"]) -> Float[Tensor, ""]:
        """Return eq. (13) for one scale."""
        known = (target > 0) & depth.isfinite()
        target = torch.where(known, target, 1.0)  # a harmless value: it never counts, but its logarithm must exist
        prediction, target = self._to_domain(depth, target, known)
        return gradient_loss(prediction, target, known, self.operator, self.padding)

    def _to_domain(
        self, depth: Float[Tensor, "b 1 h w"], target: Float[Tensor, "b 1 h w"], known: Bool[Tensor, "b 1 h w"]
    ) -> tuple[Tensor, Tensor]:
        if self.domain == "log_depth":
            return depth.log(), target.log()
        if self.domain == "disparity":
            return depth.reciprocal(), target.reciprocal()
        if self.domain == "aligned":
            return depth * median_ratio(depth.detach(), target, known)[:, None, None, None], target
        return depth, target
