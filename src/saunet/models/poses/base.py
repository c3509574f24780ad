"""What pose networks share: which motion to predict, in which order of time, and the step from numbers to matrices."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from saunet.errors import ConfigError
from saunet.geometry.pose import pose_matrix

MOTION_SCALE = 0.01
"""Factor on the raw output (Monodepth2): an untrained network predicts nearly no motion."""


def check_offsets(offsets: Sequence[int]) -> tuple[int, ...]:
    """Return the time offsets of the sources as a tuple."""
    offsets = tuple(offsets)
    if not offsets or 0 in offsets or len(set(offsets)) < len(offsets):
        raise ConfigError(
            f"offsets is {list(offsets)}; allowed: distinct frames before or after the target (0), such as [-1, 1]"
        )
    return offsets


def ordered_pairs(
    target: Float[Tensor, "b 3 h w"], sources: Float[Tensor, "b s 3 h w"], offsets: Sequence[int]
) -> Float[Tensor, "sb 6 h w"]:
    """Stack each source with the target, the earlier frame in the first three channels; source by source."""
    pairs = []
    for index, offset in enumerate(offsets):
        source = sources[:, index]
        pairs.append(torch.cat([source, target] if offset < 0 else [target, source], 1))
    return torch.cat(pairs)


def motions_to_sources(motion: Float[Tensor, "s b 6"], offsets: Sequence[int]) -> Float[Tensor, "b s 4 4"]:
    """Turn each pair's predicted forward motion into T_src_tgt.

    A network sees every pair in the order of time and so always predicts T_later_earlier, which for steady driving is
    the same for all pairs. That is T_src_tgt where the source is the later frame; else it is inverted.
    """
    motion = MOTION_SCALE * motion.float()
    poses = [
        pose_matrix(motion[index, :, :3], motion[index, :, 3:], invert=offset < 0)
        for index, offset in enumerate(offsets)
    ]
    return torch.stack(poses, 1)


def check_sources(sources: Tensor, offsets: Sequence[int]) -> None:
    """Check that there is one source image, of b s 3 h w, per offset."""
    if sources.shape[1] != len(offsets):
        raise ConfigError(
            f"the batch has {sources.shape[1]} source frames, the pose network was built for offsets {list(offsets)}; "
            "give the pose network and the data the same offsets"
        )
