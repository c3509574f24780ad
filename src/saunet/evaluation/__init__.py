"""Scoring predictors against ground truth: running, summarizing, comparing, writing."""

from __future__ import annotations

from saunet.evaluation.result import EvaluationResult, ImageRow, Summary
from saunet.evaluation.runner import NetworkPredictor, Predictor, evaluate
from saunet.evaluation.suite import evaluate_protocols, read_earlier, with_statistics
from saunet.evaluation.tables import print_table
from saunet.evaluation.writers import write_results

__all__ = [
    "EvaluationResult",
    "ImageRow",
    "NetworkPredictor",
    "Predictor",
    "Summary",
    "evaluate",
    "evaluate_protocols",
    "print_table",
    "read_earlier",
    "with_statistics",
    "write_results",
]
