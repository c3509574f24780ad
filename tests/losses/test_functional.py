"""The loss functions against the field's numbers, by gradcheck, and at the edges."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import pytest
import torch
from torch import Tensor

from saunet.errors import ConfigError
from saunet.losses.functional import (
    automask,
    combine_sources,
    forward_differences,
    gradient_loss,
    masked_mean,
    photometric_error,
    smoothness_loss,
    sobel,
    ssim_loss,
)

Load = Callable[[str], Mapping[str, Any]]


@pytest.fixture
def load(reference: Load) -> Callable[[str], dict[str, Tensor]]:
    return lambda name: {key: torch.as_tensor(value) for key, value in reference(name).items()}


def double(*shape: int) -> Tensor:
    return torch.rand(*shape, dtype=torch.float64)


# --- against the reference -------------------------------------------------------------------------------------------


def test_ssim_reference(load: Callable[[str], dict[str, Tensor]]) -> None:
    data = load("ssim")
    prediction, target = data["prediction"], data["target"]
    torch.testing.assert_close(ssim_loss(prediction, target), data["ssim_loss"], rtol=0, atol=2e-4)
    torch.testing.assert_close(photometric_error(prediction, target), data["photometric"], rtol=0, atol=2e-4)
    torch.testing.assert_close(
        photometric_error(prediction, target, ssim_weight=0.0), data["photometric_l1_only"], rtol=0, atol=1e-6
    )


def test_objective_maps_reference(load: Callable[[str], dict[str, Tensor]]) -> None:
    data = load("objective")
    warped, raw = (torch.stack((data[f"{kind}_a"], data[f"{kind}_b"]), 1) for kind in ("warped", "raw"))
    errors = photometric_error(warped, data["target"][:, None])
    identity = photometric_error(raw, data["target"][:, None])
    torch.testing.assert_close(errors[:, :, 0], data["reprojection_losses"], rtol=0, atol=2e-4)
    torch.testing.assert_close(identity[:, :, 0], data["identity_losses"], rtol=0, atol=2e-4)
    best, unmoved = combine_sources(errors)[0], combine_sources(identity)[0]
    torch.testing.assert_close(torch.minimum(best, unmoved)[:, 0], data["minimum"], rtol=0, atol=2e-4)
    clear = data["automask_margin"] > 1e-4
    assert torch.equal(automask(best, unmoved)[:, 0][clear], data["automask"][clear] == 1)


def test_smoothness_reference(load: Callable[[str], dict[str, Tensor]]) -> None:
    data = load("objective")
    loss = smoothness_loss(data["sigmoid_disparity"], data["target"])
    torch.testing.assert_close(loss.double(), data["smoothness"], rtol=0, atol=1e-6)


def test_sobel_reference(load: Callable[[str], dict[str, Tensor]]) -> None:
    data = load("gradient")
    for padding, prefix in (("zero", "lapdepth"), ("replicate", "replicate")):
        for name, values in (("prediction", data["prediction"]), ("ground_truth", data["ground_truth"])):
            if f"{prefix}_sobel_x_{name}" not in data:
                continue
            gx, gy = sobel(values, padding)
            torch.testing.assert_close(gx, data[f"{prefix}_sobel_x_{name}"], rtol=0, atol=2e-4)
            torch.testing.assert_close(gy, data[f"{prefix}_sobel_y_{name}"], rtol=0, atol=2e-4)


def as_one_image(maps: Tensor) -> Tensor:
    """Stack a batch into one image, with an unknown row (0) between: the reference pools the pixels of the batch."""
    gap = maps.new_zeros(1, 1, 1, maps.shape[-1])
    return torch.cat([part for each in maps[:, None] for part in (each, gap)], 2)


def test_gradient_loss_reference(load: Callable[[str], dict[str, Tensor]]) -> None:
    data = load("gradient")
    maps, known = (data["prediction"], data["ground_truth"]), data["mask"] == 1
    expected = {
        ("forward_loss", "forward", "replicate", True),
        ("forward_loss_no_mask", "forward", "replicate", False),
        ("lapdepth_loss_no_mask", "sobel", "zero", False),
        ("replicate_loss_no_mask", "sobel", "replicate", False),
    }
    for name, operator, padding, masked in expected:
        given = (*map(as_one_image, maps), as_one_image(known)) if masked else (*maps, None)
        loss = gradient_loss(*given, operator, padding)
        torch.testing.assert_close(loss.double(), data[name], rtol=0, atol=1e-5)


@pytest.mark.parametrize(("padding", "name"), [("zero", "lapdepth_loss"), ("replicate", "replicate_loss")])
def test_lapdepths_weighting_is_a_line(load: Callable[[str], dict[str, Tensor]], padding: str, name: str) -> None:
    data = load("gradient")
    weight = torch.where(data["mask"] == 1, 1.0, 0.1)
    loss = sum((weight * g.abs()).mean() for g in sobel(data["prediction"] - data["ground_truth"], padding))
    torch.testing.assert_close(torch.as_tensor(loss).double(), data[name], rtol=0, atol=1e-5)


# --- derivatives -----------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("unchecked")
def test_gradcheck_photometric() -> None:
    warped, target = double(1, 2, 3, 4, 5).requires_grad_(), double(1, 1, 3, 4, 5).requires_grad_()
    assert torch.autograd.gradcheck(ssim_loss, (warped, target))
    assert torch.autograd.gradcheck(photometric_error, (warped, target))


@pytest.mark.parametrize("sources", ["minimum", "mean"])
def test_gradcheck_combine_sources(sources: str) -> None:
    errors, valid = double(2, 3, 1, 3, 4).requires_grad_(), torch.rand(2, 3, 1, 3, 4) > 0.4
    assert torch.autograd.gradcheck(lambda e: combine_sources(e, valid, sources)[0], errors)


def test_gradcheck_masked_mean_and_smoothness() -> None:
    values, mask = double(2, 1, 3, 4).requires_grad_(), torch.rand(2, 1, 3, 4) > 0.5
    assert torch.autograd.gradcheck(lambda v: masked_mean(v, mask), values)
    assert torch.autograd.gradcheck(smoothness_loss, (values, double(2, 3, 3, 4).requires_grad_()))


@pytest.mark.parametrize("operator", ["forward", "sobel"])
def test_gradcheck_gradient_loss(operator: str) -> None:
    prediction, target = double(2, 1, 5, 6).requires_grad_(), double(2, 1, 5, 6).requires_grad_()
    known = torch.rand(2, 1, 5, 6) > 0.1
    assert torch.autograd.gradcheck(lambda p, t: gradient_loss(p, t, known, operator), (prediction, target))


# --- meaning and edges -----------------------------------------------------------------------------------------------


def test_equal_images_have_no_error_and_flat_images_no_nan() -> None:
    image = torch.rand(2, 3, 6, 7)
    torch.testing.assert_close(photometric_error(image, image), torch.zeros(2, 1, 6, 7), rtol=0, atol=1e-6)
    flat = torch.full((2, 3, 6, 7), 0.5, requires_grad=True)
    photometric_error(flat, torch.zeros(2, 3, 6, 7)).sum().backward()
    assert flat.grad is not None
    assert flat.grad.isfinite().all()


def test_photometric_is_the_printed_mixture() -> None:
    a, b = torch.rand(2, 3, 6, 7), torch.rand(2, 3, 6, 7)
    expected = 0.85 * ssim_loss(a, b).mean(1, keepdim=True) + 0.15 * (a - b).abs().mean(1, keepdim=True)
    torch.testing.assert_close(photometric_error(a, b), expected)


def test_an_invalid_source_never_wins() -> None:
    errors = torch.tensor([0.1, 0.7]).reshape(1, 2, 1, 1, 1).expand(1, 2, 1, 1, 4)
    valid = torch.tensor([[1, 0, 1, 0], [1, 1, 0, 0]], dtype=torch.bool).reshape(1, 2, 1, 1, 4)
    best, known = combine_sources(errors, valid)
    torch.testing.assert_close(best.flatten(), torch.tensor([0.1, 0.7, 0.1, 0.0]))
    assert known.flatten().tolist() == [True, True, True, False]
    mean, _ = combine_sources(errors, valid, "mean")
    torch.testing.assert_close(mean.flatten(), torch.tensor([0.4, 0.7, 0.1, 0.0]))


def test_static_pixels_are_dropped_which_eq_11_as_printed_would_keep() -> None:
    identity, error = torch.zeros(1, 1, 1, 2), torch.tensor([0.2, 0.2]).reshape(1, 1, 1, 2)
    identity[..., 1] = 0.5  # left: a static pixel, right: a moving one
    ours, printed = automask(error, identity), identity < error
    assert ours.flatten().tolist() == [False, True]
    assert printed.flatten().tolist() == [True, False]


def test_noise_decides_ties() -> None:
    tie = torch.full((1, 1, 64, 64), 0.3)
    assert not automask(tie, tie).any()
    assert 0.4 < automask(tie, tie, noise=1e-5).float().mean() < 0.6


def test_masked_mean_of_nothing_is_zero_with_a_graph() -> None:
    values = torch.full((2, 3), torch.nan, requires_grad=True)
    loss = masked_mean(values, torch.zeros(2, 3, dtype=torch.bool))
    loss.backward()
    assert loss == 0
    assert values.grad is not None
    assert (values.grad == 0).all()


def test_masked_mean_takes_weights() -> None:
    values, weights = torch.tensor([[1.0, 2.0, 5.0]]), torch.tensor([[1.0, 3.0, 0.0]])
    torch.testing.assert_close(masked_mean(values, weights), torch.tensor(7 / 4))


@pytest.mark.parametrize("parts", [2, 3, 6])
def test_masked_mean_does_not_depend_on_how_a_batch_is_split(parts: int) -> None:
    values, mask = double(6, 2, 1, 5, 7), torch.rand(6, 2, 1, 5, 7) > torch.linspace(0, 1, 6).reshape(6, 1, 1, 1, 1)
    split = [masked_mean(v, m) for v, m in zip(values.chunk(parts), mask.chunk(parts), strict=True)]
    torch.testing.assert_close(torch.stack(split).mean(), masked_mean(values, mask), rtol=1e-12, atol=0)
    expected = [float(v[m].mean()) if m.any() else 0.0 for v, m in zip(values, mask, strict=True)]
    assert float(masked_mean(values, mask)) == pytest.approx(sum(expected) / 6)


def test_smoothness_ignores_scale_and_stops_at_edges() -> None:
    disparity, image = torch.rand(2, 1, 5, 6), torch.rand(2, 3, 5, 6)
    torch.testing.assert_close(smoothness_loss(disparity, image), smoothness_loss(disparity * 40, image))
    assert smoothness_loss(torch.ones(2, 1, 5, 6), image) == 0
    step = torch.cat((torch.ones(1, 1, 5, 3), 2 * torch.ones(1, 1, 5, 3)), -1)
    assert smoothness_loss(step, step.expand(1, 3, 5, 6)) < smoothness_loss(step, torch.ones(1, 3, 5, 6))


def test_forward_differences_and_sobel_on_a_ramp() -> None:
    ramp = (3 * torch.arange(6.0) + 5 * torch.arange(4.0)[:, None]).reshape(1, 1, 4, 6)
    dx, dy = forward_differences(ramp)
    assert (dx == 3).all()
    assert (dy == 5).all()
    gx, gy = sobel(ramp)
    assert (gx[..., 1:-1] == -24).all()
    assert (gy[..., 1:-1, :] == -40).all()


@pytest.mark.parametrize("operator", ["forward", "sobel"])
def test_only_known_neighbors_count(operator: str) -> None:
    prediction, target = torch.rand(1, 1, 8, 9), torch.rand(1, 1, 8, 9)
    known = torch.rand(1, 1, 8, 9) > 0.1
    loss = gradient_loss(prediction, target, known, operator)
    torch.testing.assert_close(gradient_loss(prediction, target.where(known, 1e6), known, operator), loss)
    assert gradient_loss(prediction, target.where(known, torch.nan), known, operator).isfinite()


@pytest.mark.parametrize("operator", ["forward", "sobel"])
def test_a_constant_offset_costs_nothing_unless_padding_is_zero(operator: str) -> None:
    flat = torch.full((1, 1, 6, 7), 10.0)
    assert gradient_loss(flat, 2 * flat, operator=operator) == 0
    assert gradient_loss(flat, 2 * flat, operator="sobel", padding="zero") > 0


def test_words_are_checked() -> None:
    x = torch.rand(1, 1, 4, 4)
    with pytest.raises(ConfigError, match=r"operator is 'sobell'; did you mean 'sobel'\? allowed: forward, sobel"):
        gradient_loss(x, x, operator="sobell")
    with pytest.raises(ConfigError, match=r"padding is 'reflect'.*allowed: replicate, zero"):
        sobel(x, "reflect")
    with pytest.raises(ConfigError, match="sources is 'max'"):
        combine_sources(x[:, None], None, "max")


def test_full_precision_inside_autocast() -> None:
    a, b = torch.rand(2, 3, 6, 7), torch.rand(2, 3, 6, 7)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert photometric_error(a.bfloat16(), b).dtype == torch.float32
        inside = photometric_error(a, b)
    torch.testing.assert_close(inside, photometric_error(a, b), rtol=0, atol=0)
