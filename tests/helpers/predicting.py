"""`predict` with a model in memory, as most tests of prediction want it."""

from __future__ import annotations

from typing import Any

from saunet.prediction.prediction import ImagePredictor
from saunet.prediction.tool import PredictOptions, PredictResult, predict


def run(
    predictor: ImagePredictor, input: Any, output: Any, outputs: Any = None, *, odometer: Any = None, **more: Any
) -> PredictResult:
    """Predict with a loaded model; the checkpoint is not there."""
    options = PredictOptions(checkpoint="absent.ckpt", input=input, output=output, outputs=outputs, **more)
    return predict(options, predictor, odometer)
