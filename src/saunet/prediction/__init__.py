"""Using a trained model: images, folders and videos in, depth out."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from saunet.prediction.prediction import Prediction
    from saunet.prediction.predictor import Predictor
    from saunet.prediction.tool import PredictOptions, PredictResult, predict

__all__ = ["PredictOptions", "PredictResult", "Prediction", "Predictor", "predict"]

_HOMES = {
    "PredictOptions": "tool",
    "PredictResult": "tool",
    "Prediction": "prediction",
    "Predictor": "predictor",
    "predict": "tool",
}


def __getattr__(name: str) -> Any:
    """Import on first use: prediction with an exported model must not pay for torch."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
