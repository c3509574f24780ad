"""Registered loss terms, which objectives add up."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from saunet.errors import ConfigError, in_range, one_of, positive
from saunet.geometry.depth import enlarge, median_ratio
from saunet.geometry.warp import FAR, backproject, project_each, sample, visible
from saunet.losses import one_pass
from saunet.losses.base import Term, TermResult, require
from saunet.losses.functional import (
    automask,
    combine_sources,
    depth_inconsistency,
    gradient_loss,
    masked_mean,
    photometric_error,
    pool_known,
    smoothness_loss,
)
from saunet.registry import terms
from saunet.types import DepthPyramid, TrainBatch, View, Views

_TARGETS = {
    "lidar": ("target_depth", "set data.target_depth=true, or target: image, which needs no ground truth"),
    "teacher": ("target_teacher", "set data.teacher=true with data=kitti, or target: image, which needs none"),
}


@terms.register("photometric")
class Photometric(Term):
    """Minimum reprojection error times auto-mask, SAU-Net eqs. (8)-(12), averaged over scales.

    A pixel that no source sees, or that shows the recording vehicle (the batch's ``target_mask``), has no error and is
    left out of the mean. With ``reduction: all`` and the auto-mask, it counts with its unwarped error, like every
    masked pixel. If no pixel is left, the loss is 0. Its maps are ``photometric_error``, and ``automask`` or, without
    one, ``visible``.

    Args:
        sources: ``minimum`` over the sources, eq. (10), or their ``mean``, eq. (6).
        ssim_weight: Weight of SSIM in the error, 0 to 1; the rest is the absolute difference.
        automask: Drop pixels that the unwarped sources explain better, eq. (11).
        reduction: Mean over the used pixels (``masked``), or over all with the smaller of the warped and unwarped
            error (``all``, Monodepth2's code).
        use_validity: Ignore a source if the point leaves its image or lies behind its camera. Otherwise such pixels are
            compared with the border color, as in Monodepth2.
        noise: Standard deviation of the noise that decides ties of the auto-mask while training.
    """

    def __init__(
        self,
        sources: Literal["minimum", "mean"] = "minimum",
        ssim_weight: float = 0.85,
        automask: bool = True,
        reduction: Literal["masked", "all"] = "masked",
        use_validity: bool = True,
        noise: float = 1e-5,
    ) -> None:
        super().__init__()
        self.sources = one_of("sources", sources, ("minimum", "mean"))
        self.ssim_weight = in_range("ssim_weight", ssim_weight, 0, 1)
        self.automask = automask
        self.reduction = one_of("reduction", reduction, ("masked", "all"))
        self.use_validity = use_validity
        self.noise = positive("noise", noise, allow_zero=True)

    def forward(
        self, batch: TrainBatch, pyramid: DepthPyramid, poses: Float[Tensor, "b s 4 4"], views: Sequence[View]
    ) -> TermResult:
        if isinstance(views, Views) and one_pass.takes(batch):
            return self._in_one_pass(batch, pyramid, poses)
        target = batch["loss_target"][:, None]
        identity = self._identity(batch["loss_sources"], target) if self.automask else None
        values: list[Tensor] = []
        maps: dict[str, Tensor] = {}
        for view in views:
            errors = photometric_error(view.image, target, self.ssim_weight)
            error, known = combine_sources(errors, view.valid if self.use_validity else None, self.sources)
            if "target_mask" in batch:
                known = known & (batch["target_mask"] > 0.5)
            value, mask = self._reduce(error, known, identity)
            values.append(value)
            if not maps:
                kind = "automask" if self.automask else "visible"
                maps = {"photometric_error": error.detach(), kind: mask.to(error.dtype)}
        return TermResult(value=torch.stack(values).mean(), maps=maps)

    def _in_one_pass(self, batch: TrainBatch, pyramid: DepthPyramid, poses: Float[Tensor, "b s 4 4"]) -> TermResult:
        """Compute `forward` without the views."""
        target, noise = batch["loss_target"], None
        if self.automask and self.training and self.noise > 0:
            noise = torch.stack([self.noise * torch.randn_like(target[:, 0]) for _ in pyramid.disparity])
        disparities = [enlarge(disparity, *target.shape[-2:]) for disparity in pyramid.disparity]
        choices = one_pass.Choices(
            self.ssim_weight, self.sources == "minimum", self.automask, self.reduction == "masked", self.use_validity
        )
        values, error, counted = one_pass.photometric(
            poses, batch["K"], target, batch["loss_sources"], noise, disparities, choices
        )
        kind = "automask" if self.automask else "visible"
        return TermResult(value=values.mean(), maps={"photometric_error": error, kind: counted})

    @torch.no_grad()
    def _identity(self, sources: Tensor, target: Tensor) -> Tensor:
        """Return the error of the unwarped sources, which is the same for every scale and has no gradient."""
        return combine_sources(photometric_error(sources, target, self.ssim_weight), None, self.sources)[0]

    def _reduce(
        self, error: Float[Tensor, "b 1 h w"], known: Bool[Tensor, "b 1 h w"], identity: Float[Tensor, "b 1 h w"] | None
    ) -> tuple[Tensor, Tensor]:
        """Return the mean error and the pixels used."""
        if identity is None:
            return masked_mean(error, known), known
        mask = known & automask(error, identity, self.noise if self.training else 0.0)
        if self.reduction == "all":
            return torch.where(mask, error, identity).mean(), mask
        return masked_mean(error, mask), mask


@terms.register("photometric_monodepth2")
class Monodepth2Photometric(Photometric):
    """The photometric term with Monodepth2's choices: mean over all pixels, border color outside the picture."""

    def __init__(
        self,
        sources: Literal["minimum", "mean"] = "minimum",
        ssim_weight: float = 0.85,
        automask: bool = True,
        reduction: Literal["masked", "all"] = "all",
        use_validity: bool = False,
        noise: float = 1e-5,
    ) -> None:
        super().__init__(sources, ssim_weight, automask, reduction, use_validity, noise)


@terms.register("smoothness")
class Smoothness(Term):
    """Edge-aware smoothness of the mean-normalized disparity (Monodepth2 eq. (3)), averaged over scales.

    Each scale is compared at its own size with the reduced image, and weighted by 1/2**scale. As in Monodepth2, it uses
    the network's relative disparity (its sigmoid).
    """

    can_be_empty = False

    def forward(
        self, batch: TrainBatch, pyramid: DepthPyramid, poses: Float[Tensor, "b s 4 4"], views: Sequence[View]
    ) -> TermResult:
        return TermResult(value=_multiscale_smoothness(pyramid.sigmoid, batch["loss_target"]))


def _multiscale_smoothness(
    disparities: Sequence[Float[Tensor, "b 1 _ _"]], image: Float[Tensor, "b 3 h w"]
) -> Float[Tensor, ""]:
    """Return the mean over scales of the smoothness times 1/2**scale, which makes a step one per pixel of the image."""
    values = []
    for disparity in disparities:
        height, width = disparity.shape[-2:]
        small = image if (height, width) == image.shape[-2:] else F.adaptive_avg_pool2d(image, (height, width))
        values.append(smoothness_loss(disparity, small) * (width / image.shape[-1]))
    return torch.stack(values).mean()


@terms.register("gradient")
class Gradient(Term):
    """Gradient loss, SAU-Net eq. (13), against a selectable target g*, averaged over scales.

    Every scale is compared at its own size (a target pixel is the mean of the known pixels it covers) and weighted by
    1/2**scale, which makes a difference between neighbors one per pixel of the image. Only gradients between known
    pixels count, so the target may be sparse.

    Args:
        target: ``image``: no ground truth, edge-aware smoothness of the mean-normalized disparity (of the other
            parameters only ``scales`` applies); ``lidar``: depth measured by a scanner, meters; ``teacher``: depth
            predicted by another model.
        domain: The compared quantity: ``depth`` as printed (metric, so it sets the scale of the network); ``log_depth``
            and ``aligned`` (prediction times the median ratio, without its gradient), which leave the scale free;
            ``disparity``.
        operator: ``forward`` differences as printed, or ``sobel`` (LapDepth's, un-normalized).
        padding: Padding of ``sobel``: ``replicate``, or ``zero`` (LapDepth's), which supervises values at the border.
        scales: Scales to compare; None for all. LapDepth's is ``[0]``.
    """

    def __init__(
        self,
        target: Literal["image", "lidar", "teacher"] = "image",
        domain: Literal["depth", "log_depth", "disparity", "aligned"] = "aligned",
        operator: Literal["forward", "sobel"] = "forward",
        padding: Literal["replicate", "zero"] = "replicate",
        scales: Sequence[int] | None = None,
    ) -> None:
        super().__init__()
        self.target = one_of("target", target, ("image", *_TARGETS))
        self.can_be_empty = target != "image"
        self.domain = one_of("domain", domain, ("depth", "log_depth", "disparity", "aligned"))
        self.operator = one_of("operator", operator, ("forward", "sobel"))
        self.padding = one_of("padding", padding, ("replicate", "zero"))
        self.scales = None if scales is None else tuple(scales)
        if self.scales == ():
            raise ConfigError("gradient.scales is empty; name at least one scale, such as [0], or null for all")

    def forward(
        self, batch: TrainBatch, pyramid: DepthPyramid, poses: Float[Tensor, "b s 4 4"], views: Sequence[View]
    ) -> TermResult:
        predicted = range(len(pyramid.depth))
        chosen = predicted if self.scales is None else self.scales
        for scale in chosen:
            if scale not in predicted:
                raise ConfigError(f"gradient.scales holds {scale} but the network predicts scales 0 to {predicted[-1]}")
        if self.target == "image":
            disparities = [pyramid.disparity[scale] for scale in chosen]
            return TermResult(value=_multiscale_smoothness(disparities, batch["loss_target"]))
        key, fix = _TARGETS[self.target]
        full = require(batch, key, f"the gradient term with target '{self.target}'", fix)
        values = []
        for scale in chosen:
            depth = pyramid.depth[scale]
            target = pool_known(full, depth.shape[-2], depth.shape[-1])
            values.append(self.compare(depth, target) * (depth.shape[-1] / full.shape[-1]))
        return TermResult(value=torch.stack(values).mean())

    def compare(self, depth: Float[Tensor, "b 1 h w"], target: Float[Tensor, "b 1 h w"]) -> Float[Tensor, ""]:
        """Return eq. (13) for one scale."""
        known = (target > 0) & depth.isfinite()
        target = torch.where(known, target, 1.0)  # masked out below, but its logarithm must be finite
        if self.domain == "log_depth":
            depth, target = depth.log(), target.log()
        elif self.domain == "disparity":
            depth, target = depth.reciprocal(), target.reciprocal()
        elif self.domain == "aligned":
            depth = depth * median_ratio(depth.detach(), target, known)[:, None, None, None]
        return gradient_loss(depth, target, known, self.operator, self.padding)


@terms.register("consistency")
class Consistency(Term):
    """Geometry consistency of SC-Depth: a target point's depth in a source camera against the depth predicted there.

    The mean relative difference at full resolution over all points visible in a source. It needs predicted depth of the
    sources, one more forward pass each.
    """

    needs_source_depth = True

    def forward(
        self, batch: TrainBatch, pyramid: DepthPyramid, poses: Float[Tensor, "b s 4 4"], views: Sequence[View]
    ) -> TermResult:
        fix = "use a training step that predicts depth for the sources"
        depth = require(batch, "source_depth", "the consistency term", fix)
        points = backproject(pyramid.depth[0].clamp(max=FAR), batch["K"])
        pixels, z = project_each(points, batch["K"], poses)
        found = sample(depth.clamp(max=FAR), pixels)[:, :, 0]
        seen = visible(pixels, z, *depth.shape[-2:])
        expected = torch.where(seen, z, 1.0)
        return TermResult(value=masked_mean(depth_inconsistency(expected, found), seen))


@terms.register("velocity")
class Velocity(Term):
    """Difference between predicted and true distance traveled, | ||t|| - speed * dt |, in meters (PackNet).

    The distance comes from ``batch["distance"]`` (NaN where unknown) or, if that is missing, from the true motion
    ``batch["T_src_tgt"]``. It makes depth metric; PackNet's weight is 0.1. A stereo view, whose motion is known,
    does not count.
    """

    def forward(
        self, batch: TrainBatch, pyramid: DepthPyramid, poses: Float[Tensor, "b s 4 4"], views: Sequence[View]
    ) -> TermResult:
        predictions = poses.shape[1] - ("T_stereo_tgt" in batch)
        if predictions == 0:
            raise ConfigError(
                "the velocity term compares predicted motion, but the stereo view is the only source; drop the "
                "term, or set data.offsets=[-1,1]"
            )
        if "distance" not in batch and "T_src_tgt" in batch:
            distance = torch.linalg.vector_norm(batch["T_src_tgt"][..., :3, 3], dim=-1)
        else:
            fix = "set data.with_speed=true if the data set has speeds or poses, or drop the term"
            distance = require(batch, "distance", "the velocity term", fix)
        # The norm's gradient at zero motion is 0, not NaN.
        predicted = torch.linalg.vector_norm(poses[:, :predictions, :3, 3], dim=-1)
        distance = distance[:, :predictions]
        known = distance.isfinite()
        return TermResult(value=masked_mean((predicted - distance.where(known, 0.0)).abs(), known))


@terms.register("tracked_motion")
class TrackedMotion(Term):
    """Difference between the pose network's motion and that of tracked points.

    With ``data.track_motion`` the points' motion replaces the predicted one, so the network learns only from this term.
    Per motion: the angle between the rotations in radians times ``angle``, plus the distance between the translations
    relative to the tracked length, if there is one.

    Args:
        angle: Weight of one radian.
    """

    def __init__(self, angle: float = 10.0) -> None:
        super().__init__()
        self.angle = positive("angle", angle)

    def forward(
        self, batch: TrainBatch, pyramid: DepthPyramid, poses: Float[Tensor, "b s 4 4"], views: Sequence[View]
    ) -> TermResult:
        fix = "set data.track_motion=true, or drop the term"
        tracked = require(batch, "T_tracked", "the tracked_motion term", fix)
        predicted = require(batch, "T_predicted", "the tracked_motion term", fix)
        known = tracked.isfinite().flatten(2).all(-1)
        off = predicted - tracked.where(known[..., None, None], 0.0)
        turn = torch.linalg.vector_norm(off[..., :3, :3].flatten(2), dim=-1) / 2**0.5
        length = torch.linalg.vector_norm(tracked[..., :3, 3], dim=-1)
        moves = known & (length > 0)
        way = torch.linalg.vector_norm(off[..., :3, 3], dim=-1) / length.where(moves, 1.0)
        return TermResult(value=self.angle * masked_mean(turn, known) + masked_mean(way, moves))
