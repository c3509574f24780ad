"""Where the errors are: by distance, by image region, and at depth edges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from saunet.errors import ConfigError, positive
from saunet.evaluation.result import BucketRow
from saunet.metrics.functional import error_terms, root_terms
from saunet.metrics.protocols import Sample

EDGE_RATIO = 1.25
"""Depths that differ by more than this factor make an edge, the strictest threshold of Bochkovskii et al., Depth Pro,
2024, who compare neighboring pixels by this ratio too."""
DENSE = 0.5
"""Fraction of known pixels from which on a ground truth is dense enough to have depth edges between neighbors."""


@dataclass(frozen=True)
class Buckets:
    """How pixels are sorted.

    Args:
        distances: Limits of the distance ranges in meters, ascending.
        edge_radius: Pixels of the ground truth to the left and right that are looked at for a depth edge.
        edge_ratio: Depths that differ by more than this factor make an edge.

    Raises:
        ConfigError: if the limits do not ascend, the radius is below 1 or the ratio not above 1.
    """

    distances: tuple[float, ...] = (0.0, 10.0, 20.0, 30.0, 50.0, 80.0)
    edge_radius: int = 4
    edge_ratio: float = EDGE_RATIO

    def __post_init__(self) -> None:
        positive("edge_radius", self.edge_radius)
        if not self.edge_ratio > 1:
            raise ConfigError(f"edge_ratio is {self.edge_ratio}; it must be greater than 1")
        if len(self.distances) < 2 or list(self.distances) != sorted(set(self.distances)):
            raise ConfigError(f"distances are {list(self.distances)}; give at least two limits in ascending order")

    @property
    def names(self) -> tuple[tuple[str, str], ...]:
        """(group, bucket) of each map that `maps` returns."""
        ranges = [f"{low:g}-{high:g} m" for low, high in zip(self.distances, self.distances[1:], strict=False)]
        return (
            *(("distance", name) for name in ranges),
            *(("row", f"{name} third") for name in ("top", "middle", "bottom")),
            *(("column", f"{name} third") for name in ("left", "center", "right")),
            ("edge", "near an edge"),
            ("edge", "elsewhere"),
            ("edges", "at depth edges"),
            ("edges", "off depth edges"),
        )

    def maps(self, truth: Float[Tensor, "h w"]) -> Bool[Tensor, "k h w"]:
        """Return which pixels of a ground truth fall into each bucket, in the order of `names`."""
        height, width = truth.shape
        row = (torch.arange(height, device=truth.device) * 3 // height)[:, None].expand(height, width)
        column = (torch.arange(width, device=truth.device) * 3 // width)[None].expand(height, width)
        edge = near_edge(truth, self.edge_radius, self.edge_ratio)
        limits = zip(self.distances, self.distances[1:], strict=False)
        distances = [(truth >= low) & (truth < high) for low, high in limits]
        thirds = [part == third for part in (row, column) for third in range(3)]
        edges, dense = depth_edges(truth), bool((truth > 0).float().mean() >= DENSE)
        return torch.stack((*distances, *thirds, edge, ~edge, edges & dense, ~edges & dense))


def near_edge(truth: Float[Tensor, "h w"], radius: int, ratio: float) -> Bool[Tensor, "h w"]:
    """Find pixels whose measured neighbors in the same row differ in depth by more than a factor.

    Only the row is looked at: along it a flat road keeps its depth, while upwards it recedes without any edge. Works
    for dense depth and for scan lines, but takes in walls that recede fast; `depth_edges` is sharper.

    Args:
        truth: Depth in meters, 0 where unknown.
        radius: Neighbors within this many pixels to the left and right.
        ratio: Farthest over nearest of them that makes an edge.
    """
    if truth.numel() == 0:
        return truth > 0
    known = truth > 0
    closeness = torch.where(known, 1 / truth.clamp(min=1e-6), 0.0)
    near = _row_maximum(closeness, radius)  # inverse of the nearest depth; 0 where none is known
    return _row_maximum(truth, radius) * near > ratio


def depth_edges(truth: Float[Tensor, "h w"], radius: int = 2) -> Bool[Tensor, "h w"]:
    """Find pixels at depth edges of a dense ground truth and on thin things, which lie between two edges.

    Two neighbors in a row or column make an edge if their depths differ by more than `EDGE_RATIO` and neither surface
    continues to the other. A plane's inverse depth is linear in the image, so the change from each pixel to the one
    beyond it predicts the step between the two, and roads and walls that recede fast are no edges. Both pixels and all
    within ``radius`` of either are returned.

    Args:
        truth: Depth in meters, 0 where unknown; unknown pixels make no edges.
        radius: Pixels.
    """
    if truth.numel() == 0:
        return truth > 0
    edge = _row_edges(truth) | _row_edges(truth.T).T
    grown = max_pool2d(edge[None].float(), 2 * radius + 1, stride=1, padding=radius)
    return grown[0] > 0


def _row_edges(truth: Float[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Mark both pixels of each pair of neighbors in a row between which there is an edge."""
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
    """Largest of the non-negative values within ``radius`` columns, by windows that double: faster than pooling."""
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
        """Add an image; ``maps`` are `Buckets.maps` of its ground truth."""
        inside = maps[:, sample.mask].double()
        self._sums += (inside @ error_terms(sample.prediction, sample.target).T).cpu()
        self._counts += inside.sum(1).cpu()

    def rows(self, predictor: str, protocol: str) -> tuple[BucketRow, ...]:
        """Return the buckets that hold pixels."""
        errors = root_terms(self._sums / self._counts[:, None]).tolist()
        counted: Sequence[int] = self._counts.long().tolist()
        return tuple(
            BucketRow(predictor, protocol, group, bucket, count, tuple(row))
            for (group, bucket), count, row in zip(self.buckets.names, counted, errors, strict=True)
            if count
        )
