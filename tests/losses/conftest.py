"""Small inputs for loss terms: a batch, a depth pyramid, motions, and the views that follow from them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from saunet.geometry.depth import disparity_to_depth, sigmoid_to_disparity
from saunet.geometry.pose import pose_matrix
from saunet.geometry.warp import synthesize
from saunet.types import DepthPyramid, View


@dataclass
class Inputs:
    """What a term is called with, and the leaves that its gradients should reach."""

    batch: dict[str, Any]
    pyramid: DepthPyramid
    poses: Tensor
    views: tuple[View, ...]
    sigmoid: tuple[Tensor, ...]
    axisangle: Tensor
    translation: Tensor

    @property
    def leaves(self) -> tuple[Tensor, ...]:
        """The networks' outputs."""
        return (*self.sigmoid, self.axisangle, self.translation)

    def rebuilt(self, *leaves: Tensor) -> Inputs:
        """The same batch with other outputs of the networks, through the same steps as in training."""
        return assemble(self.batch, leaves[:-2], leaves[-2], leaves[-1])

    def __iter__(self) -> Any:
        return iter((self.batch, self.pyramid, self.poses, self.views))


def assemble(batch: dict[str, Any], sigmoid: Sequence[Tensor], axisangle: Tensor, translation: Tensor) -> Inputs:
    """Do what the training step does, from the outputs of the two networks."""
    disparity = tuple(sigmoid_to_disparity(s, 0.1, 100.0) for s in sigmoid)
    pyramid = DepthPyramid(
        sigmoid=tuple(sigmoid), disparity=disparity, depth=tuple(disparity_to_depth(d) for d in disparity)
    )
    poses = pose_matrix(axisangle, translation)
    batch = {**batch, "T_predicted": poses}
    size = batch["loss_target"].shape[-2:]
    views = []
    for d in disparity:
        full = F.interpolate(d, size=size, mode="bilinear", align_corners=False)
        views.append(synthesize(batch["loss_sources"], disparity_to_depth(full), batch["K"], poses))
    return Inputs(batch, pyramid, poses, tuple(views), tuple(sigmoid), axisangle, translation)


@pytest.fixture
def make_inputs() -> Callable[..., Inputs]:
    def make(
        batch: int = 2,
        sources: int = 2,
        height: int = 16,
        width: int = 24,
        scales: int = 2,
        dtype: torch.dtype = torch.float32,
        **replace: Tensor,
    ) -> Inputs:
        generator = torch.Generator().manual_seed(3)

        def rand(*shape: int) -> Tensor:
            return torch.rand(*shape, generator=generator, dtype=torch.float64).to(dtype)

        images = rand(batch, sources + 1, 3, height, width)
        K = torch.tensor([[20.0, 0.0, width / 2 - 0.3], [0.0, 20.0, height / 2 - 0.7], [0.0, 0.0, 1.0]], dtype=dtype)
        known = rand(batch, 1, height, width) > 0.2
        data: dict[str, Any] = {
            "target": images[:, 0],
            "sources": images[:, 1:],
            "loss_target": images[:, 0],
            "loss_sources": images[:, 1:],
            "K": K.expand(batch, 3, 3),
            "name": [f"sample {i}" for i in range(batch)],
            "target_depth": (rand(batch, 1, height, width) * 20 + 1) * known,
            "target_teacher": rand(batch, 1, height, width) * 3 + 1,
            "distance": rand(batch, sources),
            "source_depth": rand(batch, sources, 1, height, width) * 0.5 + 2,
            "T_tracked": pose_matrix(rand(batch, sources, 3) * 0.1, rand(batch, sources, 3) + 0.2),
        }
        data.update(replace)
        sigmoid = [rand(batch, 1, height >> s, width >> s) * 0.05 + 0.02 for s in range(scales)]
        axisangle = (rand(batch, sources, 3) - 0.5) * 0.04
        translation = (rand(batch, sources, 3) - 0.5) * 0.2
        leaves = [leaf.requires_grad_() for leaf in (*sigmoid, axisangle, translation)]
        return assemble(data, leaves[:-2], *leaves[-2:])

    return make
