"""Scoring models and predictions against ground truth, and the camera's path against true poses."""

from __future__ import annotations

from saunet.evaluation.files import write_results
from saunet.evaluation.paths import OdometryOptions, odometry
from saunet.evaluation.predictors import NetworkPredictor
from saunet.evaluation.scoring import score
from saunet.evaluation.tool import EvaluateOptions, evaluate

__all__ = ["EvaluateOptions", "NetworkPredictor", "OdometryOptions", "evaluate", "odometry", "score", "write_results"]
