"""Networks whose answers are in meters."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from saunet.runs.record import Scale
from saunet.types import DepthPyramid


class MetricDepth(nn.Module):
    """A depth network with its scale applied: image to disparity in 1/meter."""

    def __init__(self, network: nn.Module, scale: Scale) -> None:
        super().__init__()
        self.network, self.scale = network, scale

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 1 h w"]:
        """Return disparity at full resolution, 1/meter."""
        pyramid: DepthPyramid = self.network(image)
        return pyramid.disparity[0] / self.scale.factor


class MetricMotion(nn.Module):
    """A pose network with the scale of its depth network applied: frames to motion in meters."""

    def __init__(self, network: nn.Module, scale: Scale) -> None:
        super().__init__()
        self.network, self.scale = network, scale

    def forward(
        self, target: Float[Tensor, "b 3 h w"], sources: Float[Tensor, "b s 3 h w"]
    ) -> Float[Tensor, "b s 4 4"]:
        """Return T_src_tgt of each source, meters."""
        T: Tensor = self.network(target, sources)
        factors = torch.ones_like(T)
        factors[..., :3, 3] = self.scale.factor
        return T * factors
