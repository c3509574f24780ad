"""Disparity, depth and scale against Monodepth2's numbers and NumPy's median."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest
import torch

from saunet.geometry.depth import disparity_to_depth, median_ratio, sigmoid_to_disparity


def test_reference(reference: Callable[[str], Mapping[str, Any]]) -> None:
    data = reference("depth_head")
    limits = float(data["min_depth"]), float(data["max_depth"])
    disparity = sigmoid_to_disparity(torch.from_numpy(data["sigmoid"]), *limits)
    torch.testing.assert_close(disparity, torch.from_numpy(data["scaled_disparity"]), rtol=2e-6, atol=2e-6)
    torch.testing.assert_close(disparity_to_depth(disparity), torch.from_numpy(data["depth"]), rtol=2e-6, atol=0)


def test_limits_and_gradcheck() -> None:
    ends = sigmoid_to_disparity(torch.tensor([0.0, 1.0], dtype=torch.float64), 0.1, 100.0)
    torch.testing.assert_close(disparity_to_depth(ends), torch.tensor([100.0, 0.1], dtype=torch.float64))
    sigmoid = torch.rand(2, 1, 2, 3, dtype=torch.float64).add_(0.1).requires_grad_()
    assert torch.autograd.gradcheck(lambda s: disparity_to_depth(sigmoid_to_disparity(s, 0.1, 100.0)), sigmoid)


def test_half_precision_network_output() -> None:
    assert sigmoid_to_disparity(torch.rand(2, 1, 2, 2, dtype=torch.bfloat16), 0.1, 100.0).dtype == torch.float32


@pytest.mark.parametrize("count", [1, 2, 3, 10, 11, 24])
def test_median_ratio_is_numpys(count: int) -> None:
    prediction, target = torch.rand(2, 1, 4, 6) + 0.1, torch.rand(2, 1, 4, 6) + 0.1
    mask = torch.zeros(2, 24, dtype=torch.bool)
    for row in mask:
        row[torch.randperm(24)[:count]] = True
    mask = mask.reshape(2, 1, 4, 6)
    expected = [np.median(target[i][mask[i]]) / np.median(prediction[i][mask[i]]) for i in range(2)]
    torch.testing.assert_close(median_ratio(prediction, target, mask), torch.tensor(expected), rtol=1e-6, atol=0)


def test_median_ratio_counts_differ_per_item_and_empty_is_one() -> None:
    prediction = torch.tensor([1.0, 2, 3, 4]).expand(3, 1, 1, 4)
    mask = torch.tensor([[1, 1, 1, 1], [1, 1, 0, 0], [0, 0, 0, 0]], dtype=torch.bool).reshape(3, 1, 1, 4)
    ratio = median_ratio(prediction, torch.full_like(prediction, 5.0), mask)
    torch.testing.assert_close(ratio, torch.tensor([2.0, 5 / 1.5, 1.0]))


def test_median_ratio_reference(reference: Callable[[str], Mapping[str, Any]]) -> None:
    data = reference("metrics")
    target = torch.from_numpy(data["plain_gt"])[:, None]
    prediction = torch.from_numpy(data["plain_prediction"])[:, None]
    ratio = median_ratio(prediction, target, (target > 1e-3) & (target < 80))
    torch.testing.assert_close(ratio.double(), torch.from_numpy(data["plain_median_ratio"]), rtol=2e-6, atol=0)
