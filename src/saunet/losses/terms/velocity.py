"""Metric scale from speed: the predicted motion is as long as the way traveled."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from saunet.errors import ConfigError
from saunet.losses.base import Term, TermResult, require
from saunet.losses.functional import masked_mean
from saunet.registry import terms
from saunet.types import DepthPyramid, TrainBatch, View


@terms.register("velocity")
class Velocity(Term):
    """Difference between predicted and true distance traveled, | ||t|| - speed * dt |, in meters (PackNet).

    The distance comes from ``batch["distance"]`` (NaN where unknown) or, where that is missing, from the true motion
    ``batch["T_src_tgt"]``. It makes depth metric; PackNet's weight is 0.1. A stereo partner, whose motion is known,
    does not count.

    Raises:
        ConfigError: in `forward`, if the batch has neither, or no motion is predicted.
    """

    def __init__(self) -> None:
        super().__init__()

    def forward(
        self,
        batch: TrainBatch,
        pyramid: DepthPyramid,
        poses: Float[Tensor, "b s 4 4"],
        views: Sequence[View],
    ) -> TermResult:
        """Return the mean over samples and sources whose distance is known."""
        predictions = poses.shape[1] - ("T_stereo_tgt" in batch)
        if predictions == 0:
            raise ConfigError(
                "the velocity term compares predicted motion and the stereo partner is the only source; "
                "drop the term, or set data.offsets=[-1,1]"
            )
        if "distance" not in batch and "T_src_tgt" in batch:
            distance = torch.linalg.vector_norm(batch["T_src_tgt"][..., :3, 3], dim=-1)
        else:
            distance = require(
                batch,
                "distance",
                "the velocity term",
                "set data.with_speed=true or data.with_pose=true where the data set has it, or drop the term",
            )
        # The norm's gradient at zero motion is 0, not NaN.
        predicted = torch.linalg.vector_norm(poses[:, :predictions, :3, 3], dim=-1)
        distance = distance[:, :predictions]
        known = distance.isfinite()
        return TermResult(value=masked_mean((predicted - distance.where(known, 0.0)).abs(), known))
