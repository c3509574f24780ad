"""Paint on the road, box-filtered in closed form, so that lines stay lines at any distance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from saunet.synthetic.world import World

F32 = NDArray[np.float32]


def _covered(position: F32, low: float, high: float, pixel: F32) -> F32:
    """Share of a pixel that lies in an interval."""
    share: F32 = np.clip((np.minimum(position + pixel / 2, high) - np.maximum(position - pixel / 2, low)) / pixel, 0, 1)
    return share


def _dashed(position: F32, dash: float, gap: float, pixel: F32) -> F32:
    """Share of a pixel that lies on dashes which repeat for ever."""
    period = dash + gap

    ends = np.stack([position - pixel / 2, position + pixel / 2])
    whole = np.floor(ends / period)
    painted = whole * dash + np.minimum(ends - whole * period, dash)  # length of paint up to here
    share: F32 = (painted[1] - painted[0]) / pixel
    return share


def markings(world: World, along: F32, across: F32, step_along: F32, step_across: F32) -> F32:
    """How much of each pixel is paint: center line, edge lines and zebra crossings, exactly box-filtered."""
    step_along, step_across = np.maximum(step_along, 1e-3), np.maximum(step_across, 1e-3)
    section = world.section
    dash, gap = world.dashes
    paint = _covered(across, -0.07, 0.07, step_across) * _dashed(along, dash, gap, step_along)
    line = section.half_width - (2.15 if section.parking else 0.3)
    lines = _covered(np.abs(across), line - 0.06, line + 0.06, step_across)
    paint = paint + (lines * _dashed(along, 1.0, 1.0, step_along) if section.parking else lines)
    for start in world.crossings:
        stripes = _dashed(across, 0.5, 0.5, step_across) * _covered(
            np.abs(across), -1.0, section.half_width - 0.4, step_across
        )
        paint = paint + _covered(along, start, start + 3.2, step_along) * (stripes - paint)
    clipped: F32 = np.clip(paint, 0, 1)
    return clipped
