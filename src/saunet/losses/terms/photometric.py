"""The primary loss: how well the warped sources explain the target."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from saunet.errors import in_range, one_of, positive
from saunet.losses.base import Term, TermResult
from saunet.losses.functional import automask, combine_sources, masked_mean, photometric_error
from saunet.registry import terms
from saunet.types import DepthPyramid, TrainBatch, View


@terms.register("photometric")
class Photometric(Term):
    """Minimum reprojection error times auto-mask, SAU-Net eqs. (8)-(12), averaged over scales.

    A pixel that no source sees has no error: it is left out of the mean (with ``reduction: all`` and the auto-mask, it
    counts with its unwarped error, like every pixel that does not teach). If no pixel is left, the loss is 0.

    Args:
        sources: ``minimum`` over the sources, eq. (10), or their ``mean``, eq. (6).
        ssim_weight: Weight of SSIM in the error, 0 to 1; the rest is the absolute difference.
        automask: Drop pixels that the unwarped sources explain better, eq. (11).
        reduction: Mean over the pixels that teach (``masked``), or over all with the smaller of the warped and unwarped
            error (``all``, Monodepth2's code).
        use_validity: Ignore a source where the point leaves its image or lies behind its camera. Without it such pixels
            compare with the border color, as Monodepth2 does.
        noise: Standard deviation of the noise that decides ties of the auto-mask while training.

    Raises:
        ConfigError: for a word or number outside its range.
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
        self,
        batch: TrainBatch,
        pyramid: DepthPyramid,
        poses: Float[Tensor, "b s 4 4"],
        views: Sequence[View],
    ) -> TermResult:
        """Return the mean over scales; maps: ``photometric_error``, and ``automask`` or, without one, ``visible``."""
        target = batch["loss_target"][:, None]
        identity = self._identity(batch["loss_sources"], target) if self.automask else None
        values: list[Tensor] = []
        maps: dict[str, Tensor] = {}
        for view in views:
            errors = photometric_error(view.image, target, self.ssim_weight)
            error, known = combine_sources(errors, view.valid if self.use_validity else None, self.sources)
            value, mask = self._reduce(error, known, identity)
            values.append(value)
            if not maps:
                kind = "automask" if self.automask else "visible"
                maps = {"photometric_error": error.detach(), kind: mask.to(error.dtype)}
        return TermResult(value=torch.stack(values).mean(), maps=maps)

    @torch.no_grad()
    def _identity(self, sources: Tensor, target: Tensor) -> Tensor:
        """Error of the unwarped sources: the same for every scale, and nothing learns from it."""
        return combine_sources(photometric_error(sources, target, self.ssim_weight), None, self.sources)[0]

    def _reduce(
        self, error: Float[Tensor, "b 1 h w"], known: Bool[Tensor, "b 1 h w"], identity: Float[Tensor, "b 1 h w"] | None
    ) -> tuple[Tensor, Tensor]:
        """Return the mean error and the pixels that teach."""
        if identity is None:
            return masked_mean(error, known), known
        mask = known & automask(error, identity, self.noise if self.training else 0.0)
        if self.reduction == "all":
            return torch.where(mask, error, identity).mean(), mask
        return masked_mean(error, mask), mask


@terms.register("photometric_monodepth2")
class Monodepth2Photometric(Photometric):
    """The photometric term with Monodepth2's choices: mean over all pixels, border color outside the picture.

    Args:
        sources: See `Photometric`.
        ssim_weight: See `Photometric`.
        automask: See `Photometric`.
        reduction: See `Photometric`.
        use_validity: See `Photometric`.
        noise: See `Photometric`.
    """

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
