"""One factor a frame from what is known in meters, and one for a model, with how far the frames agree."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor, nn

from saunet.errors import ConfigError, DataError, one_of, positive
from saunet.geometry.ground import fit_ground
from saunet.io.atomic import write_json
from saunet.runs.record import Scale
from saunet.scale.options import METHODS
from saunet.scale.storing import can_keep, store_scale
from saunet.types import DepthPyramid, TrainBatch

DepthOf = Callable[[Tensor], Tensor]
"""Gives the depth (b 1 h w, any unit) of images (b 3 h w)."""
MotionOf = Callable[[Tensor, Tensor], Tensor]
"""Gives T_src_tgt (b s 4 4, the depth's unit) of targets (b 3 h w) and sources (b s 3 h w)."""

MIN_SUPPORT = 0.4
"""Fraction of the road region that must lie on the plane; with less, a frame's plane is not taken for the road."""
MIN_DISTANCE = 0.1
"""Meters traveled below which a frame says nothing about scale: the motion drowns in its error."""
MIN_MATCHES = 100
"""Pixels of a stereo pair that must be matched."""
_MIN_DISPARITY = 1.5  # pixels; an eighth of a pixel of matching error is then 8 % of depth at most
_LARGEST_DISPARITY = 0.15  # of the image's width

_WHY_NOT = {
    "camera_height": "the lower part of the depth map is not a level plane in any of the {count} frames; the road is "
    "not in view, the intrinsics are wrong, or the model is not trained",
    "speed": "none of the {count} frames has a known speed and a moving car; give speeds of those frames, or set "
    "scale.align=true if their clock starts at another time",
    "stereo": "too few pixels of the stereo pair match in all {count} frames; check that both cameras' images are "
    "rectified and belong together",
}


@dataclass(frozen=True, slots=True)
class ScaleEstimate:
    """The factor to meters that many frames agree on, and how well they do."""

    method: str
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
        """Standard deviation over frames, as a fraction of the median."""
        return float(np.std(self.factors)) / self.factor

    @property
    def uncertainty(self) -> float:
        """Standard error of the median for independent frames, as a fraction of it; NaN for a single frame."""
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
        count = len(self.factors)
        rest = f" ({self.left_out} more could not be measured)" if self.left_out else ""
        known = f"known to about {100 * self.uncertainty:.1g} %" if count > 1 else "one frame shows no spread"
        more = "; measure on more frames" if count < 10 else ""
        return (
            f"scale {self.factor:.4g} from {self.source}: median of {count} frames{rest}, "
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
            ``stereo`` needs the other view as the last source and ``T_stereo_tgt``.
        batches: The frames.
        depth: The depth network.
        motion: The pose network, for ``speed``.
        camera_height: Meters above the road, for ``camera_height``.

    Raises:
        ConfigError: for an unknown method, or if something it needs is not given.
        DataError: if no frame could be measured.
    """
    one_of("scale.method", method, METHODS)
    source, measure = _measurement(method, depth, motion, camera_height)
    names, factors = list[str](), list[float]()
    for batch in batches:
        names += batch["name"]
        factors += measure(batch).tolist()
    usable = [(n, f) for n, f in zip(names, factors, strict=True) if math.isfinite(f) and f > 0]
    if not usable:
        raise DataError(f"the scale cannot be measured by {method}: {_WHY_NOT[method].format(count=len(factors))}")
    kept_names, kept = zip(*usable, strict=True)
    return ScaleEstimate(method, source, kept_names, kept, len(names) - len(kept))


def keep_scale(estimate: ScaleEstimate, checkpoint: str | Path, store_in: Path | None, folder: Path | None) -> Scale:
    """Say what was measured, write ``scale.json`` into a folder, store the factor in a model, and return it.

    If it is not stored, and the model that it was measured with could keep it, that is said too.
    """
    print(estimate)
    if folder is not None:
        write_json(folder / "scale.json", estimate.as_json())
    if store_in is not None:
        store_scale(store_in, estimate.scale())
        print(f"stored in {store_in}")
    elif can_keep(checkpoint):
        print("it applies to this command only; scale.store=true keeps it in the model for all later ones")
    return estimate.scale()


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
                "scale.method=speed needs a pose network, which this model does not have; use a checkpoint of a "
                "training on video, or another method"
            )
        return "speed", lambda batch: speed_factors(motion(batch["target"], batch["sources"]), batch["distance"])
    return "stereo baseline", lambda batch: stereo_factors(
        depth(batch["target"]), batch["target"], batch["sources"][:, -1], batch["K"], batch["T_stereo_tgt"]
    )


def height_factors(
    depth: Float[Tensor, "b 1 h w"], K: Float[Tensor, "b 3 3"], camera_height: float
) -> Float[Tensor, " b"]:
    """Camera height in meters over its height above the road in the predicted depth; NaN where no road is found."""
    plane = fit_ground(depth, K)
    return torch.where(plane.support >= MIN_SUPPORT, camera_height / plane.height, math.nan)


def speed_factors(T_src_tgt: Float[Tensor, "b s 4 4"], distance: Float[Tensor, "b s"]) -> Float[Tensor, " b"]:
    """Meters traveled over the predicted motion, all sources of a frame together; NaN where unknown or standing."""
    predicted = torch.linalg.vector_norm(T_src_tgt[..., :3, 3].double(), dim=-1)
    counts = distance.isfinite() & (distance >= MIN_DISTANCE)
    meters, length = (torch.where(counts, values, 0.0).sum(1) for values in (distance.double(), predicted))
    return torch.where((meters > 0) & (length > 0), meters / length, math.nan).to(distance)


def stereo_factors(
    depth: Float[Tensor, "b 1 h w"],
    image: Float[Tensor, "b 3 h w"],
    other: Float[Tensor, "b 3 h w"],
    K: Float[Tensor, "b 3 3"],
    T_stereo_tgt: Float[Tensor, "b 4 4"],
) -> Float[Tensor, " b"]:
    """Median of depth by stereo matching over predicted depth; NaN where too few pixels match."""
    factors = []
    for i in range(len(depth)):
        across = float(T_stereo_tgt[i, 0, 3])
        disparity = _match(_gray(image[i]), _gray(other[i]), other_is_left=across > 0)
        found = disparity >= _MIN_DISPARITY
        predicted = depth[i, 0].detach().double().cpu().numpy()
        ratios = (float(K[i, 0, 0]) * abs(across) / disparity[found]) / predicted[found]
        factors.append(float(np.median(ratios)) if found.sum() >= MIN_MATCHES else math.nan)
    return depth.new_tensor(factors)


def _match(image: NDArray[np.uint8], other: NDArray[np.uint8], other_is_left: bool) -> NDArray[np.float64]:
    """Return the disparity of ``image`` by semi-global matching, pixels, 0 or less where unknown."""
    if other_is_left:  # matching goes from the left image to the right one
        return _match(image[:, ::-1], other[:, ::-1], False)[:, ::-1]
    block = 3 if image.shape[1] < 400 else 5
    count = 16 * max(1, round(_LARGEST_DISPARITY * image.shape[1] / 16))
    smoothness = {"P1": 8 * block**2, "P2": 32 * block**2}
    checks = {"disp12MaxDiff": 1, "uniquenessRatio": 10, "speckleWindowSize": 50, "speckleRange": 2}
    matcher = cv2.StereoSGBM.create(0, count, block, mode=cv2.STEREO_SGBM_MODE_HH, **smoothness, **checks)
    disparity = matcher.compute(np.ascontiguousarray(image), np.ascontiguousarray(other))
    return np.asarray(disparity, np.float64) / 16


def _gray(image: Float[Tensor, "3 h w"]) -> NDArray[np.uint8]:
    picture = (image.detach().cpu().clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy()
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), np.uint8)


class MetricDepth(nn.Module):
    """A depth network with its scale applied: image to disparity in 1/meter."""

    def __init__(self, network: nn.Module, scale: Scale) -> None:
        super().__init__()
        self.network, self.scale = network, scale

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 1 h w"]:
        pyramid: DepthPyramid = self.network(image)
        return pyramid.disparity[0] / self.scale.factor


class MetricMotion(nn.Module):
    """A pose network with the scale of its depth network applied: frames to T_src_tgt in meters."""

    def __init__(self, network: nn.Module, scale: Scale) -> None:
        super().__init__()
        self.network, self.scale = network, scale

    def forward(
        self, target: Float[Tensor, "b 3 h w"], sources: Float[Tensor, "b s 3 h w"]
    ) -> Float[Tensor, "b s 4 4"]:
        T: Tensor = self.network(target, sources).clone()
        T[..., :3, 3] *= self.scale.factor
        return T
