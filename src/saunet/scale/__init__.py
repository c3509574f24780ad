"""Metric scale without ground truth: what turns relative depth into meters, measured over many frames."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from saunet.scale.options import METHODS, ScaleOptions

if TYPE_CHECKING:
    from saunet.scale.estimate import ScaleEstimate, estimate_scale
    from saunet.scale.network import MetricDepth, MetricMotion

__all__ = ["METHODS", "MetricDepth", "MetricMotion", "ScaleEstimate", "ScaleOptions", "estimate_scale"]

_HOMES = {
    "MetricDepth": "network",
    "MetricMotion": "network",
    "ScaleEstimate": "estimate",
    "estimate_scale": "estimate",
}


def __getattr__(name: str) -> Any:
    """Import on first use: the options alone must not cost torch."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
