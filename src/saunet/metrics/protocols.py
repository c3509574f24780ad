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
"""The LiDAR's own forward coordinate; the camera's z of the same points; KITTI's accumulated maps; a renderer's; none.

Without depth, predictions are scored by how well they explain the neighboring frames (`saunet.evaluation.views`)."""


@dataclass(frozen=True)
class Protocol:
    """Everything that decides what an error means: ground truth, pixels, scale and limits.

    The prediction's disparity is always resized to the ground truth's native size before it becomes depth.

    Args:
        name: The name that results carry.
        summary: One line for tables and help.
        ground_truth: Which depth it compares with, one of `GROUND_TRUTHS`.
        min_depth: Lower limit of the prediction in meters, applied after scaling.
        max_depth: Upper limit of the prediction in meters.
        capped: Only ground truth strictly between the limits counts; otherwise all of it above zero.
        crop: ``garg`` keeps the part of the image where the LiDAR reaches; ``none`` keeps all.
        scaling: ``median`` scales each image by median(truth)/median(prediction); ``none`` takes meters as predicted.
        factor: Fixed factor on the predicted depth, before any median scaling (5.4 for stereo-trained Monodepth2).

    Raises:
        ConfigError: for a word that is not allowed or limits that contradict each other.
    """

    name: str
    summary: str = ""
    ground_truth: Literal["lidar_x", "camera_z", "improved", "exact", "none"] = "camera_z"
    min_depth: float = 1e-3
    max_depth: float = 80.0
    capped: bool = True
    crop: Literal["garg", "none"] = "garg"
    scaling: Literal["median", "none"] = "median"
    factor: float = 1.0

    def __post_init__(self) -> None:
        one_of("ground_truth", self.ground_truth, GROUND_TRUTHS)
        one_of("crop", self.crop, ("garg", "none"))
        one_of("scaling", self.scaling, ("median", "none"))
        positive("min_depth", self.min_depth)
        positive("factor", self.factor)
        if not self.max_depth > self.min_depth:
            raise ConfigError(f"max_depth is {self.max_depth}; it must be greater than min_depth {self.min_depth}")

    def accepts(self, ground_truth: str) -> bool:
        """Tell whether this protocol can be computed on that kind of depth (a renderer's depth is a camera z)."""
        return ground_truth == self.ground_truth or (self.ground_truth == "camera_z" and ground_truth == "exact")

    def mask(self, ground_truth: Float[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
        """Return the pixels of a ground truth that count."""
        low, high = (self.min_depth, self.max_depth) if self.capped else (0.0, math.inf)
        mask = (ground_truth > low) & (ground_truth < high)
        if self.crop == "garg":
            top, bottom, left, right = garg_crop(*ground_truth.shape)
            inside = torch.zeros_like(mask)
            inside[top:bottom, left:right] = True
            mask = mask & inside
        return mask


_PROTOCOLS = (
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
PROTOCOLS: dict[str, Protocol] = {protocol.name: protocol for protocol in _PROTOCOLS}
"""The named protocols, each with its one-line summary."""


def protocol(name: str) -> Protocol:
    """Return a named protocol."""
    return PROTOCOLS[one_of("protocol", name, PROTOCOLS)]


@dataclass(frozen=True, slots=True)
class Sample:
    """The pixels of one image that a protocol compares, scaled and clamped."""

    prediction: Float[Tensor, " n"]
    """Predicted depth in meters, float64."""
    target: Float[Tensor, " n"]
    """True depth in meters, float64."""
    mask: Bool[Tensor, "h w"]
    """Where they lie in the ground truth, row by row: ``some_map[mask]`` follows the same order."""
    ratio: Float[Tensor, ""]
    """median(truth)/median(prediction), whether or not it was applied; NaN with no pixels."""


@dataclass(frozen=True, slots=True)
class ImageErrors:
    """What a protocol says about one image."""

    errors: Float[Tensor, "7"]
    """As in `saunet.metrics.functional.ERROR_NAMES`, float64; NaN with no pixels."""
    ratio: Float[Tensor, ""]
    """median(truth)/median(prediction), whether or not it was applied; NaN with no pixels."""
    pixels: int
    """Number of pixels compared."""


def sample_image(disparity: Float[Tensor, "h w"], ground_truth: Float[Tensor, "hg wg"], protocol: Protocol) -> Sample:
    """Bring a prediction to the pixels that a protocol compares.

    Args:
        disparity: Inverse depth at any size; resized bilinearly with half-pixel centers; 0 and below is far away.
        ground_truth: Depth in meters at its native size, 0 where unknown; 0 x 0 for an image without any.
        protocol: The rules.

    Returns:
        Prediction and truth, pixel by pixel.
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
    """Resize a disparity map bilinearly with half-pixel centers, in single precision or better, and keep it positive.

    Args:
        disparity: Inverse depth.
        size: (height, width).
    """
    single = disparity.to(torch.promote_types(disparity.dtype, torch.float32))[None, None]
    # The floor lies far below any real disparity (a billion meters): it keeps medians and products finite.
    return interpolate(single, size=size, mode="bilinear", align_corners=False)[0, 0].clamp(min=1e-9)


def evaluate_image(
    disparity: Float[Tensor, "h w"], ground_truth: Float[Tensor, "hg wg"], protocol: Protocol
) -> ImageErrors:
    """Compute the seven errors of one image under a protocol; arguments as in `sample_image`."""
    return sample_errors(sample_image(disparity, ground_truth, protocol))


def sample_errors(sample: Sample) -> ImageErrors:
    """Compute the seven errors over the pixels of a sample."""
    errors = root_terms(error_terms(sample.prediction, sample.target).mean(-1))
    return ImageErrors(errors, sample.ratio, sample.target.numel())
