"""Periodic pictures to paint materials on: band-limited noise and anti-aliased rectangles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SIZE = 256
"""Pixels of one period of a material, a power of two."""

Canvas = NDArray[np.float64]
"""2 x SIZE x SIZE: luminance and mask."""

Number = float | int
"""Whole numbers are welcome; a checker at run time takes ``float`` at its word."""


def blank(luminance: Number = 1.0, mask: Number = 0.0) -> Canvas:
    """Return a plain canvas."""
    canvas = np.empty((2, SIZE, SIZE))
    canvas[0], canvas[1] = luminance, mask
    return canvas


def colored_noise(rng: np.random.Generator, low: Number, high: Number, slope: Number) -> NDArray[np.float64]:
    """Return periodic noise, n x n, Gaussian of mean 0 and deviation 1, within ``low``..``high`` cycles a period."""
    frequency = np.hypot(np.fft.fftfreq(SIZE)[:, None], np.fft.rfftfreq(SIZE)[None]) * SIZE
    inside = (frequency >= low) & (frequency <= high)
    gain = np.where(inside, np.maximum(frequency, 1.0) ** -slope, 0.0)
    field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((SIZE, SIZE))) * gain, (SIZE, SIZE))
    return np.asarray(field / field.std())


def coverage(start: Number, end: Number) -> NDArray[np.float64]:
    """Return how much of each of the n pixels of a row an interval covers; fractions of a period, wrapping around."""
    pixel = np.arange(-SIZE, 2 * SIZE, dtype=np.float64)
    covered = np.clip(np.minimum(pixel + 1, end * SIZE) - np.maximum(pixel, start * SIZE), 0, 1)
    return np.asarray(covered.reshape(3, SIZE).sum(axis=0).clip(0, 1))


def rectangle(canvas: Canvas, x0: Number, x1: Number, y0: Number, y1: Number, luminance: Number, mask: Number) -> None:
    """Paint an anti-aliased rectangle in place; positions are fractions of a period, y downwards."""
    alpha = coverage(y0, y1)[:, None] * coverage(x0, x1)[None]
    rows, columns = np.flatnonzero(alpha.any(axis=1)), np.flatnonzero(alpha.any(axis=0))
    if rows.size == 0 or columns.size == 0:
        return
    index = np.ix_(rows, columns)
    part = alpha[index]
    for channel, value in zip(canvas, (luminance, mask), strict=True):
        channel[index] += part * (value - channel[index])


def disc(canvas: Canvas, x: Number, y: Number, radius: Number, luminance: Number, mask: Number) -> None:
    """Paint an anti-aliased disc in place; fractions of a period."""
    center = (np.arange(SIZE) + 0.5) / SIZE
    distance = np.hypot(center[None] - x, center[:, None] - y)
    alpha = np.clip((radius - distance) * SIZE + 0.5, 0, 1)
    canvas[0] += alpha * (luminance - canvas[0])
    canvas[1] += alpha * (mask - canvas[1])
