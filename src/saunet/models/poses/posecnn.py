"""Seven convolutions that see two frames (SfMLearner, as slimmed in Monodepth2): the light pose network."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from saunet.models.layers.conv import channels_last_weights
from saunet.models.poses.base import check_offsets, check_sources, motions_to_sources, ordered_pairs
from saunet.registry import poses

_LAYERS = ((16, 7), (32, 5), (64, 3), (128, 3), (256, 3), (256, 3), (256, 3))


@poses.register("posecnn")
class PoseCNN(nn.Module):
    """Pose from seven strided convolutions and a 1×1 to six numbers, mean over the map (Zhou et al. 2017).

    About 1.6 M parameters and no size that it cannot take. Pairs are ordered in time as in `ResNetPose`.

    Weights start from He et al.'s normal distribution, biases at zero. Nothing is normalized on the way: with PyTorch's
    default the signal would shrink by 0.4 from layer to layer, all pairs would look alike behind the seventh, and the
    network would long learn a constant motion and little else.

    Args:
        offsets: Time offset of each source, in frames.

    Raises:
        ConfigError: if the offsets are empty, repeated or 0.
    """

    def __init__(self, offsets: Sequence[int] = (-1, 1)) -> None:
        super().__init__()
        self.offsets = check_offsets(offsets)
        layers: list[nn.Module] = []
        inputs = 6
        for outputs, kernel in _LAYERS:
            layers += [nn.Conv2d(inputs, outputs, kernel, stride=2, padding=kernel // 2), nn.ReLU(inplace=True)]
            inputs = outputs
        self.layers = nn.Sequential(*layers)
        self.project = nn.Conv2d(inputs, 6, 1)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
                nn.init.zeros_(module.bias)  # type: ignore[arg-type]
        channels_last_weights(self)

    def forward(
        self, target: Float[Tensor, "b 3 h w"], sources: Float[Tensor, "b s 3 h w"]
    ) -> Float[Tensor, "b s 4 4"]:
        """Return T_src_tgt for each source: a target point times it is a source point."""
        check_sources(sources, self.offsets)
        frames = ordered_pairs(target, sources, self.offsets).contiguous(memory_format=torch.channels_last)
        motion = self.project(self.layers((frames - 0.45) / 0.225)).mean((2, 3))
        return motions_to_sources(motion.reshape(len(self.offsets), target.shape[0], 6), self.offsets)
