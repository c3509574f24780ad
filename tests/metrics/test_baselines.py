"""Trivial predictors: closed forms, filling, and that the metric scores them."""

from __future__ import annotations

import pickle

import pytest
import torch

from saunet.errors import ConfigError, DataError
from saunet.metrics.baselines import ConstantDepth, MeanDepthMap
from saunet.metrics.protocols import evaluate_image, protocol

IMAGE = torch.rand(2, 3, 8, 20)


def test_constant_depth():
    disparity = ConstantDepth(8.0)(IMAGE.half())
    assert disparity.shape == (2, 1, 8, 20)
    assert (disparity == 0.125).all()


def test_constant_is_the_median_after_scaling():
    truth = torch.rand(8, 20) * 30 + 5
    image = evaluate_image(ConstantDepth()(IMAGE)[0, 0], truth, protocol("synthetic"))
    middle = (truth.flatten().sort().values[79] + truth.flatten().sort().values[80]).double() / 2
    assert image.errors[0].item() == pytest.approx(((middle - truth).abs() / truth).mean().item(), rel=1e-6)


@pytest.mark.parametrize("depth", [0.0, -1.0, float("nan")])
def test_constant_must_be_positive(depth):
    with pytest.raises(ConfigError, match="depth is"):
        ConstantDepth(depth)


def test_mean_map_is_the_mean_over_images():
    model = MeanDepthMap(8, 20)
    depth = torch.rand(3, 1, 8, 20, dtype=torch.float64) * 50 + 1
    size = torch.tensor([[8, 20]] * 3)
    model.update(depth[:2], size[:2])
    model.update(depth[2:], size[2:])
    torch.testing.assert_close(model.depth_map(), depth.mean(0)[0].float())
    torch.testing.assert_close(model(IMAGE), (1 / depth.mean(0, keepdim=True).float()).expand(2, -1, -1, -1))


def test_mean_map_collects_native_sizes_in_the_right_cells():
    model = MeanDepthMap(2, 2)
    depth = torch.zeros(2, 1, 4, 6)
    depth[0, 0, :4, :4] = torch.tensor([[1.0, 1, 2, 2], [1, 1, 2, 2], [3, 3, 4, 4], [3, 3, 4, 4]])
    depth[1, 0, :2, :6] = torch.tensor([[1.0, 1, 1, 2, 2, 2], [3, 3, 3, 4, 4, 4]])
    model.update(depth, torch.tensor([[4, 4], [2, 6]]))
    torch.testing.assert_close(model.depth_map(), torch.tensor([[1.0, 2.0], [3.0, 4.0]]))
    assert model.count.tolist() == [[7, 7], [7, 7]]


def test_mean_map_skips_images_without_truth():
    model = MeanDepthMap(2, 2)
    depth = torch.full((2, 1, 4, 4), 3.0)
    model.update(depth, torch.tensor([[0, 0], [4, 4]]))
    assert model.count.sum() == 16


def test_mean_map_fills_unseen_cells_from_their_row_and_rows_from_the_nearest():
    model = MeanDepthMap(5, 4, max_depth=80.0)
    depth = torch.zeros(1, 1, 5, 4)
    depth[0, 0, 1] = torch.tensor([10.0, 0.0, 20.0, 0.0])
    depth[0, 0, 4] = torch.tensor([4.0, 90.0, 4.0, 80.0])  # beyond the limit counts as unknown
    model.update(depth, torch.tensor([[5, 4]]))
    filled = model.depth_map()
    assert filled[1].tolist() == [10, 15, 20, 15]
    assert filled[0].tolist() == [15] * 4
    assert filled[2].tolist() == [15] * 4
    assert filled[3].tolist() == [4] * 4
    assert filled[4].tolist() == [4] * 4


def test_mean_map_needs_ground_truth():
    with pytest.raises(DataError, match="has seen no ground truth"):
        MeanDepthMap()(IMAGE)


def test_mean_map_survives_pickle_and_state_dict():
    model = MeanDepthMap(4, 5)
    model.update(torch.rand(1, 1, 8, 20) + 1, torch.tensor([[8, 20]]))
    other = MeanDepthMap(4, 5)
    other.load_state_dict(model.state_dict())
    for copied in (other, pickle.loads(pickle.dumps(model))):
        torch.testing.assert_close(copied(IMAGE), model(IMAGE))


def test_resizes_to_any_image():
    model = MeanDepthMap(4, 5)
    model.update(torch.full((1, 1, 8, 20), 5.0), torch.tensor([[8, 20]]))
    torch.testing.assert_close(model(IMAGE), torch.full((2, 1, 8, 20), 0.2))
