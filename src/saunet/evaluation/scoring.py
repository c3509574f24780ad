"""Scoring predictors on batches of images: against ground truth, or by how well they explain the neighboring frames."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from saunet.errors import ConfigError, DataError, one_of
from saunet.evaluation.buckets import Buckets, BucketSums
from saunet.evaluation.predictors import Motion, Predictor, truths_of
from saunet.evaluation.result import EvaluationResult, ImageRow, ViewRow
from saunet.geometry.depth import disparity_to_depth
from saunet.geometry.warp import synthesize
from saunet.io.progress import bar
from saunet.losses.functional import automask, combine_sources, photometric_error
from saunet.metrics.protocols import GROUND_TRUTHS, Protocol, sample_errors, sample_image
from saunet.types import EvalBatch

_NO_IMAGE = "there is no image to evaluate; check the split and the data root"


@torch.inference_mode()
def score(
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
        raise DataError(_NO_IMAGE)
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


@torch.inference_mode()
def score_views(
    predictors: Mapping[str, tuple[Predictor, Motion]],
    batches: Iterable[EvalBatch],
    protocol: Protocol,
    *,
    group_of: Callable[[str], str],
    total: int | None = None,
    progress: bool = True,
) -> EvaluationResult:
    """Warp the neighbors of each image into it by predicted depth and motion, and compare.

    A small error does not prove good depth (a flat wall is explained by any), but a model that does not beat the
    neighbors as they are has learned nothing, and conditions that are worse than others show.

    Args:
        predictors: Depth and motion by the name that tables show; both at one scale.
        batches: Images with neighbors.
        protocol: One that needs no ground truth.
        group_of: Gives the condition or the recording of an image by its name.
        total: Number of images, for the progress bar.
        progress: Show a progress bar on a terminal or in a notebook.

    Raises:
        ConfigError: if the protocol needs ground truth.
        DataError: if there is no image, or a batch comes without neighbors.
    """
    if protocol.ground_truth != "none":
        raise ConfigError(
            f"protocol '{protocol.name}' compares with '{protocol.ground_truth}' ground truth; "
            "score it with `score`, or choose one that needs none, such as campus"
        )
    rows: list[ViewRow] = []
    with bar(progress, "images", taken=True) as shown:
        task = shown.add_task(protocol.name, total=total)
        for batch in batches:
            if batch["sources"].shape[1] == 0:
                raise DataError(f"image '{batch['name'][0]}' comes without neighboring frames to compare with")
            for name, (depth, motion) in predictors.items():
                columns = _explain(depth(batch), motion(batch), batch)
                rows += [
                    ViewRow(name, protocol.name, image, group_of(image), *values)
                    for image, *values in zip(batch["name"], *columns, strict=True)
                ]
            shown.advance(task, len(batch["name"]))
    if not rows:
        raise DataError(_NO_IMAGE)
    return EvaluationResult((protocol,), tuple(predictors), (), views=tuple(rows))


def _explain(
    disparity: Float[Tensor, "b 1 h w"], T_src_tgt: Float[Tensor, "b s 4 4"], batch: EvalBatch
) -> list[list[float]]:
    """Return what `ViewRow` holds of each image: warped, unwarped, explained, visible."""
    depth = disparity_to_depth(disparity.float().clamp(min=1e-6))
    view = synthesize(batch["sources"], depth, batch["K"], T_src_tgt)
    target = batch["target"][:, None]
    warped, seen = combine_sources(photometric_error(view.image, target), view.valid)
    # Compared over the same pixels, or leaving out the hard ones would look like progress.
    unwarped, _ = combine_sources(photometric_error(batch["sources"], target))
    explained = automask(warped, unwarped) & seen
    pixels = seen.flatten(1).sum(1).clamp(min=1)
    return [
        (torch.where(seen, warped, 0.0).flatten(1).sum(1) / pixels).tolist(),
        (torch.where(seen, unwarped, 0.0).flatten(1).sum(1) / pixels).tolist(),
        (explained.flatten(1).sum(1) / pixels).tolist(),
        seen.flatten(1).float().mean(1).tolist(),
    ]
