"""Scores of one depth map against one ground truth: errors, the median, crops, flip post-processing."""

from __future__ import annotations

from fractions import Fraction
from typing import Literal, TypeAlias

import torch
from jaxtyping import Float
from torch import Tensor

from saunet.errors import one_of

ABS_REL, SQ_REL, RMSE, RMSE_LOG, A1, A2, A3 = range(7)
"""Indices in vectors of errors."""
ERROR_NAMES: tuple[str, ...] = ("abs_rel", "sq_rel", "rmse", "rmse_log", "a1", "a2", "a3")
"""The seven depth errors in the field's column order."""
ERROR_HEADINGS: tuple[str, ...] = ("Abs Rel ↓", "Sq Rel ↓", "RMSE ↓", "RMSE log ↓", "δ1 ↑", "δ2 ↑", "δ3 ↑")
RISING: tuple[str, ...] = ERROR_NAMES[A1:]
"""The scores for which larger is better."""

Crop: TypeAlias = Literal["garg", "cityscapes", "nyu", "none"]
CROPS: dict[str, tuple[float | Fraction, float | Fraction, float | Fraction, float | Fraction]] = {
    "garg": (0.40810811, 0.99189189, 0.03594771, 0.96405229),
    "cityscapes": (Fraction(256, 768), 1, Fraction(192, 2048), Fraction(1856, 2048)),
    "nyu": (Fraction(45, 480), Fraction(471, 480), Fraction(41, 640), Fraction(601, 640)),
    "none": (0, 1, 0, 1),
}
"""Top, bottom, left and right end of the evaluated part, as fractions of the height and width of the ground truth. Garg
et al., 2016, for KITTI; ManyDepth (Watson et al., 2021) for Cityscapes without the bottom quarter, which shows the car;
and the part of NYU's frames that Eigen et al., 2014, evaluate."""


def error_terms(prediction: Float[Tensor, " *shape"], target: Float[Tensor, " *shape"]) -> Float[Tensor, "k=7 *shape"]:
    """Compute each pixel's part in the seven Eigen errors, SAU-Net eqs. (15)-(19), float64, from depth in meters.

    These are the standard definitions, because the printed equations have errors: with ``d`` the prediction and ``D*``
    the truth, mean
    |d-D*|/D*; mean (d-D*)²/D*; root of mean (d-D*)²; root of mean (ln d - ln D*)²; and the fraction of pixels with
    max(d/D*, D*/d) below 1.25, 1.25², 1.25³. RMSE and RMSE log are still squared here (see `root_terms`).
    """
    d, truth = prediction.double(), target.double()
    quotient, off = d / truth, (d - truth).abs()
    ratio, squared = torch.maximum(quotient, truth / d), off.square()
    terms = [off / truth, squared / truth, squared, quotient.log().square()]
    return torch.stack((*terms, *((ratio < 1.25**power).double() for power in (1, 2, 3))))


def root_terms(mean_terms: Float[Tensor, "*shape 7"]) -> Float[Tensor, "*shape 7"]:
    """Turn means of `error_terms` into errors: the root of the two squared ones."""
    columns = list(mean_terms.unbind(-1))
    for squared in (RMSE, RMSE_LOG):
        columns[squared] = columns[squared].sqrt()
    return torch.stack(columns, -1)


def median(values: Float[Tensor, " n"]) -> Float[Tensor, ""]:
    """Return the true median (the mean of the two middle values for an even count); NaN without values.

    `torch.median` returns the lower of the two, which moves the published numbers.
    """
    count = values.numel()
    if count == 0:
        return values.new_full((), float("nan"))
    lower = values.kthvalue((count + 1) // 2).values  # much faster than a sort
    if count % 2:
        return lower
    # The next larger value, unless the lower one occurs again; a second search would cost as much as the first.
    above = torch.where(values > lower, values, torch.inf).min()
    return (lower + torch.where((values <= lower).sum() > count // 2, lower, above)) / 2


def crop_window(name: str, height: int, width: int) -> tuple[int, int, int, int]:
    """Return the evaluated part of an image, (top, bottom, left, right), ends exclusive.

    The products are taken exactly or in double precision and truncated, as published code does: at 370x1226 Garg's last
    row is 366.9999993, hence 366; single precision would give 367.
    """
    top, bottom, left, right = CROPS[one_of("crop", name, CROPS)]
    return int(top * height), int(bottom * height), int(left * width), int(right * width)


def flip_blend(
    disparity: Float[Tensor, "b 1 h w"], disparity_of_flipped: Float[Tensor, "b 1 h w"]
) -> Float[Tensor, "b 1 h w"]:
    """Blend the disparity of an image with that of its mirror image, still mirrored (Monodepth's post-processing).

    The left 5 % uses only the mirrored prediction and the right 5 % only the direct one (each saw more context there);
    the middle is their average, with linear ramps between.
    """
    width = disparity.shape[-1]
    other = disparity_of_flipped.flip(-1)
    x = torch.linspace(0, 1, width, dtype=torch.float64, device=disparity.device)
    left = 1 - (20 * (x - 0.05)).clamp(0, 1)
    right = left.flip(0)
    mean = (disparity + other) / 2
    return (right * disparity + left * other + (1 - left - right) * mean).to(disparity.dtype)
