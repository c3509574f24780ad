"""Pose from a ResNet over stacked frames (Monodepth2; SAU-Net section III-A)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from saunet.models.encoders.resnet import ResNet
from saunet.models.poses.stacked import StackedPose
from saunet.registry import poses


@poses.register("resnet18", blocks=(2, 2, 2, 2))
@poses.register("resnet34", blocks=(3, 4, 6, 3))
@poses.register("resnet50", blocks=(3, 4, 6, 3), bottleneck=True)
class ResNetPose(StackedPose):
    """ResNet over stacked frames and Monodepth2's pose head (SAU-Net section III-A, D_{t→t'}; there ResNet-34).

    The paper's pose "decoder is an AU-Net", which cannot output six numbers; the head here is Monodepth2's.

    Args:
        blocks: Residual blocks in each of the four stages.
        bottleneck: Bottleneck blocks (ResNet-50) instead of basic ones.
        input: What the encoder sees at once; see `StackedPose`.
        offsets: Time offset of each source, in frames.
        weights: Public weights for the encoder to start from: ``imagenet``, a name, a URL or a file.

    Raises:
        ConfigError: for a wrong word or offsets, or ``triplet`` without exactly two sources.
        CheckpointError: if ``weights`` cannot be found, fetched, read or fitted.
    """

    def __init__(
        self,
        blocks: Sequence[int] = (3, 4, 6, 3),
        bottleneck: bool = False,
        input: Literal["pairs", "triplet"] = "pairs",
        offsets: Sequence[int] = (-1, 1),
        weights: str | None = None,
    ) -> None:
        def encoder(frames: int) -> ResNet:
            return ResNet(blocks, bottleneck, frames=frames, weights=weights)

        super().__init__(encoder, input, offsets)
