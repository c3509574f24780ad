"""Using a trained model: images, folders and videos in, depth out."""

from __future__ import annotations

from typing import TYPE_CHECKING

from saunet.lazy import lazily

if TYPE_CHECKING:
    from saunet.prediction.prediction import Prediction
    from saunet.prediction.predictor import Predictor
    from saunet.prediction.tool import PredictOptions, PredictResult, predict

__all__ = ["PredictOptions", "PredictResult", "Prediction", "Predictor", "predict"]
__getattr__ = lazily(
    __name__, {"prediction": "Prediction", "predictor": "Predictor", "tool": "PredictOptions PredictResult predict"}
)
