"""Numbers as pictures: disparity in colors, errors in colors, and depth as KITTI's 16-bit PNG."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8, UInt16

from saunet.errors import ConfigError, in_range, one_of

_MAPS = {
    "magma": cv2.COLORMAP_MAGMA,
    "inferno": cv2.COLORMAP_INFERNO,
    "viridis": cv2.COLORMAP_VIRIDIS,
    "turbo": cv2.COLORMAP_TURBO,
}
COLORMAPS: tuple[str, ...] = (*_MAPS, "gray")


def value_range(values: Float[np.ndarray, "..."], low: float = 0.5, high: float = 98.0) -> tuple[float, float]:
    """Return the percentiles ``low`` and ``high`` of the finite values, a range robust to a few outliers."""
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return 0.0, 1.0
    bottom, top = (float(value) for value in np.percentile(finite, [low, high]))
    return (bottom, top) if top > bottom else (bottom, bottom + max(abs(bottom), 1.0) * 1e-3)


class RunningRange:
    """Color limits that follow a clip slowly: an exponential average of the frames' ranges."""

    def __init__(self, smoothing: float | int = 0.95) -> None:
        self.smoothing = in_range("range_smoothing", smoothing, 0.0, 0.999999)
        self._limits: tuple[float, float] | None = None

    def update(self, values: Float[np.ndarray, "h w"]) -> tuple[float, float]:
        """Return the limits after seeing one more frame; the first frame sets them."""
        low, high = value_range(values)
        if self._limits is not None:
            low = self.smoothing * self._limits[0] + (1 - self.smoothing) * low
            high = self.smoothing * self._limits[1] + (1 - self.smoothing) * high
        self._limits = (low, high)
        return self._limits


def colorize(
    values: Float[np.ndarray, "h w"],
    limits: tuple[float, float] | None = None,
    colormap: str = "magma",
    mask: Bool[np.ndarray, "h w"] | None = None,
) -> UInt8[np.ndarray, "h w 3"]:
    """Paint a map of numbers; disparity comes out bright where it is near."""
    one_of("colormap", colormap, COLORMAPS)
    shown = np.isfinite(values) if mask is None else np.isfinite(values) & mask
    if limits is None:
        limits = value_range(values[shown])
    low, high = limits
    if not low < high:
        raise ConfigError(f"color limits are {low} to {high}; the first must be below the second")
    filled = np.where(shown, values, low)
    levels = np.round(np.clip((filled - low) / (high - low), 0, 1) * 255).astype(np.uint8)
    if colormap == "gray":
        painted = cv2.cvtColor(levels, cv2.COLOR_GRAY2RGB)
    else:
        painted = cv2.cvtColor(cv2.applyColorMap(levels, _MAPS[colormap]), cv2.COLOR_BGR2RGB)
    painted[~shown] = 0
    return painted


def depth_to_png16(depth: Float[np.ndarray, "h w"]) -> UInt16[np.ndarray, "h w"]:
    """Return depth as KITTI's 16-bit integers, meters x 256: 65535 is 255.996 m or more, 0 unknown, as inf and NaN."""
    valid = np.isfinite(depth) & (depth > 0)  # clipped to at least 1 below, because 0 means unknown
    steps = np.round(np.where(valid, depth, 0).astype(np.float64) * 256)
    return np.where(valid, np.clip(steps, 1, 65535), 0).astype(np.uint16)
