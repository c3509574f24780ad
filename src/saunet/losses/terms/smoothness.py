"""Edge-aware smoothness: disparity is flat where the image is."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from saunet.losses.base import Term, TermResult
from saunet.losses.functional import smoothness_loss
from saunet.registry import terms
from saunet.types import DepthPyramid, TrainBatch, View


@terms.register("smoothness")
class Smoothness(Term):
    """Edge-aware smoothness of the mean-normalized disparity (Monodepth2 eq. (3)), averaged over scales.

    Each scale is compared at its own size with the image reduced to it, and weighted by 1/2**scale. As in Monodepth2 it
    takes the network's relative disparity (its sigmoid).
    """

    def __init__(self) -> None:
        super().__init__()

    def forward(
        self,
        batch: TrainBatch,
        pyramid: DepthPyramid,
        poses: Float[Tensor, "b s 4 4"],
        views: Sequence[View],
    ) -> TermResult:
        """Return the mean over scales."""
        return TermResult(value=multiscale_smoothness(pyramid.sigmoid, batch["loss_target"]))


def multiscale_smoothness(
    disparities: Sequence[Float[Tensor, "b 1 _ _"]], image: Float[Tensor, "b 3 h w"]
) -> Float[Tensor, ""]:
    """Mean over scales of the edge-aware smoothness times 1/2**scale.

    A step between two pixels of scale s spans 2**s pixels of the image: the factor makes it a step per image pixel.
    """
    values = []
    for disparity in disparities:
        height, width = disparity.shape[-2:]
        small = image if (height, width) == image.shape[-2:] else F.adaptive_avg_pool2d(image, (height, width))
        values.append(smoothness_loss(disparity, small) * (width / image.shape[-1]))
    return torch.stack(values).mean()
