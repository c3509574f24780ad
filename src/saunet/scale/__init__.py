"""Metric scale without ground truth: what turns relative depth into meters, measured over many frames."""

from __future__ import annotations

from saunet.scale.estimate import METHODS, ScaleEstimate, estimate_scale
from saunet.scale.network import MetricDepth, MetricMotion

__all__ = ["METHODS", "MetricDepth", "MetricMotion", "ScaleEstimate", "estimate_scale"]
