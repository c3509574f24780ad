"""Running predictors over batches: the same numbers as the metric, and clear refusals."""

from __future__ import annotations

import dataclasses
import json

import pytest
import torch
from torch import nn

from saunet.errors import ConfigError, DataError
from saunet.evaluation import NetworkPredictor, score, write_results
from saunet.evaluation.scoring import Buckets, Shapes
from saunet.metrics.baselines import ConstantDepth, MeanDepthMap
from saunet.metrics.depth import DepthMetrics
from saunet.metrics.functional import ERROR_NAMES, flip_blend
from saunet.metrics.protocols import protocol
from saunet.reporting.inputs import read_evaluation
from saunet.reporting.tables import detail_tables
from saunet.runs.run import Run
from saunet.types import DepthPyramid

PROTOCOLS = [protocol("eigen_camera_z"), protocol("metric")]


def batches(count=3, images=2):
    for b in range(count):
        target = torch.rand(images, 3, 8, 16)
        yield {
            "target": target,
            "name": [f"drive {b * images + i:03d}" for i in range(images)],
            "depth": torch.rand(images, 1, 20, 30) * 40 + 2,
            "depth_size": torch.tensor([[20, 30]] * (images - 1) + [[18, 29]]),
        }


class Pyramid(nn.Module):
    def forward(self, image):
        disparity = image[:, :1] + 0.1
        return DepthPyramid(sigmoid=(disparity,), disparity=(disparity, disparity * 9), depth=(1 / disparity,))


def test_agrees_with_the_metric_for_every_predictor_and_protocol():
    data = list(batches())
    mean_map = MeanDepthMap(4, 8)
    for batch in data:
        mean_map.update(batch["depth"], batch["depth_size"])
    predictors = {
        name: NetworkPredictor(network)
        for name, network in {"model": Pyramid(), "constant": ConstantDepth(), "mean map": mean_map}.items()
    }
    result = score(predictors, iter(data), PROTOCOLS, total=6, progress=False)
    assert result.predictors == ("model", "constant", "mean map")
    assert len(result.rows) == 6 * 3 * 2
    for summary in result.summaries():
        metric = DepthMetrics(summary.protocol)
        for batch in data:
            metric.update(predictors[summary.predictor](batch), batch["depth"], batch["depth_size"])
        expected = metric.compute()
        for name, value in zip(ERROR_NAMES, summary.errors, strict=True):
            assert value == pytest.approx(expected[name].item(), rel=1e-12)
        assert summary.scale == pytest.approx(expected["scale"].item(), rel=1e-12)
        assert summary.scale_std == pytest.approx(expected["scale_std"].item(), rel=1e-6, abs=1e-9)
        assert summary.images == 6


def test_progress_goes_to_standard_error(capsys):
    score({"constant": NetworkPredictor(ConstantDepth())}, batches(), PROTOCOLS, total=6)
    assert capsys.readouterr().out == ""


def test_flip_is_the_blend_and_network_is_in_evaluation_mode():
    network = Pyramid().train()
    batch = next(batches())
    blended = NetworkPredictor(network, flip=True)(batch)
    assert not network.training
    assert not blended.requires_grad
    plain = batch["target"][:, :1] + 0.1
    torch.testing.assert_close(blended, flip_blend(plain, plain.flip(-1)))


def test_images_without_truth_are_kept_as_rows_and_left_out_of_means():
    data = list(batches())
    data[1]["depth"][0] = 0
    data[2]["depth_size"][1] = 0
    result = score({"m": NetworkPredictor(Pyramid())}, data, PROTOCOLS, buckets=Buckets(), progress=False)
    summary = result.summaries()[0]
    assert (summary.images, summary.images_without_truth) == (4, 2)
    assert all(value == value for value in summary.errors)
    assert result.errors("m", "metric").shape == (4, 7)
    blank = [row for row in result.rows if row.pixels == 0]
    assert {row.name for row in blank} == {"drive 002", "drive 005"}


def test_only_one_batch_is_pulled_at_a_time():
    alive = []

    def watched():
        for batch in batches():
            alive.append(len(alive))
            yield batch

    seen = []

    def predictor(batch):
        seen.append(len(alive))
        return batch["target"][:, :1] + 0.1

    score({"m": predictor}, watched(), PROTOCOLS, progress=False)
    assert seen == [1, 2, 3]


@pytest.mark.parametrize(
    ("predictors", "protocols", "ground_truth", "message"),
    [
        ({}, PROTOCOLS, "camera_z", "0 predictors and 2 protocols"),
        ({"m": ConstantDepth()}, [], "camera_z", "1 predictors and 0 protocols"),
        ({"m": ConstantDepth()}, PROTOCOLS * 2, "camera_z", "share a name"),
        ({"m": ConstantDepth()}, PROTOCOLS, "lidar_x", "'eigen_camera_z' is defined on 'camera_z' .* give 'lidar_x'"),
        ({"m": ConstantDepth()}, PROTOCOLS, "lidar", "did you mean 'lidar_x'"),
    ],
)
def test_impossible_requests(predictors, protocols, ground_truth, message):
    with pytest.raises(ConfigError, match=message):
        score(predictors, batches(), protocols, ground_truth=ground_truth, progress=False)


def test_bad_data():
    predictors = {"m": NetworkPredictor(ConstantDepth())}
    with pytest.raises(DataError, match="no image to evaluate"):
        score(predictors, [], PROTOCOLS, progress=False)
    batch = next(batches())
    del batch["depth_size"]
    with pytest.raises(DataError, match="'drive 000' comes with depth but without depth_size"):
        score(predictors, [batch], PROTOCOLS, progress=False)


def without_truth(batch):
    return {key: value for key, value in batch.items() if not key.startswith("depth")}


@pytest.mark.parametrize("place", [0, 1, 2])
def test_a_batch_without_truth_is_counted_and_not_scored(place):
    """Wherever it comes; and each predictor is still asked for it, since one that reads a file must not fall behind."""
    data = list(batches())
    asked = []

    def predictor(batch):
        asked.append(batch["name"][0])
        return batch["target"][:, :1] + 0.1

    others = [batch for position, batch in enumerate(data) if position != place]
    expected = score({"m": predictor}, others, PROTOCOLS, buckets=Buckets(), progress=False)
    data[place] = without_truth(data[place])
    asked.clear()
    result = score({"m": predictor}, data, PROTOCOLS, buckets=Buckets(), progress=False)
    assert asked == ["drive 000", "drive 002", "drive 004"]
    for got, wanted in zip(result.summaries(), expected.summaries(), strict=True):
        assert got == dataclasses.replace(wanted, images_without_truth=2)
    assert result.buckets == expected.buckets


def test_no_truth_at_all_is_refused():
    predictors = {"m": NetworkPredictor(ConstantDepth())}
    absent = [without_truth(batch) for batch in batches()]
    empty = [{**batch, "depth": batch["depth"] * 0} for batch in batches()]
    for data in (absent, empty, absent[:1] + empty[1:]):
        with pytest.raises(DataError, match=r"none of the 6 images has ground-truth depth .*protocols=\[campus\]"):
            score(predictors, data, PROTOCOLS, progress=False)


def test_bad_predictions():
    def nan(batch):
        return torch.full((2, 1, 4, 4), float("nan"))

    def short(batch):
        return torch.ones(1, 1, 4, 4)

    with pytest.raises(DataError, match="'m' returned non-finite values for image 'drive 000'"):
        score({"m": nan}, batches(), PROTOCOLS, progress=False)
    with pytest.raises(DataError, match=r"returned shape \(1, 1, 4, 4\) for 2 images"):
        score({"m": short}, batches(), PROTOCOLS, progress=False)


def test_factor_protocol_runs_beside_the_named_one():
    factor = dataclasses.replace(protocol("metric"), name="metric x2", factor=2.0)
    result = score({"m": NetworkPredictor(Pyramid())}, batches(), [protocol("metric"), factor], progress=False)
    first, second = result.summaries()
    assert first.scale == pytest.approx(2 * second.scale)


def test_shapes_of_a_perfect_and_of_a_far_prediction(tmp_path):
    depth = torch.full((1, 1, 20, 40), 30.0)
    depth[..., 15:] = 10.0
    K = torch.tensor([[[20.0, 0.0, 9.5], [0.0, 20.0, 4.5], [0.0, 0.0, 1.0]]])
    batch = {"target": torch.rand(1, 3, 10, 20), "K": K, "name": ["a 0"], "depth": depth}
    batch["depth_size"] = torch.tensor([[20, 40]])
    predictors = {"same": lambda batch: 1 / batch["depth"], "far": lambda batch: 0.9 / batch["depth"].roll(2, -1)}
    rules = [dataclasses.replace(protocol("synthetic"), alignment="none")]
    shapes = Shapes(boundaries=True, cloud=0.1)
    result = score(predictors, iter([batch]), rules, ground_truth="exact", shapes=shapes, progress=False)
    same, far = result.shapes
    assert (same.edge_accuracy, same.edge_completeness, same.precision, same.recall, same.f_score) == (0, 0, 1, 1, 1)
    assert far.edge_accuracy == pytest.approx(2, abs=0.3)
    assert far.f_score == 0
    first = result.shape_summaries()[0]
    assert (first.f_score, first.edge_images, first.cloud_images) == (1, 1, 1)
    titles = [table.title for table in result.tables()]
    assert titles[1:] == ["synthetic: depth edges", "synthetic: point clouds"]
    files = write_results(result, tmp_path)
    assert files["shapes.csv"].read_text().splitlines()[1] == "same,synthetic,a 0,0.0,0.0,1.0,1.0,1.0"
    assert json.loads(files["metrics.json"].read_text())["settings"] == {"cloud": 0.1}
    assert not detail_tables({"mine": Run(tmp_path, details=read_evaluation(tmp_path).details)})  # no model among them
    renamed = {("model" if name == "same" else name): each for name, each in predictors.items()}
    result = score(
        renamed, iter([batch]), rules, ground_truth="exact", shapes=shapes, progress=False, buckets=Buckets()
    )
    write_results(result, tmp_path)
    buckets, edges = detail_tables({"mine": Run(tmp_path, details=read_evaluation(tmp_path).details)})
    assert "at depth edges" in buckets.csv()
    assert edges.rows[0].cells == ("mine", 0, 0, 1, 1, 1)
