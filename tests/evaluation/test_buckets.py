"""Errors by bucket: which pixels fall where, and that the buckets add up."""

from __future__ import annotations

import csv
import io

import numpy as np
import pytest
import torch
from rich.console import Console

from saunet.errors import ConfigError
from saunet.evaluation import score, write_results
from saunet.evaluation.scoring import Buckets, BucketSums, depth_edges, near_edge
from saunet.metrics.functional import ERROR_NAMES
from saunet.metrics.protocols import evaluate_image, protocol, sample_image
from saunet.tables import show

RULES = protocol("synthetic")


def test_every_pixel_is_in_one_bucket_of_each_group():
    truth = torch.rand(11, 20) * 79 + 0.5
    buckets = Buckets()
    maps = buckets.maps(truth)
    groups = [group for group, _ in buckets.names]
    assert len(maps) == len(groups)
    for group in ("distance", "row", "column", "edge", "edges"):
        chosen = torch.tensor([name == group for name in groups])
        assert (maps[chosen].sum(0) == 1).all(), group


def test_names_follow_the_maps():
    truth = torch.full((9, 9), 15.0)
    truth[0, 0] = 5.0
    buckets = Buckets(distances=(0.0, 10.0, 20.0), edge_radius=1)
    found = dict(zip(buckets.names, buckets.maps(truth), strict=True))
    assert found["distance", "0-10 m"].sum() == 1
    assert found["distance", "10-20 m"].sum() == 80
    assert found["row", "top third"][:3].all()
    assert found["column", "right third"][:, 6:].all()
    assert found["column", "right third"].sum() == 27
    assert found["edge", "near an edge"].nonzero().tolist() == [[0, 0], [0, 1]]


def test_edges_in_dense_depth_but_not_on_a_road():
    truth = torch.full((20, 30), 40.0)
    truth[5:15, 10:20] = 10.0
    edge = near_edge(truth, 2, 1.25)
    assert edge[10].nonzero()[:, 0].tolist() == [8, 9, 10, 11, 18, 19, 20, 21]
    assert not edge[2].any()
    road = (100 / torch.arange(1.0, 21.0))[:, None].expand(20, 30)
    assert not near_edge(road, 4, 1.25).any()


def test_edges_between_sparse_points():
    truth = torch.zeros(1, 30)
    truth[0, 5], truth[0, 8], truth[0, 20], truth[0, 29] = 10.0, 30.0, 30.0, 90.0
    edge = near_edge(truth, 3, 1.25)
    assert edge[0, 5]
    assert edge[0, 8]
    assert not edge[0, 20]
    assert not near_edge(truth, 2, 1.25)[truth > 0].any()
    assert not near_edge(torch.zeros(4, 9), 2, 1.25).any()


def test_depth_edges_are_where_neither_surface_goes_on():
    """A box before a wall, a pole one pixel wide, and surfaces that recede fast."""
    truth = torch.full((24, 40), 40.0)
    truth[6:18, 10:20] = 10.0
    edges = depth_edges(truth, radius=0)
    expected = torch.zeros_like(edges)
    for row in range(6, 18):
        expected[row, [9, 10, 19, 20]] = True
    for column in range(10, 20):
        expected[[5, 6, 17, 18], column] = True
    assert torch.equal(edges, expected)
    assert depth_edges(truth)[11].nonzero()[:, 0].tolist() == [*range(7, 13), *range(17, 23)]
    pole = torch.full((10, 21), 30.0)
    pole[:, 10] = 8.0
    assert depth_edges(pole)[4].nonzero()[:, 0].tolist() == [*range(7, 14)]
    road = (60 / torch.arange(1.0, 25.0)).flip(0)[:, None].expand(24, 40)
    for plane in (road, road.flip(0), (30 / torch.arange(1.0, 41.0))[None].expand(24, 40)):
        assert plane.max() / plane.min() > 20
        assert not depth_edges(plane).any()


def test_depth_edges_need_dense_truth_and_known_neighbors():
    truth = torch.full((12, 30), 40.0)
    truth[:, 15:] = 10.0
    holes = truth.clone()
    holes[:, 14] = 0
    assert not depth_edges(holes).any()
    assert not depth_edges(torch.zeros(4, 9)).any()
    assert depth_edges(torch.zeros(0, 0)).shape == (0, 0)
    names = Buckets().names
    at, off = (place for place, (group, _) in enumerate(names) if group == "edges")
    dense = Buckets().maps(truth)
    assert (dense[at].sum().item(), dense[off].sum().item()) == (12 * 6, 12 * 24)
    scan = torch.where(torch.arange(12)[:, None] % 3 == 0, truth, 0.0)
    sparse = Buckets().maps(scan)
    assert not sparse[at].any()
    assert not sparse[off].any()


def test_an_error_planted_at_edges_shows_there():
    truth = torch.full((20, 40), 30.0)
    truth[:, 25:] = 10.0
    disparity = 1 / truth
    disparity[:, 22:28] /= 1.1
    sums = BucketSums(Buckets())
    sums.add(sample_image(disparity, truth, RULES), Buckets().maps(truth))
    found = {row.bucket: row.errors[0] for row in sums.rows("m", "synthetic") if row.group == "edges"}
    assert found == pytest.approx({"at depth edges, on thin things": 0.1, "away from depth edges": 0.0}, abs=1e-6)


def test_buckets_add_up_to_the_whole_image():
    torch.manual_seed(3)
    disparity, truth = torch.rand(6, 10) * 0.2 + 0.02, torch.rand(12, 20) * 79
    buckets = Buckets()
    sums = BucketSums(buckets)
    sums.add(sample_image(disparity, truth, RULES), buckets.maps(truth))
    rows = sums.rows("m", RULES.name)
    whole = evaluate_image(disparity, truth, RULES)
    for group in ("distance", "row", "column", "edge", "edges"):
        mine = [row for row in rows if row.group == group]
        assert sum(row.pixels for row in mine) == whole.pixels
        weights = np.array([row.pixels for row in mine]) / whole.pixels
        errors = np.array([row.errors for row in mine])
        errors[:, 2:4] **= 2
        pooled = weights @ errors
        pooled[2:4] **= 0.5
        np.testing.assert_allclose(pooled, whole.errors.numpy(), rtol=1e-10)


def test_error_planted_in_one_distance_shows_there_alone():
    truth = torch.full((12, 30), 15.0)
    truth[:, 20:] = 45.0
    disparity = 1 / truth
    disparity[:, 20:] /= 1.1
    buckets = Buckets()
    sums = BucketSums(buckets)
    sums.add(sample_image(disparity, truth, RULES), buckets.maps(truth))
    found = {row.bucket: row.errors[0] for row in sums.rows("m", "synthetic") if row.group == "distance"}
    assert found == pytest.approx({"10-20 m": 0.0, "30-50 m": 0.1}, abs=1e-6)


def test_in_an_evaluation(tmp_path):
    def batches():
        for b in range(2):
            yield {
                "target": torch.rand(2, 3, 8, 10),
                "name": [f"{b}a", f"{b}b"],
                "depth": torch.rand(2, 1, 12, 20) * 60 + 1,
                "depth_size": torch.tensor([[12, 20], [10, 19]]),
            }

    predictors = {"one": lambda batch: batch["target"][:, :1] + 0.1, "two": lambda batch: batch["target"][:, 1:2] + 0.1}
    result = score(predictors, batches(), [RULES], ground_truth="exact", buckets=Buckets(), progress=False)
    for predictor in predictors:
        rows = [row for row in result.buckets if row.predictor == predictor and row.group == "row"]
        assert sum(row.pixels for row in rows) == 2 * (12 * 20 + 10 * 19)
    stream = io.StringIO()
    show(result.tables(), Console(file=stream, width=150))
    assert "near an edge" in stream.getvalue()
    with write_results(result, tmp_path)["buckets.csv"].open(newline="") as file:
        table = list(csv.DictReader(file))
    assert len(table) == len(result.buckets)
    assert float(table[0][ERROR_NAMES[0]]) == result.buckets[0].errors[0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"distances": (0.0, 10.0, 10.0)}, "distances are"),
        ({"distances": (5.0,)}, "at least two limits"),
        ({"edge_ratio": 1.0}, "edge_ratio is 1.0"),
        ({"edge_radius": 0}, "edge_radius is 0"),
    ],
)
def test_bad_buckets(change, message):
    with pytest.raises(ConfigError, match=message):
        Buckets(**change)


@pytest.mark.parametrize("radius", [1, 2, 3, 4, 7, 60])
def test_edges_are_those_of_a_plain_search(radius):
    truth = torch.rand(6, 40) * 30 * (torch.rand(6, 40) > 0.6)
    expected = torch.zeros_like(truth, dtype=torch.bool)
    for row in range(6):
        for column in range(40):
            near = truth[row, max(0, column - radius) : column + radius + 1]
            known = near[near > 0]
            expected[row, column] = len(known) > 0 and known.max() / known.min() > 1.5
    assert torch.equal(near_edge(truth, radius, 1.5), expected)
