"""Whole models by name: an encoder, a decoder and a pose network that belong together."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Literal

from torch import Tensor, nn

from saunet.errors import checked, one_of
from saunet.models.depth import DepthNet
from saunet.registry import Spec, models
from saunet.types import DepthPyramid


@models.register("sau_net", encoder="stratified_tiny", decoder="aunet", pose="resnet34")
@models.register("sau_net_tiny", encoder="stratified_tiny", decoder="aunet", pose="resnet34")
@models.register("sau_net_nano", encoder="stratified_nano", decoder="aunet", pose="resnet18")
@models.register("stf_t_unet", encoder="stratified_tiny", decoder="unet", pose="resnet34")
@models.register("resnet50_unet", encoder="resnet50", decoder="unet", pose="resnet34")
@models.register("mono_r18", encoder="resnet18", decoder="unet", pose="resnet18")
@models.register("mono_r50", encoder="resnet50", decoder="unet", pose="resnet50")
@models.register("packnet", encoder="packnet", decoder="packnet", pose="posecnn")
@models.register("lite_mono", encoder="lite_mono", decoder="lite_mono", pose="resnet18")
@models.register("street", encoder="efficientnet_lite0", decoder="unet_narrow", pose="efficientnet_lite0")
class DepthAndPose(nn.Module):
    """A depth network and the pose network that is trained with it; called with an image, it predicts depth.

    Args:
        encoder: Depth encoder, as a name or with parameters.
        decoder: Depth decoder.
        pose: Pose network; None for none.
        min_depth: Smallest depth that the network can say, meters up to scale.
        max_depth: Largest depth.
    """

    def __init__(
        self,
        encoder: str | Spec,
        decoder: str | Spec,
        pose: str | Spec | None = None,
        min_depth: float = 0.1,
        max_depth: float = 100.0,
    ) -> None:
        super().__init__()
        unfinished = _spec("decoder", decoder).changed(_partial_=True)
        self.depth = DepthNet(_spec("encoder", encoder).build(), unfinished.build(), min_depth, max_depth)
        self.pose: nn.Module | None = None if pose is None else _spec("pose", pose).build()

    def forward(self, image: Tensor) -> DepthPyramid:
        """Return disparity and depth at each scale; see `DepthNet`."""
        pyramid: DepthPyramid = self.depth(image)
        return pyramid


def _spec(kind: str, part: str | Spec) -> Spec:
    return part if isinstance(part, Spec) else Spec.of(kind, part)


@checked
@dataclass(frozen=True, kw_only=True)
class ModelOptions:
    """Networks: depth (encoder and decoder) and pose.

    Args:
        encoder: Depth encoder.
        decoder: Depth decoder.
        pose: Pose network; None for training on stereo pairs alone.
        min_depth: Smallest depth that the network can say, meters up to scale.
        max_depth: Largest depth.
        intrinsics: Focal lengths in training: ``fixed`` keeps the given ones; ``refined`` learns one per recording with
            the networks, starting from the given one; ``learned`` starts from a guess, a 60 degree field of view.

    Examples:
        >>> parts = {"encoder": "resnet18", "decoder": "unet", "pose": "posecnn"}
        >>> saunet.ModelOptions(**{kind: saunet.Spec.of(kind, name) for kind, name in parts.items()}).max_depth
        100.0
    """

    encoder: Spec
    decoder: Spec
    pose: Spec | None = None
    min_depth: float = 0.1
    max_depth: float = 100.0
    intrinsics: Literal["fixed", "refined", "learned"] = "fixed"

    def __post_init__(self) -> None:
        one_of("model.intrinsics", self.intrinsics, ("fixed", "refined", "learned"))

    @classmethod
    def named(cls, name: str) -> ModelOptions:
        """Return the parts of a registered model.

        Raises:
            ConfigError: if there is no model of this name.
        """
        given = dict(models.entry(name).preset)
        parts = {kind: _spec(kind, given.pop(kind)) for kind in ("encoder", "decoder", "pose") if given.get(kind)}
        return cls(**{**given, **parts})

    def build(self) -> DepthAndPose:
        """Build the networks with random weights, or with those that the parts name."""
        return DepthAndPose(
            **{each.name: getattr(self, each.name) for each in fields(self) if each.name != "intrinsics"}
        )

    def same_architecture(self, other: ModelOptions) -> bool:
        """Return whether both cost the same: all parameters agree except the initial weights."""
        return _architecture(self) == _architecture(other)


def _architecture(options: ModelOptions) -> dict[str, object]:
    return {each.name: _settings(getattr(options, each.name)) for each in fields(options)}


def _settings(part: Spec | str | float | None) -> object:
    if not isinstance(part, Spec):
        return part
    defaults = {name: each.default for name, each in part.parameters.items() if each.default is not each.empty}
    given = {**defaults, **part.node}
    kept = {key: value for key, value in given.items() if key not in ("weights", "_convert_", "_partial_")}
    return {key: list(value) if isinstance(value, tuple) else value for key, value in kept.items()}
