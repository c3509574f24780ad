"""Scoring models and predictions against ground truth, and the camera's path against true poses."""

from __future__ import annotations

from saunet.evaluation.files import write_results
from saunet.evaluation.predictors import NetworkPredictor, Predictor
from saunet.evaluation.result import EvaluationResult
from saunet.evaluation.scoring import score
from saunet.evaluation.tool import EvaluateOptions, evaluate
from saunet.evaluation.tool_odometry import OdometryOptions, OdometryResult, odometry

__all__ = [
    "EvaluateOptions",
    "EvaluationResult",
    "NetworkPredictor",
    "OdometryOptions",
    "OdometryResult",
    "Predictor",
    "evaluate",
    "odometry",
    "score",
    "write_results",
]
