"""Running several predictors over the same images under several protocols."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from saunet.errors import ConfigError, DataError, one_of
from saunet.evaluation.breakdown import Buckets, BucketSums
from saunet.evaluation.result import EvaluationResult, ImageRow
from saunet.io.progress import bar
from saunet.metrics.depth import native_depths
from saunet.metrics.functional import flip_blend
from saunet.metrics.protocols import GROUND_TRUTHS, Protocol, sample_errors, sample_image
from saunet.types import DepthPyramid, EvalBatch

Predictor = Callable[[EvalBatch], Tensor]
"""Gives the disparity (1/meter up to scale) of a batch, b x 1 x any height x any width."""


class NetworkPredictor:
    """A depth network, or a trivial predictor, as something that `evaluate` can call.

    Args:
        network: Takes images (b 3 h w) and returns a `DepthPyramid` or a disparity (b 1 h w); put into evaluation mode.
        flip: Also predict the mirrored image and blend (`flip_blend`): slower and a little better.
    """

    def __init__(self, network: nn.Module, flip: bool = False) -> None:
        self.network, self.flip = network.eval(), flip

    @torch.inference_mode()
    def __call__(self, batch: EvalBatch) -> Tensor:
        """Return the disparity of the batch's target images, b 1 h w."""
        image = batch["target"]
        disparity = self._disparity(image)
        return flip_blend(disparity, self._disparity(image.flip(-1))) if self.flip else disparity

    def _disparity(self, image: Tensor) -> Tensor:
        output = self.network(image)
        return output.disparity[0] if isinstance(output, DepthPyramid) else output


@torch.inference_mode()
def evaluate(
    predictors: Mapping[str, Predictor],
    batches: Iterable[EvalBatch],
    protocols: Sequence[Protocol],
    *,
    ground_truth: str = "camera_z",
    buckets: Buckets | None = None,
    total: int | None = None,
    progress: bool = True,
) -> EvaluationResult:
    """Score predictors on the same images.

    Only one batch is held at a time. Batches and predictions may lie on any device; numbers are computed where the
    ground truth lies.

    Args:
        predictors: By the name that tables show.
        batches: Images with ``depth`` and ``depth_size``; a batch in which no image has any may come without.
        protocols: Rules to score under, all of which must accept ``ground_truth``.
        ground_truth: What the batches' depth is, one of `GROUND_TRUTHS`.
        buckets: Also sum the errors by these buckets of pixels.
        total: Number of images, for the progress bar.
        progress: Show a progress bar on a terminal or in a notebook.

    Returns:
        One row for each predictor, protocol and image, also for images without ground truth.

    Raises:
        ConfigError: if there is no predictor or protocol, two protocols share a name, or one needs other ground truth.
        DataError: if there is no image, none has ground truth, or a prediction does not fit or is not finite.
    """
    _check_request(predictors, protocols, ground_truth)
    rows: list[ImageRow] = []
    sums = {(p, q.name): BucketSums(buckets) for p in predictors for q in protocols} if buckets else {}
    with bar(progress, "images", taken=True) as shown:
        task = shown.add_task("evaluate", total=total)
        for batch in batches:
            rows += _score_batch(predictors, batch, protocols, sums, buckets)
            shown.advance(task, len(batch["name"]))
    if not rows:
        raise DataError("there is no image to evaluate; check the split and the data root")
    if not any(row.pixels for row in rows):
        count = len({row.name for row in rows})
        raise DataError(f"none of the {count} images has ground-truth depth to compare; evaluate on data that have it")
    found = tuple(row for (predictor, name), bucket in sums.items() for row in bucket.rows(predictor, name))
    return EvaluationResult(tuple(protocols), tuple(predictors), tuple(rows), found)


def _check_request(predictors: Mapping[str, Predictor], protocols: Sequence[Protocol], ground_truth: str) -> None:
    one_of("ground_truth", ground_truth, GROUND_TRUTHS)
    names = [protocol.name for protocol in protocols]
    if not predictors or not names:
        raise ConfigError(f"{len(predictors)} predictors under {len(names)} protocols; give at least one of each")
    if len(set(names)) != len(names):
        raise ConfigError(f"protocols {', '.join(names)} share a name; give each its own")
    for protocol in protocols:
        if not protocol.accepts(ground_truth):
            raise ConfigError(
                f"protocol '{protocol.name}' is defined on '{protocol.ground_truth}' ground truth and the data give "
                f"'{ground_truth}'; load that ground truth or choose another protocol"
            )


def _score_batch(
    predictors: Mapping[str, Predictor],
    batch: EvalBatch,
    protocols: Sequence[Protocol],
    sums: Mapping[tuple[str, str], BucketSums],
    buckets: Buckets | None,
) -> list[ImageRow]:
    names = batch["name"]
    truths = truths_of(batch)
    maps = [buckets.maps(truth) if buckets else None for truth in truths]
    rows = []
    for predictor, predict in predictors.items():
        disparity = predict(batch).to(truths[0].device)
        if disparity.ndim != 4 or disparity.shape[:2] != (len(names), 1):
            raise DataError(
                f"predictor '{predictor}' returned shape {tuple(disparity.shape)} for {len(names)} images; "
                f"it must be ({len(names)}, 1, height, width)"
            )
        finite = disparity.isfinite().flatten(1).all(1).tolist()
        for name, image, truth, inside, good in zip(names, disparity[:, 0], truths, maps, finite, strict=True):
            if not good:
                raise DataError(f"predictor '{predictor}' gives values that are not finite for image '{name}'")
            for protocol in protocols:
                sample = sample_image(image, truth, protocol)
                found = sample_errors(sample)
                if inside is not None:
                    sums[predictor, protocol.name].add(sample, inside)
                errors = tuple(found.errors.tolist())
                rows.append(ImageRow(predictor, protocol.name, name, found.pixels, found.ratio.item(), errors))
    return rows


def truths_of(batch: EvalBatch) -> list[Float[Tensor, "_ _"]]:
    """Return the ground truth of each image at its native size, meters, 0 where unknown; one such pixel without any.

    Raises:
        DataError: if the batch has depth without its sizes, or they do not fit.
    """
    if "depth" not in batch:
        return [batch["target"].new_zeros(1, 1) for _ in batch["name"]]
    if "depth_size" not in batch:
        raise DataError(f"image '{batch['name'][0]}' comes with depth but without depth_size; give its (height, width)")
    return native_depths(batch["depth"], batch["depth_size"], len(batch["name"]))
