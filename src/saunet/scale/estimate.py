"""From factors of single frames to one factor for a model, with how far the frames agree."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from saunet.errors import ConfigError, DataError, one_of, positive
from saunet.runs.record import Scale
from saunet.scale.factors import height_factors, speed_factors, stereo_factors
from saunet.scale.options import METHODS
from saunet.types import TrainBatch

DepthOf = Callable[[Tensor], Tensor]
"""Gives the depth (b 1 h w, any unit) of images (b 3 h w)."""
MotionOf = Callable[[Tensor, Tensor], Tensor]
"""Gives T_src_tgt (b s 4 4, the depth's unit) of targets (b 3 h w) and sources (b s 3 h w)."""

_WHY_NOT = {
    "camera_height": "in none of the {count} frames the lower part of the depth map is a level plane; the road is not "
    "in view, the intrinsics are wrong, or the model is not trained",
    "speed": "in none of the {count} frames the speed is known and the car moves; give speeds of those frames",
    "stereo": "in none of the {count} frames enough pixels of the stereo pair match; check that both cameras' images "
    "are rectified and belong together",
}


@dataclass(frozen=True, slots=True)
class ScaleEstimate:
    """The factor to meters that many frames agree on, and how well they do."""

    method: str
    """One of `METHODS`."""
    source: str
    """What it follows from, such as ``camera height 1.65 m``."""
    names: tuple[str, ...]
    """The frames measured."""
    factors: tuple[float, ...]
    """The factor of each."""
    left_out: int = 0
    """Frames in which nothing could be measured."""

    @property
    def factor(self) -> float:
        """The median over frames: what depth is multiplied by."""
        return float(np.median(self.factors))

    @property
    def quartiles(self) -> tuple[float, float]:
        """The range of the middle half of the frames."""
        low, high = np.percentile(self.factors, [25, 75])
        return float(low), float(high)

    @property
    def spread(self) -> float:
        """Standard deviation over frames, as a share of the median."""
        return float(np.std(self.factors)) / self.factor

    @property
    def uncertainty(self) -> float:
        """Standard error of the median for independent frames, as a share of it; NaN for a single frame."""
        count = len(self.factors)
        return 1.2533 * self.spread * math.sqrt(count / (count - 1)) / math.sqrt(count) if count > 1 else math.nan

    def scale(self) -> Scale:
        """Return what a checkpoint stores and a prediction names."""
        return Scale(self.factor, self.source)

    def as_json(self) -> dict[str, Any]:
        """Return everything as plain data."""
        return {
            "method": self.method,
            "source": self.source,
            "factor": self.factor,
            "quartiles": list(self.quartiles),
            "iqr": self.quartiles[1] - self.quartiles[0],
            "std_over_median": self.spread,
            "uncertainty": self.uncertainty if len(self.factors) > 1 else None,
            "frames": len(self.factors),
            "frames_left_out": self.left_out,
            "per_frame": dict(zip(self.names, self.factors, strict=True)),
        }

    def __str__(self) -> str:
        low, high = self.quartiles
        rest = f" ({self.left_out} more could not be measured)" if self.left_out else ""
        known = (
            f"known to about {100 * self.uncertainty:.1g} %" if len(self.factors) > 1 else "one frame shows no spread"
        )
        more = "; measure on more frames" if len(self.factors) < 10 else ""
        return (
            f"scale {self.factor:.4g} from {self.source}: median of {len(self.factors)} frames{rest}, "
            f"middle half {low:.4g} to {high:.4g}, std/median {100 * self.spread:.1f} %, {known}{more}"
        )


@torch.inference_mode()
def estimate_scale(
    method: str,
    batches: Iterable[TrainBatch],
    depth: DepthOf,
    motion: MotionOf | None = None,
    camera_height: float | None = None,
) -> ScaleEstimate:
    """Measure the scale of a model's depth over frames.

    Args:
        method: ``camera_height`` needs the images' true intrinsics; ``speed`` needs sources and ``distance``;
            ``stereo`` needs the partner as the last source and ``T_stereo_tgt``.
        batches: The frames.
        depth: The depth network.
        motion: The pose network, for ``speed``.
        camera_height: Meters above the road, for ``camera_height``.

    Raises:
        ConfigError: for an unknown method, or if what it needs is not given.
        DataError: if no frame could be measured.
    """
    one_of("scale.method", method, METHODS)
    source, measure = _measurement(method, depth, motion, camera_height)
    names: list[str] = []
    factors: list[float] = []
    for batch in batches:
        names += batch["name"]
        factors += measure(batch).tolist()
    usable = [math.isfinite(factor) and factor > 0 for factor in factors]
    if not any(usable):
        raise DataError(f"the scale cannot be measured by {method}: {_WHY_NOT[method].format(count=len(factors))}")
    kept = [(name, factor) for name, factor, good in zip(names, factors, usable, strict=True) if good]
    return ScaleEstimate(
        method, source, tuple(name for name, _ in kept), tuple(factor for _, factor in kept), len(names) - len(kept)
    )


def _measurement(
    method: str, depth: DepthOf, motion: MotionOf | None, camera_height: float | None
) -> tuple[str, Callable[[TrainBatch], Tensor]]:
    if method == "camera_height":
        if camera_height is None:
            raise ConfigError(
                "scale.method=camera_height needs scale.camera_height, the meters from the road up to the camera "
                "(KITTI: 1.65)"
            )
        height = positive("scale.camera_height", float(camera_height))
        return f"camera height {height:g} m", lambda batch: height_factors(depth(batch["target"]), batch["K"], height)
    if method == "speed":
        if motion is None:
            raise ConfigError(
                "scale.method=speed needs the pose network, which this model has not; use a checkpoint of a training "
                "on video, or another method"
            )
        return "speed", lambda batch: speed_factors(motion(batch["target"], batch["sources"]), batch["distance"])
    return "stereo baseline", lambda batch: stereo_factors(
        depth(batch["target"]), batch["target"], batch["sources"][:, -1], batch["K"], batch["T_stereo_tgt"]
    )
