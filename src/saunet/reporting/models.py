"""What a report asks of a run's networks: how large they are, and what they see in the scenes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from saunet.errors import SaunetError
from saunet.prediction.predictor import Predictor
from saunet.reporting.scenes import View
from saunet.runs.checkpoint import read_checkpoint
from saunet.runs.folder import Run
from saunet.tools.benchmark.measure import count_parameters


@dataclass(frozen=True, eq=False)
class Seen:
    """A run's networks, looked at once and let go."""

    parameters: tuple[int, int]
    """Of the depth and the pose network."""
    size: tuple[int, int]
    """Height and width of its input in pixels."""
    disparities: tuple[Float32[np.ndarray, "_ _"], ...]
    """One for each view, at the image's size."""


def look(run: Run, views: Sequence[View], device: str = "cpu", flip: bool = False) -> Seen | str:
    """Build a run's networks, count their parameters and predict the views.

    Args:
        run: The run.
        views: What to predict.
        device: Where.
        flip: Average with the prediction of the mirrored image.

    Returns:
        What was found, or one sentence why the run has no usable networks.
    """
    if run.checkpoint is None:
        return run.error or "it has no checkpoint"
    try:
        checkpoint = read_checkpoint(run.checkpoint)
        depth, pose = checkpoint.networks()
        record = checkpoint.record
        predictor = Predictor(depth, record.height, record.width, device, record.scale, flip)
        disparities = tuple(predictor.predict(view.image, view.title).disparity for view in views)
    except SaunetError as error:
        return str(error)
    size = (record.height, record.width)
    return Seen((count_parameters(depth), count_parameters(pose)), size, disparities)
