"""The metric object: reference values, any sharding, padding, empty ground truth, pickling."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
import torch

from saunet.errors import ConfigError, DataError
from saunet.metrics.depth import DepthMetrics, native_depths
from saunet.metrics.functional import ERROR_NAMES
from saunet.metrics.protocols import evaluate_image, protocol

SIZES = [(37, 62), (40, 60), (38, 61), (40, 62), (36, 62), (37, 60), (39, 59)]


def samples():
    disparity = torch.rand(len(SIZES), 1, 12, 20) * 0.3 + 0.02
    depth = torch.zeros(len(SIZES), 1, 40, 62)
    for truth, (height, width) in zip(depth, SIZES, strict=True):
        truth[0, :height, :width] = torch.rand(height, width) * 85 * (torch.rand(height, width) > 0.7)
    return disparity, depth, torch.tensor(SIZES)


def one_pass(disparity, depth, size, **kwargs):
    metric = DepthMetrics(**kwargs)
    metric.update(disparity, depth, size)
    return metric


def test_reference(reference):
    data = reference("metrics")
    metric = one_pass(
        torch.from_numpy(data["eigen_disparity"])[:, None],
        torch.from_numpy(data["eigen_gt"])[:, None],
        torch.tensor([[375, 1242]] * 2),
    )
    values = metric.compute()
    expected = data["eigen_metrics_median_scaled"].mean(0)
    for name, value in zip(ERROR_NAMES, expected, strict=True):
        tolerance = {"abs": 1e-6} if name in ("a1", "a2", "a3") else {"rel": 1e-6}
        assert values[name].item() == pytest.approx(value, **tolerance), name
    ratios = data["eigen_median_ratio"]
    assert values["scale"].item() == pytest.approx(ratios.mean(), rel=1e-5)
    assert values["scale_std"].item() == pytest.approx(ratios.std(), rel=1e-4)
    assert values["images"] == 2


def test_mean_over_images_at_native_sizes():
    disparity, depth, size = samples()
    values = one_pass(disparity, depth, size).compute()
    rows = [
        evaluate_image(d[0], t[0, :h, :w], protocol("eigen_camera_z")).errors
        for d, t, (h, w) in zip(disparity, depth, SIZES, strict=True)
    ]
    for i, name in enumerate(ERROR_NAMES):
        assert values[name].item() == pytest.approx(torch.stack(rows)[:, i].mean().item(), rel=1e-13)


@pytest.mark.parametrize("parts", [[7], [4, 3], [5, 1, 1], [1, 1, 1, 1, 1, 1, 1]])
def test_any_sharding_gives_the_same_numbers(parts):
    disparity, depth, size = samples()
    expected = one_pass(disparity, depth, size).compute()
    shards = [one_pass(*batch) for batch in zip(*(x.split(parts) for x in (disparity, depth, size)), strict=True)]
    merged = shards[0]
    for shard in shards[1:]:
        merged.merge_state(shard)
    for name, value in merged.compute().items():
        assert value.item() == pytest.approx(expected[name].item(), rel=1e-12), name


def test_every_state_is_summed_over_processes():
    metric = DepthMetrics()
    assert all(reduce is torch.sum or reduce.__name__ == "dim_zero_sum" for reduce in metric._reductions.values())
    assert metric.error_sum.dtype == torch.float64
    metric.half()
    assert metric.error_sum.dtype == torch.float64


def test_image_without_truth_is_counted_not_nan():
    disparity, depth, size = samples()
    without = one_pass(disparity[:3], depth[:3], size[:3]).compute()
    depth[3] = 0
    values = one_pass(disparity[:4], depth[:4], size[:4]).compute()
    assert values["images"] == 3
    assert values["images_without_truth"] == 1
    for name in ERROR_NAMES:
        assert values[name] == without[name]


def test_image_without_even_a_size():
    disparity, depth, size = samples()
    size[2] = 0
    values = one_pass(disparity, depth, size).compute()
    assert (values["images"], values["images_without_truth"]) == (6, 1)
    assert values["abs_rel"].isfinite()


def test_states_made_under_inference_mode_can_be_used_in_training_afterwards():
    disparity, depth, size = samples()
    metric = DepthMetrics()
    with torch.inference_mode():
        metric.update(disparity, depth, size)
    metric.update(disparity, depth, size)
    assert metric.compute()["images"] == 14


@pytest.mark.filterwarnings("ignore:The ``compute`` method")
def test_no_image_at_all_is_nan_with_a_count_of_zero():
    values = DepthMetrics().compute()
    assert values["images"] == 0
    assert np.isnan(values["abs_rel"].item())


def test_protocols_by_name_or_object():
    disparity, depth, size = samples()
    by_name = one_pass(disparity, depth, size, protocol="metric").compute()
    by_object = one_pass(disparity, depth, size, protocol=protocol("metric")).compute()
    assert by_name["abs_rel"] == by_object["abs_rel"]
    assert by_name["abs_rel"] != one_pass(disparity, depth, size).compute()["abs_rel"]


def test_pickle_copy_and_reset():
    disparity, depth, size = samples()
    metric = one_pass(disparity, depth, size)
    expected = metric.compute()
    for other in (pickle.loads(pickle.dumps(metric)), copy.deepcopy(metric)):
        assert {k: v.item() for k, v in other.compute().items()} == {k: v.item() for k, v in expected.items()}
    metric.reset()
    assert metric.images == 0
    assert metric.error_sum.abs().sum() == 0


def test_unknown_protocol():
    with pytest.raises(ConfigError, match="did you mean 'metric'"):
        DepthMetrics("metrics")


def test_mismatched_batches():
    disparity, depth, size = samples()
    with pytest.raises(DataError, match="does not fit into its padded map 40x62"):
        DepthMetrics().update(disparity, depth, size.flip(-1))
    with pytest.raises(DataError, match="got 3 predictions, 7 ground truths"):
        native_depths(depth, size, images=3)
