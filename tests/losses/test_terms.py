"""Every registered term: derivatives, no host sync, pickling, and what happens at the edges."""

from __future__ import annotations

import dataclasses
import pickle
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

import saunet
from saunet.losses.base import Term, TermResult
from saunet.types import DepthPyramid, View

Make = Callable[..., Any]

VARIANTS: list[tuple[str, dict[str, Any]]] = [
    *((name, {}) for name in saunet.available("term")),
    ("photometric", {"sources": "mean"}),
    ("photometric", {"automask": False}),
    ("photometric", {"reduction": "all"}),
    *(("gradient", {"target": "lidar", "domain": domain}) for domain in ("depth", "log_depth", "disparity", "aligned")),
    ("gradient", {"target": "lidar", "domain": "depth", "operator": "sobel"}),
    ("gradient", {"target": "teacher", "domain": "log_depth"}),
]
IDS = ["-".join([name, *(f"{key}={value}" for key, value in options.items())]) for name, options in VARIANTS]
every_term = pytest.mark.parametrize(("name", "options"), VARIANTS, ids=IDS)


class NoHostSync(TorchDispatchMode):
    """Fail on what makes the host wait for the device: reading a value, or a size that depends on data."""

    forbidden = ("_local_scalar_dense", "nonzero", "masked_select", "unique", "is_nonzero")

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.__name__.split(".")[0]
        by_mask = name.startswith("index") and any(
            isinstance(item, Tensor) and item.dtype == torch.bool
            for argument in args
            if isinstance(argument, list | tuple)
            for item in argument
        )
        assert not by_mask, f"{name} by a mask waits for the device"
        assert name not in self.forbidden, f"{name} waits for the device"
        return func(*args, **(kwargs or {}))


def build(name: str, options: dict[str, Any]) -> Term:
    term: Term = saunet.build("term", name, **options)
    return term


@every_term
def test_value_is_finite_and_reaches_the_networks(name: str, options: dict[str, Any], make_inputs: Make) -> None:
    inputs = make_inputs()
    result = build(name, options)(*inputs)
    assert isinstance(result, TermResult)
    assert result.value.isfinite()
    assert result.value > 0
    result.value.backward()
    assert any(leaf.grad is not None and leaf.grad.abs().sum() > 0 for leaf in inputs.leaves)
    assert all(leaf.grad is None or leaf.grad.isfinite().all() for leaf in inputs.leaves)
    assert not any(picture.requires_grad for picture in result.maps.values())
    assert all(picture.shape == (2, 1, 16, 24) for picture in result.maps.values())


@pytest.mark.parametrize("name", ["photometric", "photometric_monodepth2"])
def test_photometric_teaches_depth_at_every_scale_and_motion(name: str, make_inputs: Make) -> None:
    inputs = make_inputs()
    build(name, {})(*inputs).value.backward()
    for leaf in inputs.leaves:
        assert leaf.grad.abs().sum() > 0


@every_term
@pytest.mark.usefixtures("unchecked")
def test_gradcheck(name: str, options: dict[str, Any], make_inputs: Make) -> None:
    if options.get("domain") == "aligned":
        pytest.skip("the median ratio is held fixed by design; see test_gradient.py")
    inputs = make_inputs(batch=1, height=6, width=8, dtype=torch.float64)
    term = build(name, options).eval()  # no tie-break noise

    def value(*leaves: Tensor) -> Tensor:
        return term(*inputs.rebuilt(*leaves)).value

    assert torch.autograd.gradcheck(value, inputs.leaves, eps=1e-7, atol=1e-5, rtol=1e-3)


@every_term
def test_no_host_sync(name: str, options: dict[str, Any], make_inputs: Make) -> None:
    inputs, term = make_inputs(), build(name, options)
    with NoHostSync():
        term(*inputs).value.backward()


def test_the_sync_detector_detects() -> None:
    x = torch.rand(3)
    for wait in (lambda: x.sum().item(), lambda: x[x > 0.5], lambda: bool(x.sum() > 0)):
        with pytest.raises(AssertionError, match="waits for the device"), NoHostSync():
            wait()


@every_term
def test_survives_pickling(name: str, options: dict[str, Any], make_inputs: Make) -> None:
    inputs, term = make_inputs(), build(name, options).eval()
    expected = term(*inputs).value
    torch.testing.assert_close(pickle.loads(pickle.dumps(term))(*inputs).value, expected, rtol=0, atol=0)


@every_term
def test_nothing_left_is_zero_with_a_graph(name: str, options: dict[str, Any], make_inputs: Make) -> None:
    if not build(name, options).can_be_empty:
        pytest.skip("a prior on the prediction: no pixel can be missing")
    inputs = make_inputs()
    if name == "photometric_monodepth2":
        options = {"use_validity": True, "reduction": "masked"}
    if options.get("reduction") == "all":
        options = {**options, "automask": False}  # with it, unwarped errors remain, as in Monodepth2
    batch = dict(inputs.batch)
    for key in ("target_depth", "target_teacher"):
        batch[key] = torch.zeros_like(batch[key])
    views = tuple(dataclasses.replace(view, valid=torch.zeros_like(view.valid)) for view in inputs.views)
    for key in ("distance", "T_tracked"):
        batch[key] = torch.full_like(batch[key], torch.nan)
    elsewhere = torch.zeros(4, 4)
    elsewhere[0, 3] = 1e5
    result = build(name, options)(batch, inputs.pyramid, inputs.poses + elsewhere, views)
    assert result.value == 0
    result.value.backward()
    grads = [leaf.grad for leaf in inputs.leaves if leaf.grad is not None]
    assert grads
    assert all((grad == 0).all() for grad in grads)


@every_term
@pytest.mark.parametrize("edge", ["constant images", "zero motion", "infinite depth"])
def test_edges_stay_finite(name: str, options: dict[str, Any], edge: str, make_inputs: Make) -> None:
    inputs = make_inputs()
    with torch.no_grad():
        if edge == "constant images":
            for key in ("target", "sources", "loss_target", "loss_sources"):
                inputs.batch[key] = torch.full_like(inputs.batch[key], 0.4)
        elif edge == "zero motion":
            inputs.axisangle.zero_()
            inputs.translation.zero_()
    inputs = inputs.rebuilt(*inputs.leaves)
    if edge == "infinite depth":
        disparity = tuple(d - d.detach() for d in inputs.pyramid.disparity)  # all zero, with a graph
        depth = tuple(torch.full_like(d, torch.inf).requires_grad_() for d in disparity)
        inputs.pyramid = DepthPyramid(sigmoid=disparity, disparity=disparity, depth=depth)
    value = build(name, options)(*inputs).value
    assert value.isfinite()
    value.backward()
    assert all(leaf.grad is None or leaf.grad.isfinite().all() for leaf in inputs.leaves)


def test_views_are_what_they_say(make_inputs: Make) -> None:
    inputs = make_inputs(scales=3)
    assert len(inputs.views) == 3
    assert all(isinstance(view, View) and view.image.shape == (2, 2, 3, 16, 24) for view in inputs.views)


@pytest.mark.parametrize("options", [{}, {"automask": False}, {"reduction": "all"}])
def test_pixels_of_the_own_vehicle_do_not_teach(options: dict[str, Any], make_inputs: Make) -> None:
    inputs, term = make_inputs(), build("photometric", options).eval()
    rest, middle = (inputs.pyramid, inputs.poses, inputs.views), inputs.batch["loss_target"].shape[-2] // 2
    shown = torch.ones_like(inputs.batch["target_depth"])
    value = term({**inputs.batch, "target_mask": shown}, *rest).value
    torch.testing.assert_close(value, term(*inputs).value, rtol=0, atol=0)
    shown[..., middle:, :] = 0
    target = inputs.batch["loss_target"].clone().requires_grad_()
    term({**inputs.batch, "target_mask": shown, "loss_target": target}, *rest).value.backward()
    assert target.grad is not None
    assert (target.grad[..., middle + 1 :, :] == 0).all()  # SSIM looks one pixel around
    assert target.grad[..., :middle, :].abs().max() > 0
