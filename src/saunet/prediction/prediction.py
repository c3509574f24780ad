"""What a prediction is: depth at the image's own size, and whether it is meters."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from saunet.io.colormaps import colorize
from saunet.runs.record import Scale


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Depth of one image, at that image's size.

    Args:
        depth: Depth along the camera's z axis; see ``unit``.
        disparity: Its inverse.
        image: The image it belongs to, RGB.
        scale: The factor that has been applied to reach meters; None where only relative depth is known.
        name: Where the image came from, such as a file name.
    """

    depth: Float32[np.ndarray, "h w"]
    disparity: Float32[np.ndarray, "h w"]
    image: UInt8[np.ndarray, "h w 3"] = field(repr=False)
    scale: Scale | None = None
    name: str = "image"

    @property
    def metric(self) -> bool:
        """Whether ``depth`` is in meters."""
        return self.scale is not None

    @property
    def unit(self) -> str:
        """What one unit of ``depth`` is, for people."""
        return unit_of(self.scale)

    def color(self, limits: tuple[float, float] | None = None, colormap: str = "magma") -> UInt8[np.ndarray, "h w 3"]:
        """Return the disparity as an RGB picture, bright where it is near; see `saunet.io.colormaps.colorize`."""
        return colorize(self.disparity, limits, colormap)

    def _repr_png_(self) -> bytes:
        """Show image and disparity where a notebook displays the prediction."""
        pair = np.concatenate([self.image, self.color()], axis=0)
        return bytes(cv2.imencode(".png", cv2.cvtColor(pair, cv2.COLOR_RGB2BGR))[1].tobytes())


def unit_of(scale: Scale | None) -> str:
    """Return in words what one unit of depth is, given the scale that was applied."""
    return f"meters (scale from {scale.source})" if scale else "relative (meters times one unknown factor)"
