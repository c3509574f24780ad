"""One factor a frame, from what is known in meters: the camera's height, the way traveled, the stereo baseline."""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from saunet.geometry.ground import fit_ground

MIN_SUPPORT = 0.4
"""Share of the road region that must lie on the plane; with less, a frame's plane is not taken for the road."""
MIN_DISTANCE = 0.1
"""Meters traveled below which a frame says nothing about scale: the motion drowns in its error."""
MIN_MATCHES = 100
"""Pixels of a stereo pair that must be matched."""
_MIN_DISPARITY = 1.5  # pixels; an eighth of a pixel of matching error is then 8 % of depth at most
_LARGEST_DISPARITY = 0.15  # of the image's width


def height_factors(
    depth: Float[Tensor, "b 1 h w"], K: Float[Tensor, "b 3 3"], camera_height: float
) -> Float[Tensor, " b"]:
    """Camera height in meters over its height above the road in the predicted depth; NaN where no road is found."""
    plane = fit_ground(depth, K)
    return torch.where(plane.support >= MIN_SUPPORT, camera_height / plane.height, math.nan)


def speed_factors(T_src_tgt: Float[Tensor, "b s 4 4"], distance: Float[Tensor, "b s"]) -> Float[Tensor, " b"]:
    """Meters traveled over the predicted motion, all sources of a frame together; NaN where unknown or standing."""
    predicted = torch.linalg.vector_norm(T_src_tgt[..., :3, 3].double(), dim=-1)
    counts = distance.isfinite() & (distance >= MIN_DISTANCE)
    meters, length = (torch.where(counts, values, 0.0).sum(1) for values in (distance.double(), predicted))
    return torch.where((meters > 0) & (length > 0), meters / length, math.nan).to(distance)


def stereo_factors(
    depth: Float[Tensor, "b 1 h w"],
    image: Float[Tensor, "b 3 h w"],
    partner: Float[Tensor, "b 3 h w"],
    K: Float[Tensor, "b 3 3"],
    T_stereo_tgt: Float[Tensor, "b 4 4"],
) -> Float[Tensor, " b"]:
    """Median of depth by stereo matching over predicted depth; NaN where too few pixels match."""
    factors = []
    for i in range(len(depth)):
        across = float(T_stereo_tgt[i, 0, 3])
        disparity = _match(_gray(image[i]), _gray(partner[i]), partner_is_left=across > 0)
        found = disparity >= _MIN_DISPARITY
        predicted = depth[i, 0].detach().double().cpu().numpy()
        ratios = (float(K[i, 0, 0]) * abs(across) / disparity[found]) / predicted[found]
        factors.append(float(np.median(ratios)) if found.sum() >= MIN_MATCHES else math.nan)
    return depth.new_tensor(factors)


def _match(image: NDArray[np.uint8], partner: NDArray[np.uint8], partner_is_left: bool) -> NDArray[np.float64]:
    """Return the disparity of ``image`` by semi-global matching, pixels, 0 or less where unknown."""
    if partner_is_left:  # matching goes from the left image to the right one
        return _match(image[:, ::-1], partner[:, ::-1], False)[:, ::-1]
    block = 3 if image.shape[1] < 400 else 5
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=16 * max(1, round(_LARGEST_DISPARITY * image.shape[1] / 16)),
        blockSize=block,
        P1=8 * block**2,
        P2=32 * block**2,
        disp12MaxDiff=1,
        uniquenessRatio=10,
        speckleWindowSize=50,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_HH,
    )
    disparity = matcher.compute(np.ascontiguousarray(image), np.ascontiguousarray(partner))
    return np.asarray(disparity, np.float64) / 16


def _gray(image: Float[Tensor, "3 h w"]) -> NDArray[np.uint8]:
    picture = (image.detach().cpu().clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy()
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), np.uint8)
