"""The gradient term: eq. (13) in all its readings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import pytest
import torch
from torch import Tensor

from saunet.errors import ConfigError
from saunet.geometry.depth import median_ratio
from saunet.losses.functional import pool_known, smoothness_loss
from saunet.losses.terms import Gradient, Smoothness
from saunet.types import DepthPyramid

Load = Callable[[str], Mapping[str, Any]]
Make = Callable[..., Any]


def pyramid_of(*depths: Tensor) -> DepthPyramid:
    return DepthPyramid(sigmoid=depths, disparity=tuple(1 / d for d in depths), depth=depths)


def evaluate(term: Any, depths: tuple[Tensor, ...], **batch: Tensor) -> Tensor:
    value: Tensor = term(batch, pyramid_of(*depths), torch.eye(4).expand(len(depths[0]), 1, 4, 4), ()).value
    return value


@pytest.mark.parametrize(
    ("options", "masked", "name"),
    [
        ({}, True, "forward_loss"),
        ({}, False, "forward_loss_no_mask"),
        ({"operator": "sobel"}, False, "replicate_loss_no_mask"),
        ({"operator": "sobel", "padding": "zero"}, False, "lapdepth_loss_no_mask"),
    ],
)
def test_reference(reference: Load, options: dict[str, Any], masked: bool, name: str) -> None:
    data = {key: torch.as_tensor(value) for key, value in reference("gradient").items()}
    target = data["ground_truth"] * data["mask"] if masked else data["ground_truth"]
    prediction = data["prediction"]
    if masked:  # as one image, with an unknown row between: the reference pools the pixels of the batch
        rows = torch.zeros_like(target[:, :, :1])
        prediction, target = (
            torch.cat([maps, rows], 2).transpose(0, 1).flatten(1, 2)[None] for maps in (prediction, target)
        )
    value = evaluate(Gradient("lidar", "depth", **options), (prediction,), target_depth=target)
    torch.testing.assert_close(value.double(), data[name], rtol=0, atol=1e-5)


@pytest.mark.parametrize("domain", ["depth", "log_depth", "disparity", "aligned"])
def test_the_target_itself_costs_nothing(domain: str) -> None:
    target = torch.rand(2, 1, 8, 12) * 20 + 1
    assert evaluate(Gradient("lidar", domain, scales=[0]), (target.clone(),), target_depth=target) < 1e-6


@pytest.mark.parametrize("domain", ["log_depth", "aligned"])
def test_scale_free_domains_ignore_the_scale(domain: str) -> None:
    prediction, target = torch.rand(2, 1, 8, 12) + 1, torch.rand(2, 1, 8, 12) * 20 + 1
    term = Gradient("lidar", domain)
    one, other = (evaluate(term, (s * prediction,), target_depth=target) for s in (1.0, 37.0))
    torch.testing.assert_close(one, other, rtol=1e-4, atol=0)
    metric = Gradient("lidar", "depth")
    one, other = (evaluate(metric, (s * prediction,), target_depth=target) for s in (1.0, 37.0))
    assert not torch.isclose(one, other, rtol=0.1)


def test_the_median_ratio_is_held_fixed() -> None:
    target = torch.rand(2, 1, 8, 12) * 20 + 1
    prediction = (torch.rand(2, 1, 8, 12) + 1).requires_grad_()
    ratio = median_ratio(prediction.detach(), target, torch.ones_like(target, dtype=torch.bool))[:, None, None, None]
    grads = []
    for term, scaled in ((Gradient("lidar", "aligned"), prediction), (Gradient("lidar", "depth"), prediction * ratio)):
        grads.append(torch.autograd.grad(evaluate(term, (scaled,), target_depth=target), prediction)[0])
    torch.testing.assert_close(*grads)


@pytest.mark.parametrize("domain", ["depth", "log_depth", "disparity", "aligned"])
def test_sparse_target_counts_only_known_pairs(domain: str) -> None:
    target = torch.zeros(1, 1, 6, 8)
    target[0, 0, 2, 3], target[0, 0, 2, 4], target[0, 0, 5, 0] = 4.0, 6.0, 9.0  # one pair, one lonely pixel
    prediction = torch.full((1, 1, 6, 8), 5.0).requires_grad_()
    value = evaluate(Gradient("lidar", domain, scales=[0]), (prediction,), target_depth=target)
    expected = {"depth": 2.0, "log_depth": torch.log(torch.tensor(1.5)), "disparity": 1 / 4 - 1 / 6, "aligned": 2.0}
    torch.testing.assert_close(value, torch.as_tensor(expected[domain]))
    value.backward()
    assert prediction.grad is not None
    touched = prediction.grad[0, 0].nonzero().tolist()
    assert touched == [[2, 3], [2, 4]]


@pytest.mark.parametrize("hole", [0.0, float("nan"), float("inf")])
def test_holes_of_any_kind_are_unknown(hole: float) -> None:
    target = torch.rand(2, 1, 8, 12) + 1
    prediction = (torch.rand(2, 1, 8, 12) + 1).requires_grad_()
    torch.manual_seed(0)
    mask = torch.rand(2, 1, 8, 12) > 0.3
    term = Gradient("lidar", "aligned")
    expected = evaluate(term, (prediction,), target_depth=target * mask)
    value = evaluate(term, (prediction,), target_depth=target.where(mask, hole))
    torch.testing.assert_close(value, expected)
    value.backward()
    assert prediction.grad is not None
    assert prediction.grad.isfinite().all()


def test_coarse_scales_compare_at_their_own_size_per_image_pixel() -> None:
    ramp = torch.arange(16.0).expand(1, 1, 8, 16) + 10
    target = 3 * ramp
    coarse = pool_known(ramp, 4, 8)
    fine_value = evaluate(Gradient("lidar", "depth", scales=[0]), (ramp, coarse), target_depth=target)
    coarse_value = evaluate(Gradient("lidar", "depth", scales=[1]), (ramp, coarse), target_depth=target)
    torch.testing.assert_close(fine_value, torch.tensor(2.0))
    torch.testing.assert_close(coarse_value, torch.tensor(2.0))
    both = evaluate(Gradient("lidar", "depth"), (ramp, coarse), target_depth=target)
    torch.testing.assert_close(both, (fine_value + coarse_value) / 2)


def test_pooling_averages_what_is_known() -> None:
    depth = torch.tensor([[2.0, 0.0, 0.0, 0.0], [4.0, 0.0, 0.0, 0.0]]).reshape(1, 1, 2, 4)
    torch.testing.assert_close(pool_known(depth, 1, 2).flatten(), torch.tensor([3.0, 0.0]))


def test_image_target_is_smoothness_of_the_disparity() -> None:
    depth, image = torch.rand(2, 1, 8, 12) + 1, torch.rand(2, 3, 8, 12)
    value = evaluate(Gradient(), (depth,), loss_target=image)
    torch.testing.assert_close(value, smoothness_loss(1 / depth, image))


def test_teacher_is_followed_whatever_its_scale() -> None:
    depth, target = torch.rand(2, 1, 8, 12) + 1, torch.rand(2, 1, 8, 12) + 1
    term = Gradient("teacher", "log_depth")
    value = evaluate(term, (depth,), target_teacher=target)
    assert value > 0
    torch.testing.assert_close(value, evaluate(term, (depth,), target_teacher=9 * target), rtol=1e-4, atol=0)
    assert evaluate(term, (4 * target,), target_teacher=target) < 1e-6


def test_smoothness_averages_scales_with_their_weight() -> None:
    fine, coarse = torch.rand(2, 1, 8, 12), torch.rand(2, 1, 4, 6)
    image = torch.rand(2, 3, 8, 12)
    small = torch.nn.functional.avg_pool2d(image, 2)
    expected = (smoothness_loss(fine, image) + smoothness_loss(coarse, small) / 2) / 2
    torch.testing.assert_close(evaluate(Smoothness(), (fine, coarse), loss_target=image), expected)


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ("lidar", "the gradient term with target 'lidar' needs 'target_depth' in the batch, .*data.target_depth=true"),
        ("teacher", "the gradient term with target 'teacher' needs 'target_teacher' in the batch"),
    ],
)
def test_missing_target_is_one_sentence(target: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as raised:
        evaluate(Gradient(target), (torch.ones(1, 1, 8, 12),), loss_target=torch.rand(1, 3, 8, 12))
    assert "\n" not in str(raised.value)


def test_missing_scale_is_one_sentence(make_inputs: Make) -> None:
    with pytest.raises(ConfigError, match=r"gradient.scales holds 2 but the network predicts scales 0 to 1"):
        Gradient(scales=[0, 2])(*make_inputs(scales=2))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"target": "lider"}, r"target is 'lider'; did you mean 'lidar'\?"),
        ({"domain": "log"}, r"domain is 'log'.*allowed: depth, log_depth, disparity, aligned"),
        ({"operator": "backward"}, r"operator is 'backward'"),
        ({"padding": "zeros"}, r"padding is 'zeros'; did you mean 'zero'\?"),
        ({"scales": []}, r"scales is empty"),
    ],
)
def test_bad_settings(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Gradient(**options)
