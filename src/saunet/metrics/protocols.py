"""Evaluation protocols as named objects, and the errors of one image under one of them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import interpolate

from saunet.errors import ConfigError, one_of, positive
from saunet.metrics.functional import error_terms, garg_crop, median, root_terms

GROUND_TRUTHS: tuple[str, ...] = ("lidar_x", "camera_z", "improved", "exact", "none")
"""The LiDAR's own forward coordinate; the camera's z of the same points; KITTI's accumulated maps; a renderer's; none,
where predictions are scored by how well they explain the neighboring frames."""


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
    """Only ground truth strictly between the limits counts; otherwise all of it above zero."""
    crop: Literal["garg", "none"] = "garg"
    scaling: Literal["median", "none"] = "median"
    """``median`` scales each image by median(truth)/median(prediction); ``none`` takes meters as predicted."""
    factor: float = 1.0
    """On the predicted depth, before any median scaling (5.4 for stereo-trained Monodepth2)."""

    def __post_init__(self) -> None:
        one_of("ground_truth", self.ground_truth, GROUND_TRUTHS)
        one_of("crop", self.crop, ("garg", "none"))
        one_of("scaling", self.scaling, ("median", "none"))
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
        if self.crop == "garg":
            top, bottom, left, right = garg_crop(*ground_truth.shape)
            inside = torch.zeros_like(mask)
            inside[top:bottom, left:right] = True
            mask = mask & inside
        return mask


_NAMED = (
    Protocol("eigen_lidar_x", "the field's classic numbers: depth is the LiDAR's own x, Garg crop", "lidar_x"),
    Protocol("eigen_camera_z", "the same points with depth as the camera sees it (z), Garg crop", "camera_z"),
    Protocol(
        "eigen_improved", "KITTI's accumulated ground truth, all of it, no crop", "improved", capped=False, crop="none"
    ),
    Protocol("metric", "camera z, Garg crop, meters as predicted: no scaling", "camera_z", scaling="none"),
    Protocol("synthetic", "a renderer's dense depth, whole image, 0.1 to 80 m", "exact", min_depth=0.1, crop="none"),
    Protocol(
        "campus",
        "no ground truth: how well depth and motion explain the neighbors",
        "none",
        crop="none",
        scaling="none",
    ),
)
PROTOCOLS: dict[str, Protocol] = {protocol.name: protocol for protocol in _NAMED}


def protocol(name: str) -> Protocol:
    return PROTOCOLS[one_of("protocol", name, PROTOCOLS)]


@dataclass(frozen=True, slots=True)
class Sample:
    """The pixels of one image that a protocol compares, scaled and clamped."""

    prediction: Float[Tensor, " n"]
    """Meters, float64."""
    target: Float[Tensor, " n"]
    """Meters, float64."""
    mask: Bool[Tensor, "h w"]
    """Where they lie in the ground truth, row by row: ``some_map[mask]`` follows the same order."""
    ratio: Float[Tensor, ""]
    """median(truth)/median(prediction), whether or not it was applied; NaN with no pixels."""


@dataclass(frozen=True, slots=True)
class ImageErrors:
    """What a protocol says about one image; NaN with no pixels."""

    errors: Float[Tensor, "7"]
    """As in `saunet.metrics.functional.ERROR_NAMES`, float64."""
    ratio: Float[Tensor, ""]
    """As in `Sample`."""
    pixels: int


def sample_image(disparity: Float[Tensor, "h w"], ground_truth: Float[Tensor, "hg wg"], protocol: Protocol) -> Sample:
    """Bring a prediction to the pixels that a protocol compares.

    Disparity of any size is resized to the native size of the ground truth, and becomes depth then; 0 and below is far
    away. Ground truth is depth in meters, 0 where unknown; 0 x 0 for an image without any.
    """
    mask = protocol.mask(ground_truth)
    target = ground_truth[mask].double()
    if target.numel() == 0:  # nothing to compare, perhaps not even a size to resize to
        return Sample(target, target, mask, median(target))
    resized = resize_disparity(disparity, (ground_truth.shape[0], ground_truth.shape[1]))
    prediction = protocol.factor / resized[mask].double()
    ratio = median(target) / median(prediction)
    if protocol.scaling == "median":
        prediction = prediction * ratio
    return Sample(prediction.clamp(protocol.min_depth, protocol.max_depth), target, mask, ratio)


def resize_disparity(disparity: Float[Tensor, "h w"], size: tuple[int, int]) -> Float[Tensor, "_ _"]:
    """Resize bilinearly with half-pixel centers, in single precision or better, and keep disparity positive."""
    single = disparity.to(torch.promote_types(disparity.dtype, torch.float32))[None, None]
    # The floor lies far below any real disparity (a billion meters): it keeps medians and products finite.
    return interpolate(single, size=size, mode="bilinear", align_corners=False)[0, 0].clamp(min=1e-9)


def evaluate_image(
    disparity: Float[Tensor, "h w"], ground_truth: Float[Tensor, "hg wg"], protocol: Protocol
) -> ImageErrors:
    return sample_errors(sample_image(disparity, ground_truth, protocol))


def sample_errors(sample: Sample) -> ImageErrors:
    errors = root_terms(error_terms(sample.prediction, sample.target).mean(-1))
    return ImageErrors(errors, sample.ratio, sample.target.numel())
