"""Metric scale without ground truth: what turns relative depth into meters, measured over many frames."""

from __future__ import annotations

from typing import TYPE_CHECKING

from saunet.lazy import lazily
from saunet.scale.options import METHODS, ScaleOptions

if TYPE_CHECKING:
    from saunet.scale.estimate import MetricDepth, MetricMotion, ScaleEstimate, estimate_scale

__all__ = ["METHODS", "MetricDepth", "MetricMotion", "ScaleEstimate", "ScaleOptions", "estimate_scale"]
__getattr__ = lazily(__name__, {"estimate": "MetricDepth MetricMotion ScaleEstimate estimate_scale"})
