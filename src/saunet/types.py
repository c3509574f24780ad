"""What the parts of saunet hand to each other.

Batches are ``TypedDict``: PyTorch's default collate and Lightning's device transfer work on them as they are.
Results are frozen slotted dataclasses whose tuples are indexed by scale (0 = full resolution, s = 1/2**s).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor
from typing_extensions import NotRequired, TypedDict


class _Sample(TypedDict):
    K: Float[Tensor, "b 3 3"]
    """Intrinsics in pixels of the images (integer coordinates are pixel centers)."""
    name: list[str]
    """One readable name a sample, such as ``2011_09_26/..._sync 0000000005 l``."""
    target_depth: NotRequired[Float[Tensor, "b 1 h w"]]
    """Depth of the target in meters at the size of the images, 0 where unknown; for losses that use LiDAR."""
    target_teacher: NotRequired[Float[Tensor, "b 1 h w"]]
    """Depth of the target as another model predicts it, at the size of the images, up to scale, 0 where unknown."""
    target_mask: NotRequired[Float[Tensor, "b 1 h w"]]
    """1 where the target shows the scene, 0 where it shows the vehicle that carries the camera."""
    T_src_tgt: NotRequired[Float[Tensor, "b s 4 4"]]
    """True motion, where the data set knows it: a target point times it is a source point, in meters."""
    T_tracked: NotRequired[Float[Tensor, "b n 4 4"]]
    """Motion to the neighbors in time as tracked points tell it: rotation, and a direction of length 1, or 0 where
    there is none; NaN where unknown."""
    track_points: NotRequired[Float[Tensor, "b n p 3"]]
    """Column and row in the target of some of those points, and their depth in lengths of the way; NaN if none."""
    T_stereo_tgt: NotRequired[Float[Tensor, "b 4 4"]]
    """Where the stereo view is, from the calibration: a target point times it is a point of that view, in meters.
    Where it is given, its image is the last source."""
    distance: NotRequired[Float[Tensor, "b s"]]
    """Meters the camera traveled between the target and each source; NaN where unknown and for the stereo view."""


class _Truth(TypedDict):
    depth: NotRequired[Float[Tensor, "b 1 hg wg"]]
    """Ground-truth depth in meters at its native size, 0 where unknown, padded to the largest in the batch."""
    depth_size: NotRequired[Int[Tensor, "b 2"]]
    """Native (height, width) of each ground truth inside the padding."""


class FrameBatch(_Sample, _Truth):
    """What the data loader yields: decoded frames as bytes, before anything happened to them on the device."""

    frames: UInt8[Tensor, "b 1+s 3 h w"]
    """RGB frames; index 0 is the target, then the sources in the order of the data module's ``offsets``, and last the
    stereo view, if ``T_stereo_tgt`` says that there is one."""
    draws: NotRequired[Float[Tensor, "b n"]]
    """Uniform random numbers in [0, 1) that augmentation uses; training samples only."""


class TrainBatch(_Sample):
    """One training step's input, on the device, augmented; images are RGB in [0, 1].

    All else follows their resize, crop and flip, which puts the stereo view on the other side.
    """

    target: Float[Tensor, "b 3 h w"]
    """The target image as the networks see it (color-jittered)."""
    sources: Float[Tensor, "b s 3 h w"]
    """The source images as the networks see them (the same jitter)."""
    loss_target: Float[Tensor, "b 3 h w"]
    """The target image without color jitter: what the loss compares."""
    loss_sources: Float[Tensor, "b s 3 h w"]
    """The source images without color jitter."""
    T_predicted: NotRequired[Float[Tensor, "b n 4 4"]]
    """The pose network's own answer, where ``T_tracked`` replaced it; the training step adds it."""
    source_depth: NotRequired[Float[Tensor, "b s 1 h w"]]
    """Predicted depth of the sources, with its graph; the training step adds it if `Objective.needs_source_depth`."""


class EvalBatch(TrainBatch, _Truth):
    """A batch without augmentation, with ground truth where the data set has it."""


@dataclass(frozen=True, slots=True)
class FeatureSpec:
    """One feature map of an encoder, so that any decoder can follow any encoder."""

    channels: int
    stride: int
    """Pixels of the input image per pixel of the feature map."""


@dataclass(frozen=True, slots=True)
class DepthPyramid:
    """A depth network's output at several scales; tuple index = scale, sizes (h/2**s, w/2**s)."""

    sigmoid: tuple[Float[Tensor, "b 1 _ _"], ...]
    """The raw output in (0, 1): relative disparity."""
    disparity: tuple[Float[Tensor, "b 1 _ _"], ...]
    """Inverse depth in 1/meter (up to the scale ambiguity of monocular training)."""
    depth: tuple[Float[Tensor, "b 1 _ _"], ...]
    """Depth in meters (up to the same scale)."""


@dataclass(frozen=True, slots=True)
class View:
    """Source images resampled into the target camera, with where that is meaningful."""

    image: Float[Tensor, "b s 3 h w"]
    valid: Bool[Tensor, "b s 1 h w"]
    """The point lies in front of the source camera and projects into its image."""


class Views(Sequence[View]):
    """The views of all scales, made when one is first asked for: a loss that needs none saves their memory."""

    def __init__(self, scales: int, make: Callable[[], tuple[View, ...]]) -> None:
        self._scales, self._make = scales, make
        self._made: tuple[View, ...] | None = None

    def __len__(self) -> int:
        return self._scales

    def __getitem__(self, scale: Any) -> Any:
        if self._made is None:
            self._made = self._make()
        return self._made[scale]


@dataclass(frozen=True, slots=True)
class LossTerms:
    """An objective's result: what is optimized is what is logged."""

    total: Float[Tensor, ""]
    values: Mapping[str, Float[Tensor, ""]]
    """The terms of ``total``, each before its weight, by name."""
    maps: Mapping[str, Tensor] = field(default_factory=dict)
    """Detached pictures for the log at full resolution, such as ``automask`` (b 1 h w)."""

    def named(self, stage: str) -> dict[str, Tensor]:
        """Return ``{"<stage>/loss": total, "<stage>/<term>": value, ...}``, detached, for logging."""
        named = {f"{stage}/{name}": value.detach() for name, value in self.values.items()}
        return {f"{stage}/loss": self.total.detach(), **named}
