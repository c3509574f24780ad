"""Depth for every pixel by colorization: depth spreads between similar neighbors (Levin et al. 2004).

The weights are those of the NYU toolbox's ``fill_depth_colorization``. The equations are solved directly in 32-bit
numbers, and rounding is then removed with 64-bit residuals.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from numpy import ndarray

from saunet.errors import DataError
from saunet.tools.prepare.sparse_solver import NEIGHBORS, StencilSolver, apply_stencil

TOLERANCE = 1e-5
"""Estimated error, relative to the pixel's own value, at which a solution is accepted."""
_ROUNDS = 5


def affinity(gray: Float[ndarray, "h w"]) -> Float[ndarray, "9 h w"]:
    """Return the weight of each pixel's neighbors in its own value, summing to 1; 0 for itself and out of the image.

    With v the variance of the 3 x 3 window, s = max(0.6 v, -min (g_n - g)**2 / ln 0.01, 2e-6) and the weight of
    neighbor n is exp(-(g_n - g)**2 / s), normalized; n in the order of `NEIGHBORS`.
    """
    height, width = gray.shape
    difference = np.zeros((9, height, width))
    for plane, (row, column) in zip(difference, NEIGHBORS, strict=True):
        here = _shifted(height, row), _shifted(width, column)
        there = _shifted(height, -row), _shifted(width, -column)
        np.subtract(gray[there], gray[here], out=plane[here])
    count = apply_stencil(np.ones_like(difference), np.ones_like(gray))  # pixels of the window in the image
    mean = difference.sum(0) / count
    difference *= difference
    variance = difference.sum(0) / count - mean * mean
    for plane, (row, column) in zip(difference, NEIGHBORS, strict=True):
        if row:
            plane[0 if row < 0 else -1] = np.inf
        if column:
            plane[:, 0 if column < 0 else -1] = np.inf
    difference[4] = np.inf
    spread = np.maximum(np.maximum(0.6 * variance, difference.min(0) / -np.log(0.01)), 2e-6)
    difference /= -spread
    weights: ndarray = np.exp(difference, out=difference)
    weights /= weights.sum(0)
    return weights


def _shifted(length: int, step: int) -> slice:
    """Return the pixels from which a step stays inside."""
    return slice(max(0, -step), length - max(0, step))


def colorize(image: UInt8[ndarray, "_ _ 3"], depth: Float32[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
    """Return depth at every pixel: measured where known, else spread, by (I - W + diag(known)) x = known depth."""
    if image.shape[:2] != depth.shape or min(depth.shape) < 2:
        raise DataError(f"depth of shape {depth.shape} does not belong to an image of shape {image.shape}")
    known = depth > 0
    if not known.any():
        raise DataError("the depth map has no known pixel, so there is nothing to spread")
    gray = image @ (np.array([0.299, 0.587, 0.114]) / 255)
    stencil = -affinity(gray)
    stencil[4] = 1.0 + known
    top = float(depth.max())
    spread = _solve(stencil, depth.astype(np.float64) / top) * top
    return np.where(known, depth, spread).astype(np.float32)


def _solve(stencil: Float[ndarray, "9 h w"], right: Float[ndarray, "h w"]) -> Float[ndarray, "h w"]:
    # Couplings across an image fade to numbers that processors handle in slow motion unless told to take them for 0.
    torch.set_flush_denormal(True)
    try:
        for dtype in (torch.float32, torch.float64):
            solver = StencilSolver(stencil, dtype)
            x = solver.solve(right).astype(np.float64)
            before = 1.0
            for _ in range(_ROUNDS):
                change = solver.solve(right - apply_stencil(stencil, x)).astype(np.float64)
                x += change
                now = float((np.abs(change) / np.maximum(np.abs(x), 1e-12)).max())
                if now * min(now / before, 1.0) <= TOLERANCE:  # the next change would be smaller by the same factor
                    return x
                before = now
        return x
    finally:
        torch.set_flush_denormal(False)
