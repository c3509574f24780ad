"""Scoring predictors against ground truth: running, summarising, comparing, writing."""

from __future__ import annotations

from saunet.evaluation.result import EvaluationResult, ImageRow, Summary
from saunet.evaluation.runner import NetworkPredictor, Predictor, evaluate
from saunet.evaluation.writers import print_table, write_results

__all__ = [
    "EvaluationResult",
    "ImageRow",
    "NetworkPredictor",
    "Predictor",
    "Summary",
    "evaluate",
    "print_table",
    "write_results",
]
