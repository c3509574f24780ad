"""Scoring predictors on batches: against ground truth, optionally by bucket, or by explaining neighboring frames."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from saunet.errors import ConfigError, DataError, one_of, positive
from saunet.evaluation.predictors import Motion, Predictor, truths_of
from saunet.evaluation.result import EvaluationResult
from saunet.evaluation.rows import BucketRow, ImageRow, ShapeRow, ViewRow
from saunet.evaluation.team import ALONE, Team
from saunet.geometry.camera import scale_intrinsics
from saunet.geometry.depth import disparity_to_depth, enlarge
from saunet.geometry.warp import synthesize
from saunet.io.progress import bar
from saunet.losses.functional import automask, combine_sources, photometric_error
from saunet.metrics.functional import error_terms, root_terms
from saunet.metrics.protocols import (
    GROUND_TRUTHS,
    Protocol,
    Sample,
    aligned_depth,
    resize_disparity,
    sample_errors,
    sample_image,
)
from saunet.metrics.shapes import DENSE, boundary_scores, cloud_scores, points
from saunet.types import EvalBatch

R = TypeVar("R", ImageRow, ShapeRow, ViewRow)
_NO_IMAGE = "there is no image to evaluate; check the split and the data root"
EDGE_RATIO = 1.25
"""Depths that differ by more than this factor make an edge: the strictest threshold of Bochkovskii et al., Depth Pro,
2024, who also compare neighboring pixels by this ratio."""


@dataclass(frozen=True)
class Buckets:
    """Settings for sorting pixels into buckets."""

    distances: tuple[float, ...] = (0.0, 10.0, 20.0, 30.0, 50.0, 80.0)
    """Limits of the distance ranges in meters, ascending."""
    edge_radius: int = 4
    """Distance in ground-truth pixels, to the left and right, to look for a depth edge."""
    edge_ratio: float = EDGE_RATIO
    """Depths that differ by more than this factor make an edge."""

    def __post_init__(self) -> None:
        positive("edge_radius", self.edge_radius)
        if not self.edge_ratio > 1:
            raise ConfigError(f"edge_ratio is {self.edge_ratio}; it must be greater than 1")
        if len(self.distances) < 2 or list(self.distances) != sorted(set(self.distances)):
            raise ConfigError(f"distances are {list(self.distances)}; give at least two limits in ascending order")

    @property
    def names(self) -> tuple[tuple[str, str], ...]:
        """(group, bucket) of each map from `maps`."""
        return (
            *(("distance", f"{low:g}-{high:g} m") for low, high in pairwise(self.distances)),
            *(("row", f"{name} third") for name in ("top", "middle", "bottom")),
            *(("column", f"{name} third") for name in ("left", "center", "right")),
            *(("edge", name) for name in ("near an edge", "elsewhere")),
            *(("edges", where) for where in ("at depth edges, on thin things", "away from depth edges")),
        )

    def maps(self, truth: Float[Tensor, "h w"]) -> Bool[Tensor, "k h w"]:
        """Return which pixels of a ground truth (0 where unknown) fall into each bucket, in the order of `names`."""
        height, width = truth.shape
        row = (torch.arange(height, device=truth.device) * 3 // height)[:, None].expand(height, width)
        column = (torch.arange(width, device=truth.device) * 3 // width)[None].expand(height, width)
        edge = near_edge(truth, self.edge_radius, self.edge_ratio)
        distances = [(truth >= low) & (truth < high) for low, high in pairwise(self.distances)]
        thirds = [part == third for part in (row, column) for third in range(3)]
        edges, dense = depth_edges(truth), bool((truth > 0).float().mean() >= DENSE)
        return torch.stack((*distances, *thirds, edge, ~edge, edges & dense, ~edges & dense))


def near_edge(truth: Float[Tensor, "h w"], radius: int, ratio: float) -> Bool[Tensor, "h w"]:
    """Find pixels whose measured neighbors in the same row differ in depth by more than a factor.

    Only pixels of the same row are compared: along a row a flat road keeps its depth, while upwards it recedes without
    any edge. This works for dense depth and for scan lines, but includes walls that recede fast; `depth_edges` is more
    precise.
    """
    if truth.numel() == 0:
        return truth > 0
    closeness = torch.where(truth > 0, 1 / truth.clamp(min=1e-6), 0.0)
    near = _row_maximum(closeness, radius)  # inverse of the nearest depth; 0 if none is known
    return _row_maximum(truth, radius) * near > ratio


def depth_edges(truth: Float[Tensor, "h w"], radius: int = 2) -> Bool[Tensor, "h w"]:
    """Find pixels at depth edges of a dense ground truth and on thin things, which lie between two edges.

    Two neighbors in a row or column make an edge if their depths differ by more than `EDGE_RATIO` and neither surface
    continues to the other. A plane's inverse depth is linear in the image, so the change beyond each pixel predicts the
    step between the two, and roads and walls that recede fast are not edges. Both pixels and all within ``radius`` of
    either are returned. Unknown pixels make no edges.
    """
    if truth.numel() == 0:
        return truth > 0
    edge = _row_edges(truth) | _row_edges(truth.T).T
    grown = max_pool2d(edge[None].float(), 2 * radius + 1, stride=1, padding=radius)
    return grown[0] > 0


def _row_edges(truth: Float[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Mark both pixels of each pair of neighbors in a row with an edge between them."""
    inverse = torch.where(truth > 0, 1 / truth.clamp(min=1e-6), torch.nan)
    step = inverse.diff(dim=1)  # NaN beside an unknown pixel compares as False
    first, second = inverse[:, :-1], inverse[:, 1:]
    jump = torch.maximum(first, second) > EDGE_RATIO * torch.minimum(first, second)
    before, after = pad(step, (1, 0))[:, :-1], pad(step, (0, 1))[:, 1:]
    for beyond in (before, after):
        continued = (step - beyond).abs() <= step.abs() / 2
        jump = jump & ~continued
    return pad(jump, (1, 0)) | pad(jump, (0, 1))


def _row_maximum(values: Float[Tensor, "h w"], radius: int) -> Float[Tensor, "h w"]:
    """Largest of the non-negative values within ``radius`` columns, by doubling windows: faster than pooling."""
    found, window, wanted = pad(values, (radius, radius)), 1, 2 * radius + 1
    while window < wanted:
        step = min(window, wanted - window)
        found = torch.maximum(found[:, :-step], found[:, step:])
        window += step
    return found


class BucketSums:
    """The errors of one predictor under one protocol, summed by bucket."""

    def __init__(self, buckets: Buckets) -> None:
        self.buckets = buckets
        self._sums = torch.zeros(len(buckets.names), 7, dtype=torch.float64)
        self._counts = torch.zeros(len(buckets.names), dtype=torch.float64)

    def add(self, sample: Sample, maps: Bool[Tensor, "k h w"]) -> None:
        """Add an image; ``maps`` come from its ground truth."""
        inside = maps[:, sample.mask].double()
        self._sums += (inside @ error_terms(sample.prediction, sample.target).T).cpu()
        self._counts += inside.sum(1).cpu()

    def total(self, team: Team) -> None:
        """Sum over all processes."""
        sums, counts = zip(*team.everyones((self._sums, self._counts)), strict=True)
        self._sums, self._counts = torch.stack(sums).sum(0), torch.stack(counts).sum(0)

    def rows(self, predictor: str, protocol: str) -> tuple[BucketRow, ...]:
        """Return the non-empty buckets."""
        errors = root_terms(self._sums / self._counts[:, None]).tolist()
        counted: list[int] = self._counts.long().tolist()
        return tuple(
            BucketRow(predictor, protocol, group, bucket, count, tuple(row))
            for (group, bucket), count, row in zip(self.buckets.names, counted, errors, strict=True)
            if count
        )


@dataclass(frozen=True)
class Shapes:
    """Which shape scores to measure."""

    boundaries: bool = False
    """Accuracy and completeness of depth edges, if the ground truth is dense."""
    cloud: float | None = None
    """Meters within which points agree, for precision, recall and F-score of point clouds; None to skip these."""

    def __post_init__(self) -> None:
        if self.cloud is not None:
            positive("cloud", self.cloud)

    def row(
        self,
        about: tuple[str, str, str],
        disparity: Float[Tensor, "h w"],
        truth: Float[Tensor, "hg wg"],
        K: Float[Tensor, "3 3"],
        sample: Sample,
        rules: Protocol,
    ) -> ShapeRow:
        """Measure one image; ``about`` is predictor, protocol and name, ``K`` is in pixels of the truth."""
        edges, cloud = (math.nan, math.nan), (math.nan, math.nan, math.nan)
        if self.boundaries and sample.target.numel():
            resized = resize_disparity(disparity, (truth.shape[0], truth.shape[1])).double()
            depth = aligned_depth(resized, sample.ratio, sample.shift, rules)
            edges = boundary_scores(depth.cpu().numpy(), truth.cpu().numpy(), sample.mask.cpu().numpy())
        if self.cloud is not None:
            mask, matrix = sample.mask.cpu().numpy(), K.cpu().numpy()
            predicted, true = (points(each.cpu().numpy(), mask, matrix) for each in (sample.prediction, sample.target))
            cloud = cloud_scores(predicted, true, self.cloud)
        return ShapeRow(*about, *edges, *cloud)


@torch.inference_mode()
def score(
    predictors: Mapping[str, Predictor],
    batches: Iterable[EvalBatch],
    protocols: Sequence[Protocol],
    *,
    ground_truth: str = "camera_z",
    buckets: Buckets | None = None,
    shapes: Shapes | None = None,
    total: int | None = None,
    progress: bool = True,
    team: Team = ALONE,
) -> EvaluationResult:
    """Score predictors, given by name, on the same images under protocols for their ground truth.

    Only one batch is held at a time; a batch in which no image has depth may come without ``depth``. Batches and
    predictions may be on any device; scores are computed on the device of the ground truth. Each predictor, protocol
    and image becomes a row, including images without ground truth. With a ``team``, each process gets different
    batches, and all return the complete result.
    """
    _check_request(predictors, protocols, ground_truth)
    rows: list[ImageRow] = []
    shape_rows: list[ShapeRow] = []
    sums = {(p, q.name): BucketSums(buckets) for p in predictors for q in protocols} if buckets else {}
    with bar(progress and team.rank == 0, "images", taken=True) as shown:
        task = shown.add_task("evaluate", total=total)
        for batch in batches:
            rows += _score_batch(predictors, batch, protocols, sums, buckets, shapes, shape_rows)
            shown.advance(task, len(batch["name"]) * team.size)
    for each in sums.values():
        each.total(team)
    rows, shape_rows = taken_in_turn(team, rows), taken_in_turn(team, shape_rows)
    if not rows:
        raise DataError(_NO_IMAGE)
    if not any(row.pixels for row in rows):
        count = len({row.name for row in rows})
        raise DataError(
            f"none of the {count} images has ground-truth depth to compare; evaluate on data that have it, or set "
            "protocols=[campus], which compares views and needs none"
        )
    found = tuple(row for (predictor, name), bucket in sums.items() for row in bucket.rows(predictor, name))
    about = {} if shapes is None or shapes.cloud is None else {"cloud": shapes.cloud}
    return EvaluationResult(
        tuple(protocols), tuple(predictors), tuple(rows), found, shapes=tuple(shape_rows), settings=about
    )


def _check_request(predictors: Mapping[str, Predictor], protocols: Sequence[Protocol], ground_truth: str) -> None:
    one_of("ground_truth", ground_truth, GROUND_TRUTHS)
    names = [protocol.name for protocol in protocols]
    if not predictors or not names:
        raise ConfigError(f"got {len(predictors)} predictors and {len(names)} protocols; give at least one of each")
    if len(set(names)) != len(names):
        raise ConfigError(f"protocols {', '.join(names)} share a name; give each its own")
    for protocol in protocols:
        if not protocol.accepts(ground_truth):
            raise ConfigError(
                f"protocol '{protocol.name}' is defined on '{protocol.ground_truth}' ground truth but the data give "
                f"'{ground_truth}'; load that ground truth or choose another protocol"
            )


def _score_batch(
    predictors: Mapping[str, Predictor],
    batch: EvalBatch,
    protocols: Sequence[Protocol],
    sums: Mapping[tuple[str, str], BucketSums],
    buckets: Buckets | None,
    shapes: Shapes | None,
    shape_rows: list[ShapeRow],
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
        for place, (name, image, truth, inside) in enumerate(zip(names, disparity[:, 0], truths, maps, strict=True)):
            if not finite[place]:
                raise DataError(f"predictor '{predictor}' returned non-finite values for image '{name}'")
            for protocol in protocols:
                sample = sample_image(image, truth, protocol)
                found = sample_errors(sample)
                if inside is not None:
                    sums[predictor, protocol.name].add(sample, inside)
                if shapes is not None:
                    about, K = (predictor, protocol.name, name), _truth_intrinsics(batch, place, truth)
                    shape_rows.append(shapes.row(about, image, truth, K, sample, protocol))
                errors = tuple(found.errors.tolist())
                rows.append(ImageRow(predictor, protocol.name, name, found.pixels, found.ratio.item(), errors))
    return rows


def _truth_intrinsics(batch: EvalBatch, place: int, truth: Float[Tensor, "h w"]) -> Float[Tensor, "3 3"]:
    """Return the intrinsics of an image in pixels of its ground truth."""
    (height, width), (rows, columns) = batch["target"].shape[-2:], truth.shape
    return scale_intrinsics(batch["K"][place].double(), columns / width, rows / height)


def taken_in_turn(team: Team, rows: list[R]) -> list[R]:
    """Return the rows of all processes in the order of a single one: the images were dealt out in turn."""
    if team.size == 1:
        return rows
    every = team.everyones(rows)
    names = [list(dict.fromkeys(row.name for row in each)) for each in every]
    order = {name: place for place, name in enumerate(filter(None, itertools.chain(*itertools.zip_longest(*names))))}
    return sorted(itertools.chain(*every), key=lambda row: order[row.name])


@torch.inference_mode()
def score_views(
    predictors: Mapping[str, tuple[Predictor, Motion]],
    batches: Iterable[EvalBatch],
    protocol: Protocol,
    *,
    group_of: Callable[[str], str],
    total: int | None = None,
    progress: bool = True,
    team: Team = ALONE,
) -> EvaluationResult:
    """Warp the neighbors of each image into it with predicted depth and motion, and compare.

    A small error does not prove good depth (any depth explains a flat wall). But a model that does not beat unwarped
    neighbors has learned nothing, and difficult conditions become visible. ``group_of`` returns the condition or the
    recording of an image by its name. An image without a known motion to any neighbor gets NaN.
    """
    if protocol.ground_truth != "none":
        raise ConfigError(
            f"protocol '{protocol.name}' compares with '{protocol.ground_truth}' ground truth; "
            "score it with `score`, or choose one that needs none, such as campus"
        )
    rows: list[ViewRow] = []
    with bar(progress and team.rank == 0, "images", taken=True) as shown:
        task = shown.add_task(protocol.name, total=total)
        for batch in batches:
            if batch["sources"].shape[1] == 0:
                raise DataError(f"image '{batch['name'][0]}' comes without neighboring frames to compare with")
            for name, (predict, motion) in predictors.items():
                disparity = enlarge(predict(batch).float(), *batch["target"].shape[-2:])
                depth = disparity_to_depth(disparity.clamp(min=1e-6))
                columns = _explain(depth, motion(batch, depth), batch)
                rows += [
                    ViewRow(name, protocol.name, image, group_of(image), *values)
                    for image, *values in zip(batch["name"], *columns, strict=True)
                ]
            shown.advance(task, len(batch["name"]) * team.size)
    rows = taken_in_turn(team, rows)
    if not rows:
        raise DataError(_NO_IMAGE)
    if all(math.isnan(row.warped) for row in rows):
        raise DataError(
            f"the camera's motion is unknown for all {len(rows)} images: too few points can be tracked (give "
            "brighter or sharper frames, closer in time), or the pose network's weights are damaged"
        )
    return EvaluationResult((protocol,), tuple(predictors), (), views=tuple(rows))


def _explain(
    depth: Float[Tensor, "b 1 h w"], T_src_tgt: Float[Tensor, "b s 4 4"], batch: EvalBatch
) -> list[list[float]]:
    """Return the values of `ViewRow` for each image: warped, unwarped, explained, visible."""
    view = synthesize(batch["sources"], depth, batch["K"], T_src_tgt)
    target = batch["target"][:, None]
    warped, seen = combine_sources(photometric_error(view.image, target), view.valid)
    # Compare over the same pixels: leaving out hard ones must not look like progress.
    unwarped, _ = combine_sources(photometric_error(batch["sources"], target))
    explained = automask(warped, unwarped) & seen
    known = T_src_tgt.isfinite().flatten(2).all(2).any(1)
    pixels = torch.where(known, seen.flatten(1).sum(1).clamp(min=1), math.nan)
    return [
        (torch.where(seen, warped, 0.0).flatten(1).sum(1) / pixels).tolist(),
        (torch.where(seen, unwarped, 0.0).flatten(1).sum(1) / pixels).tolist(),
        (explained.flatten(1).sum(1) / pixels).tolist(),
        seen.flatten(1).float().mean(1).tolist(),
    ]
