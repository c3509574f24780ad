"""Pose from an image encoder over stacked frames and Monodepth2's pose head, whatever the encoder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from saunet.errors import ConfigError, divisible, one_of
from saunet.models.layers.conv import channels_last_weights
from saunet.models.poses.base import check_offsets, check_sources, motions_to_sources, ordered_pairs


class StackedPose(nn.Module):
    """An encoder over stacked frames, and a head that turns its deepest feature into motions (Godard et al. 2019).

    - ``pairs``: each source with the target, the earlier frame first; all pairs pass the encoder in one batch.
    - ``triplet``: "this moment and the two adjacent frames" at once, in the order of time, and two motions.

    Both predict motions forward in time, which are inverted for sources before the target.
    """

    def __init__(self, encoder: Callable[[int], Any], input: str, offsets: Sequence[int]) -> None:
        super().__init__()
        self.input = one_of("input", input, ("pairs", "triplet"))
        self.offsets = check_offsets(offsets)
        if input == "triplet" and len(self.offsets) != 2:
            raise ConfigError(
                f"input is 'triplet' but there are {len(self.offsets) + 1} frames (the target and offsets "
                f"{list(self.offsets)}); it needs 3: give two offsets such as [-1, 1], or use input=pairs"
            )
        triplet = input == "triplet"
        self.encoder = encoder(3 if triplet else 2)
        self.head = PoseHead(self.encoder.features[-1].channels, motions=2 if triplet else 1)
        channels_last_weights(self)

    def forward(
        self, target: Float[Tensor, "b 3 h w"], sources: Float[Tensor, "b s 3 h w"]
    ) -> Float[Tensor, "b s 4 4"]:
        """Return T_src_tgt for each source: a target point times it is a source point."""
        check_sources(sources, self.offsets)
        divisible(target.shape[-2], target.shape[-1], self.encoder.size_divisor)
        if self.input == "pairs":
            frames = ordered_pairs(target, sources, self.offsets)
            motion = self._motions(frames).reshape(len(self.offsets), target.shape[0], 6)
        else:
            by_time = sorted(
                [(0, target), *((o, sources[:, i]) for i, o in enumerate(self.offsets))], key=lambda f: f[0]
            )
            motion = self._motions(torch.cat([frame for _, frame in by_time], 1)).transpose(0, 1)
            # the head's outputs are in the order of time, the sources need not be
            motion = motion if self.offsets[0] < self.offsets[1] else motion.flip(0)
        return motions_to_sources(motion, self.offsets)

    def _motions(self, frames: Tensor) -> Tensor:
        frames = frames.contiguous(memory_format=torch.channels_last)
        motions: Tensor = self.head(self.encoder(frames)[-1])
        return motions


class PoseHead(nn.Module):
    """Monodepth2's pose decoder: 1×1 squeeze to 256, two 3×3, 1×1 to 6 per motion, mean over the map."""

    def __init__(self, inputs: int, motions: int, width: int = 256) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(inputs, width, 1)
        self.conv1 = nn.Conv2d(width, width, 3, padding=1)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1)
        self.project = nn.Conv2d(width, 6 * motions, 1)

    def forward(self, feature: Float[Tensor, "b c h w"]) -> Float[Tensor, "b m 6"]:
        """Return axis-angle and translation of each motion, unscaled."""
        x = torch.relu(self.squeeze(feature))
        x = torch.relu(self.conv1(x))
        x = torch.relu(self.conv2(x))
        motions: Tensor = self.project(x).mean((2, 3)).unflatten(1, (-1, 6))
        return motions
