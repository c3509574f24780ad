"""The loss in one pass against the same as separate operations: values, gradients, maps, masks and edges."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from saunet.losses import one_pass
from saunet.losses.base import TermResult
from saunet.losses.terms import Monodepth2Photometric, Photometric
from saunet.types import Views

Make = Callable[..., Any]
SETTINGS: list[dict[str, Any]] = [
    {},
    {"automask": False},
    {"sources": "mean"},
    {"sources": "mean", "use_validity": False},
    {"reduction": "all"},
    {"reduction": "all", "automask": False},
    {"use_validity": False, "reduction": "all"},
    {"ssim_weight": 0.0},
    {"ssim_weight": 1.0},
    {"noise": 0.05},
]


def both(term: Photometric, inputs: Any) -> tuple[TermResult, TermResult]:
    """Return the term's result in one pass and as separate operations, with the same noise."""
    results = []
    for views in (Views(len(inputs.views), lambda: inputs.views), inputs.views):
        torch.manual_seed(5)
        results.append(term(inputs.batch, inputs.pyramid, inputs.poses, views))
    return results[0], results[1]


def gradients(value: Tensor, inputs: Any) -> tuple[Tensor, ...]:
    K = [inputs.batch["K"]] if inputs.batch["K"].requires_grad else []
    return torch.autograd.grad(value, (*inputs.leaves, *K), retain_graph=True)


def double(inputs: Any, **leaves: Tensor) -> Any:
    """The same inputs in double precision, with other outputs of the networks."""
    inputs.batch = {
        k: v.double() if isinstance(v, Tensor) and v.is_floating_point() else v for k, v in inputs.batch.items()
    }
    changed = [
        *inputs.sigmoid,
        leaves.get("axisangle", inputs.axisangle),
        leaves.get("translation", inputs.translation),
    ]
    return inputs.rebuilt(*(each.detach().double().requires_grad_() for each in changed))


@pytest.mark.parametrize("options", SETTINGS, ids=str)
@pytest.mark.parametrize("turn", [0.0, 0.5])
def test_values_gradients_and_maps(options: dict[str, Any], turn: float, make_inputs: Make) -> None:
    torch.manual_seed(0)
    inputs = make_inputs(sources=3, scales=3)
    turned = inputs.axisangle.detach().clone()
    turned[:, 1, 1] += turn  # the second source sees a part only
    inputs.batch["K"] = inputs.batch["K"].double().requires_grad_()  # as where a training refines it
    inputs = double(inputs, axisangle=turned)
    ours, separate = both(Photometric(**options), inputs)
    torch.testing.assert_close(ours.value, separate.value, rtol=1e-12, atol=1e-14)
    assert ours.maps.keys() == separate.maps.keys()
    for name, expected in separate.maps.items():
        torch.testing.assert_close(ours.maps[name], expected, rtol=0, atol=1e-11, msg=name)
    found, expected = (gradients(3 * each.value, inputs) for each in (ours, separate))
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-11)


def test_points_behind_the_camera(make_inputs: Make) -> None:
    torch.manual_seed(0)
    inputs = make_inputs()
    moved = inputs.translation.detach().clone()
    moved[:, 0, 2] = -1.0 / inputs.pyramid.disparity[0].mean()  # about half of the points
    for term in (Photometric(), Monodepth2Photometric()):
        again = double(inputs, translation=moved)
        ours, separate = both(term, again)
        torch.testing.assert_close(ours.value, separate.value, rtol=1e-12, atol=1e-14)
        found, expected = (gradients(each.value, again) for each in (ours, separate))
        for one, other in zip(found, expected, strict=True):
            assert one.isfinite().all()
            torch.testing.assert_close(one, other, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("leaf", ["axisangle", "translation", "sigmoid"])
def test_what_is_no_number_reaches_the_gradient(leaf: str, make_inputs: Make) -> None:
    inputs = make_inputs()
    leaves = [each.detach().clone() for each in inputs.leaves]
    leaves[{"sigmoid": 0, "axisangle": -2, "translation": -1}[leaf]].view(-1)[0] = torch.nan
    inputs = inputs.rebuilt(*(each.requires_grad_() for each in leaves))
    ours, separate = both(Photometric(noise=0.0), inputs)
    torch.testing.assert_close(ours.value, separate.value, equal_nan=True)
    found = gradients(ours.value, inputs)
    assert any(each.isnan().any() for each in found)


def test_nothing_in_view_is_worth_nothing(make_inputs: Make) -> None:
    inputs = make_inputs()
    away = inputs.translation.detach().clone()
    away[..., 0] = 1e4
    inputs = double(inputs, translation=away)
    ours, _ = both(Photometric(), inputs)
    assert ours.value == 0
    assert all((grad == 0).all() for grad in gradients(ours.value, inputs))


def test_float32_is_as_exact_as_the_separate_operations(make_inputs: Make) -> None:
    torch.manual_seed(0)
    inputs = make_inputs()
    term = Monodepth2Photometric()  # a pixel at a tie is no step in its mean
    ours, separate = (float(each.value.detach()) for each in both(term, inputs))
    exact = float(both(term, double(inputs))[1].value.detach())
    assert ours == pytest.approx(exact, abs=1e-6)
    assert separate == pytest.approx(exact, abs=1e-6)


def test_gradcheck(make_inputs: Make) -> None:
    torch.manual_seed(0)
    inputs = double(make_inputs(batch=1, scales=1, height=6, width=8))
    term = Photometric(noise=0.0, automask=False, sources="mean")  # without the kinks of minimum and mask

    def value(K: Tensor, *leaves: Tensor) -> Tensor:
        again = inputs.rebuilt(*leaves)
        return term({**again.batch, "K": K}, again.pyramid, again.poses, Views(1, lambda: again.views)).value

    K = inputs.batch["K"].clone().requires_grad_()
    assert torch.autograd.gradcheck(value, (K, *inputs.leaves), eps=1e-7, atol=1e-4)


def test_an_image_does_not_depend_on_the_others(make_inputs: Make) -> None:
    torch.manual_seed(0)
    inputs, term = make_inputs(), Photometric(noise=0.0)
    whole = both(term, inputs)[0].value
    found = gradients(whole, inputs)
    parts = []
    for one in (slice(0, 1), slice(1, 2)):
        inputs_of_one = make_inputs(batch=1)
        inputs_of_one.batch = {k: v[one] if isinstance(v, Tensor) else v for k, v in inputs.batch.items()}
        alone = inputs_of_one.rebuilt(*(leaf.detach()[one].requires_grad_() for leaf in inputs.leaves))
        value = both(term, alone)[0].value
        parts.append((value, *gradients(value, alone)))
    torch.testing.assert_close(whole, (parts[0][0] + parts[1][0]) / 2)
    for grad, first, second in zip(found, parts[0][1:], parts[1][1:], strict=True):
        assert torch.equal(grad, torch.cat((first, second)) / 2)


def test_repeated_it_is_the_same_to_the_last_bit_and_validation_too(make_inputs: Make) -> None:
    inputs, term = make_inputs(), Photometric(noise=0.0)
    first, second = both(term, inputs)[0], both(term, inputs)[0]
    assert torch.equal(first.value, second.value)
    grads = [gradients(each.value, inputs) for each in (first, second)]
    assert all(map(torch.equal, *grads))
    with torch.no_grad():
        assert torch.equal(both(term, inputs)[0].value, first.value)


def test_half_precision_around_it_changes_nothing(make_inputs: Make) -> None:
    inputs, term = make_inputs(), Photometric()
    outside = both(term, inputs)[0].value
    with torch.autocast("cpu", torch.bfloat16):
        inside = both(term, inputs)[0].value
    assert torch.equal(inside, outside)


@pytest.mark.parametrize("key", ["loss_target", "loss_sources"])
def test_what_learns_otherwise_gets_the_separate_operations(key: str, make_inputs: Make) -> None:
    inputs = make_inputs()
    assert one_pass.takes(inputs.batch)
    assert not one_pass.takes({**inputs.batch, key: inputs.batch[key].clone().requires_grad_()})
    assert not one_pass.takes({**inputs.batch, "loss_target": inputs.batch["loss_target"][..., :3]})


def test_pixels_of_the_own_vehicle_are_left_out(make_inputs: Make) -> None:
    inputs = make_inputs()
    inputs.batch["target_mask"] = (torch.rand_like(inputs.batch["loss_target"][:, :1]) > 0.5).float()
    ours, separate = both(Photometric(), inputs)
    assert ours.value == separate.value
    assert not ours.maps["automask"][inputs.batch["target_mask"] == 0].any()


def test_near_ties_of_bright_flat_areas_fall_as_in_double_precision(make_inputs: Make) -> None:
    torch.manual_seed(0)
    inputs = make_inputs()
    for key in ("loss_target", "loss_sources"):
        inputs.batch[key] = 0.9 + 0.01 * inputs.batch[key]
    term = Photometric(noise=0.0)
    ours, separate = both(term, inputs)
    exact = both(term, double(inputs))[1].maps["photometric_error"]
    errors = [(each.maps["photometric_error"] - exact).abs().mean() for each in (ours, separate)]
    assert errors[0] < 0.5 * errors[1]


def test_views_are_made_once_and_when_asked_for(make_inputs: Make) -> None:
    made: list[int] = []
    inputs = make_inputs(scales=2)
    views = Views(2, lambda: made.append(1) or inputs.views)  # type: ignore[func-returns-value]
    assert len(views) == 2
    assert not made
    assert list(views) == list(inputs.views)
    assert views[1] is inputs.views[1]
    assert made == [1]
