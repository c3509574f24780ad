"""Named evaluation protocols, and the errors of one image under a protocol."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias, cast, get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import interpolate

from saunet.errors import ConfigError, one_of, positive
from saunet.metrics.functional import CROPS, Crop, crop_window, error_terms, median, root_terms

GROUND_TRUTHS: tuple[str, ...] = ("lidar_x", "camera_z", "improved", "exact", "none")
"""The LiDAR's own forward coordinate; the camera's z of the same points; KITTI's accumulated maps; a renderer's depth;
none, if predictions are scored by how well they explain the neighboring frames."""
Alignment: TypeAlias = Literal["median", "least_squares", "least_squares_disparity", "none"]
ALIGNMENTS: tuple[str, ...] = get_args(Alignment)
"""Depth times median(truth)/median(prediction); depth times the factor of least squared error; disparity times a factor
plus a shift of least squared error (Ranftl et al., 2022, if the shift of a prediction is arbitrary too); meters as
predicted."""
_FARTHEST = 1e-9
"""Far below any real disparity in 1/m (a million kilometers): it keeps medians and products finite."""


@dataclass(frozen=True)
class Protocol:
    """Everything that decides what an error means: ground truth, pixels, scale and limits."""

    name: str
    summary: str = ""
    ground_truth: Literal["lidar_x", "camera_z", "improved", "exact", "none"] = "camera_z"
    min_depth: float = 1e-3
    """Limits of the prediction in meters, applied after scaling."""
    max_depth: float = 80.0
    capped: bool = True
    """Whether only ground truth strictly between the limits counts; otherwise everything above zero does."""
    crop: Crop = "garg"
    """Part of the ground truth that counts; see `saunet.metrics.functional.CROPS`."""
    alignment: Alignment = "median"
    """How each image's prediction is aligned with the truth; see `ALIGNMENTS`."""
    factor: float = 1.0
    """Factor on the predicted depth, before any alignment (5.4 for stereo-trained Monodepth2)."""

    def __post_init__(self) -> None:
        one_of("ground_truth", self.ground_truth, GROUND_TRUTHS)
        one_of("crop", self.crop, CROPS)
        one_of("alignment", self.alignment, ALIGNMENTS)
        positive("min_depth", self.min_depth)
        positive("factor", self.factor)
        if not self.max_depth > self.min_depth:
            raise ConfigError(f"max_depth is {self.max_depth}; it must be greater than min_depth {self.min_depth}")

    def accepts(self, ground_truth: str) -> bool:
        """Return whether this can be computed on that kind of depth (a renderer's depth is a camera z)."""
        return ground_truth == self.ground_truth or (self.ground_truth == "camera_z" and ground_truth == "exact")

    def mask(self, ground_truth: Float[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
        low, high = (self.min_depth, self.max_depth) if self.capped else (0.0, math.inf)
        mask = (ground_truth > low) & (ground_truth < high)
        if self.crop != "none":
            top, bottom, left, right = crop_window(self.crop, *ground_truth.shape)
            inside = torch.zeros_like(mask)
            inside[top:bottom, left:right] = True
            mask = mask & inside
        return mask


# Sources: docs/evaluation.md.
_NAMED = (
    Protocol("eigen_lidar_x", "the field's classic numbers: depth is the LiDAR's own x, Garg crop", "lidar_x"),
    Protocol("eigen_camera_z", "the same points with depth as the camera sees it (z), Garg crop", "camera_z"),
    Protocol(
        "eigen_improved", "KITTI's accumulated ground truth, all of it, no crop", "improved", capped=False, crop="none"
    ),
    Protocol("metric", "camera z, Garg crop, meters as predicted: no alignment", "camera_z", alignment="none"),
    Protocol("kitti_360", "0.001 to 80 m, whole image", crop="none"),
    Protocol("nuscenes", "LiDAR points of key frames, 0.1 to 80 m, whole image", min_depth=0.1, crop="none"),
    Protocol("cityscapes", "0.001 to 80 m, ManyDepth's crop of images without their bottom quarter", crop="cityscapes"),
    Protocol("ddad", "LiDAR points up to 200 m, whole image", max_depth=200.0, crop="none"),
    Protocol(
        "make3d", "C1: truth below 70 m, of the central 2:1 crop that the network sees", max_depth=70.0, crop="none"
    ),
    Protocol("indoor", "0.1 to 10 m, whole image", min_depth=0.1, max_depth=10.0, crop="none"),
    Protocol("nyu", "0.001 to 10 m, NYU's crop without the white border", max_depth=10.0, crop="nyu"),
    Protocol("syns", "0.001 to 100 m, whole image", max_depth=100.0, crop="none", alignment="least_squares_disparity"),
    Protocol("synthetic", "a renderer's dense depth, whole image, 0.1 to 80 m", "exact", min_depth=0.1, crop="none"),
    Protocol(
        "campus",
        "no ground truth: how well depth and motion explain the neighbors",
        "none",
        crop="none",
        alignment="none",
    ),
)
PROTOCOLS: dict[str, Protocol] = {protocol.name: protocol for protocol in _NAMED}


def protocol(name: str) -> Protocol:
    """Return a named protocol, with another alignment if one follows: ``ddad/none``.

    Raises:
        ConfigError: if there is no such protocol or alignment, or the protocol has no ground truth to align with.
    """
    base, slash, alignment = name.partition("/")
    found = PROTOCOLS[one_of("protocol", base, PROTOCOLS)]
    if slash and found.ground_truth == "none":
        raise ConfigError(f"protocol '{name}' aligns with ground truth, which '{base}' does not use; choose '{base}'")
    chosen = cast(Alignment, one_of("alignment", alignment, ALIGNMENTS)) if slash else found.alignment
    return replace(found, name=name, alignment=chosen) if slash else found


@dataclass(frozen=True, slots=True)
class Sample:
    """The pixels of one image that a protocol compares, scaled and clamped."""

    prediction: Float[Tensor, " n"]
    """Meters, float64."""
    target: Float[Tensor, " n"]
    """Meters, float64."""
    mask: Bool[Tensor, "h w"]
    """Their positions in the ground truth, row by row: ``some_map[mask]`` has the same order."""
    ratio: Float[Tensor, ""]
    """Factor on the depth: that of the alignment, and median(truth)/median(prediction) without one. NaN: no pixels."""
    shift: Float[Tensor, ""]
    """Added to the disparity after that, 1/m; 0 except for ``least_squares_disparity``."""


@dataclass(frozen=True, slots=True)
class ImageErrors:
    """A protocol's result for one image; NaN without pixels."""

    errors: Float[Tensor, "7"]
    """As in `saunet.metrics.functional.ERROR_NAMES`, float64."""
    ratio: Float[Tensor, ""]
    """As in `Sample`."""
    pixels: int


def sample_image(disparity: Float[Tensor, "h w"], ground_truth: Float[Tensor, "hg wg"], protocol: Protocol) -> Sample:
    """Align a prediction with the pixels that a protocol compares.

    Disparity of any size is resized to the native size of the ground truth and then converted to depth; 0 and below is
    far away. Ground truth is depth in meters, 0 where unknown; 0 x 0 for an image without any.
    """
    mask = protocol.mask(ground_truth)
    target = ground_truth[mask].double()
    shift = target.new_zeros(())
    if target.numel() == 0:  # nothing to compare, perhaps not even a size to resize to
        return Sample(target, target, mask, median(target), shift)
    resized = resize_disparity(disparity, (ground_truth.shape[0], ground_truth.shape[1]))[mask].double()
    prediction = protocol.factor / resized.clamp(min=_FARTHEST)
    if protocol.alignment == "least_squares":
        ratio = (prediction @ target) / (prediction @ prediction)
    elif protocol.alignment == "least_squares_disparity":
        ratio, shift = _fit_disparity(resized / protocol.factor, 1 / target)
    else:
        ratio = median(target) / median(prediction)
    return Sample(aligned_depth(resized, ratio, shift, protocol), target, mask, ratio, shift)


def _fit_disparity(
    disparity: Float[Tensor, " n"], true: Float[Tensor, " n"]
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Return the factor on the depth and the shift of the disparity with the least squared error of the disparity."""
    centered = disparity - disparity.mean()
    slope = (centered @ true) / (centered @ centered)
    if centered @ centered <= 1e-12 * (disparity @ disparity) or slope == 0:  # constant but for rounding
        return disparity.mean() / true.mean(), true.new_zeros(())
    return 1 / slope, true.mean() - slope * disparity.mean()


def aligned_depth(
    disparity: Float[Tensor, "*shape"], ratio: Float[Tensor, ""], shift: Float[Tensor, ""], protocol: Protocol
) -> Float[Tensor, "*shape"]:
    """Turn disparity into depth in meters as a `Sample` of the image was aligned, between the protocol's limits."""
    if protocol.alignment == "least_squares_disparity":
        depth = 1 / (disparity / (protocol.factor * ratio) + shift).clamp(min=_FARTHEST)
    else:
        depth = protocol.factor / disparity.clamp(min=_FARTHEST)
        if protocol.alignment != "none":
            depth = depth * ratio
    return depth.clamp(protocol.min_depth, protocol.max_depth)


def resize_disparity(disparity: Float[Tensor, "h w"], size: tuple[int, int]) -> Float[Tensor, "_ _"]:
    """Resize bilinearly with half-pixel centers, in single precision or better."""
    single = disparity.to(torch.promote_types(disparity.dtype, torch.float32))[None, None]
    return interpolate(single, size=size, mode="bilinear", align_corners=False)[0, 0]


def evaluate_image(
    disparity: Float[Tensor, "h w"], ground_truth: Float[Tensor, "hg wg"], protocol: Protocol
) -> ImageErrors:
    return sample_errors(sample_image(disparity, ground_truth, protocol))


def sample_errors(sample: Sample) -> ImageErrors:
    errors = root_terms(error_terms(sample.prediction, sample.target).mean(-1))
    return ImageErrors(errors, sample.ratio, sample.target.numel())
