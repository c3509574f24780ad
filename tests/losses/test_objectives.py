"""Objectives: weighted sums against Monodepth2's total, from Python and from config."""

from __future__ import annotations

import pickle
import subprocess
import sys
from collections.abc import Callable, Mapping
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

import saunet
from saunet.cli.compose import structured
from saunet.errors import ConfigError
from saunet.losses.base import Objective, Term, TermResult
from saunet.losses.objectives import Monodepth2Objective, SaunetObjective
from saunet.losses.terms import Gradient, Monodepth2Photometric, Photometric, Smoothness
from saunet.registry import instantiate, objectives
from saunet.types import DepthPyramid, LossTerms, View

Make = Callable[..., Any]
every_objective = pytest.mark.parametrize("name", saunet.available("objective"))


class Constant(Term):
    """A term of one's own."""

    def __init__(self, value: float = 2.0) -> None:
        super().__init__()
        self.value = value

    def forward(self, batch: Any, pyramid: Any, poses: Any, views: Any) -> TermResult:
        return TermResult(value=0 * poses.sum() + self.value)


def test_monodepth2_total(reference: Callable[[str], Mapping[str, Any]]) -> None:
    data = {key: torch.as_tensor(value) for key, value in reference("objective").items()}
    disparity = data["sigmoid_disparity"]
    pyramid = DepthPyramid(sigmoid=(disparity,), disparity=(disparity,), depth=(1 / disparity,))
    warped, raw = (torch.stack((data[f"{kind}_a"], data[f"{kind}_b"]), 1) for kind in ("warped", "raw"))
    view = View(image=warped, valid=torch.zeros_like(warped[:, :, :1], dtype=torch.bool))  # must not matter
    batch = {"loss_target": data["target"], "loss_sources": raw}
    objective = Monodepth2Objective(photometric=Monodepth2Photometric(noise=0.0))
    result = objective(batch, pyramid, torch.eye(4).expand(2, 2, 4, 4), (view,))
    torch.testing.assert_close(result.total.double(), data["md2_total"], rtol=0, atol=1e-6)
    torch.testing.assert_close(result.values["photometric"].double(), data["md2_photometric_mean"], rtol=0, atol=1e-6)
    torch.testing.assert_close(result.values["smoothness"].double(), data["smoothness"], rtol=0, atol=1e-6)


def test_eq_14(make_inputs: Make) -> None:
    inputs = make_inputs()
    result = SaunetObjective()(*inputs)
    one = Photometric().eval()(*inputs).value
    two = Gradient()(*inputs).value
    torch.testing.assert_close(SaunetObjective().eval()(*inputs).total, 10 * one + 0.1 * two)
    assert list(result.values) == ["photometric", "gradient"]
    assert result.named("train").keys() == {"train/loss", "train/photometric", "train/gradient"}


@every_objective
def test_contract(name: str, make_inputs: Make) -> None:
    inputs, objective = make_inputs(scales=4), saunet.build("objective", name).eval()
    result = objective(*inputs)
    assert isinstance(result, LossTerms)
    assert result.maps["automask"].shape == result.maps["photometric_error"].shape == (2, 1, 16, 24)
    assert not result.maps["automask"].requires_grad
    weighted = sum(objective.weights[key] * value for key, value in result.values.items())
    torch.testing.assert_close(result.total, weighted)
    result.total.backward()
    for leaf in inputs.leaves:
        assert leaf.grad is not None
        assert leaf.grad.isfinite().all()
        assert leaf.grad.abs().sum() > 0
    again = pickle.loads(pickle.dumps(objective))
    torch.testing.assert_close(again(*inputs).total, result.total, rtol=0, atol=0)


@every_objective
def test_nothing_half_precision_inside_autocast(name: str, make_inputs: Make) -> None:
    inputs, objective = make_inputs(), saunet.build("objective", name).eval()
    expected = objective(*inputs).total
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = objective(*inputs).total
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=0)


# --- from config -----------------------------------------------------------------------------------------------------


def composed(name: str, *dotlist: str) -> dict[str, Any]:
    node = OmegaConf.structured(structured(objectives.node(name)))
    merged = OmegaConf.merge(node, OmegaConf.from_dotlist(list(dotlist)))
    container: Any = OmegaConf.to_container(merged, resolve=True)
    return container  # type: ignore[no-any-return]


@every_objective
def test_default_config_builds_the_default_object(name: str, make_inputs: Make) -> None:
    inputs = make_inputs()
    from_config, direct = instantiate(composed(name)).eval(), saunet.build("objective", name).eval()
    assert from_config.weights == direct.weights
    torch.testing.assert_close(from_config(*inputs).total, direct(*inputs).total, rtol=0, atol=0)


def test_nested_terms_are_config_nodes() -> None:
    built = instantiate(
        composed(
            "saunet",
            "beta=0.5",
            "photometric.sources=mean",
            "gradient.target=lidar",
            "gradient.scales=[0,1]",
            "extra.smoothness.weight=0.001",
            "extra.sharp.term=gradient",
            "extra.sharp.weight=1",
            "extra.sharp.operator=sobel",
        )
    )
    assert built.weights == {"photometric": 10.0, "gradient": 0.5, "smoothness": 0.001, "sharp": 1.0}
    assert built.terms["photometric"].sources == "mean"
    assert built.terms["gradient"].target == "lidar"
    assert built.terms["gradient"].scales == (0, 1)
    assert isinstance(built.terms["smoothness"], Smoothness)
    assert built.terms["sharp"].operator == "sobel"


def test_monodepth2s_nested_defaults_are_monodepth2s() -> None:
    photometric = instantiate(composed("monodepth2")).terms["photometric"]
    assert photometric.reduction == "all"
    assert not photometric.use_validity


def test_misspelt_key_fails_while_composing() -> None:
    with pytest.raises(Exception, match="'ssim_wieght' not in 'Photometric'"):
        composed("saunet", "photometric.ssim_wieght=0.5")


# --- extra terms and weights -----------------------------------------------------------------------------------------


def test_a_term_of_ones_own(make_inputs: Make) -> None:
    inputs = make_inputs()
    plain = SaunetObjective().eval()(*inputs)
    more = SaunetObjective(extra={"mine": {"weight": 3, "term": Constant()}}).eval()(*inputs)
    torch.testing.assert_close(more.total, plain.total + 6)
    assert more.values["mine"] == 2


def test_weight_zero_leaves_a_term_out(make_inputs: Make) -> None:
    inputs = make_inputs()
    del inputs.batch["target_depth"]
    objective = SaunetObjective(beta=0.0, gradient=Gradient("lidar"))  # would fail without target_depth
    assert list(objective(*inputs).values) == ["photometric"]


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: SaunetObjective(alpha=-1.0), "the weight of loss term 'photometric' is -1.0; it must be at least 0"),
        (lambda: SaunetObjective(alpha=0.0, beta=0.0), "all loss weights are 0"),
        (lambda: SaunetObjective(extra={"smothness": {"weight": 1.0}}), "unknown term 'smothness'; did you mean"),
        (lambda: SaunetObjective(extra={"smoothness": {}}), "extra term 'smoothness' has no weight"),
        (lambda: SaunetObjective(extra={"smoothness": 0.1}), "extra term 'smoothness' is 0.1; it must be a mapping"),
        (
            lambda: SaunetObjective(extra={"smoothness": {"weight": "much"}}),
            "has the weight 'much'; it must be a number",
        ),
        (lambda: SaunetObjective(extra={"gradient": {"weight": 1.0}}), "has the name of one of the objective's own"),
        (
            lambda: SaunetObjective(extra={"x": {"term": "gradient", "weight": 1.0, "tagret": "lidar"}}),
            "term 'gradient' has no parameter 'tagret'; did you mean 'target'",
        ),
        (
            lambda: SaunetObjective(extra={"x": {"term": Constant(), "weight": 1.0, "value": 3}}),
            "extra term 'x' is already built, so value cannot be set",
        ),
    ],
)
def test_bad_weights_and_extras(build: Callable[[], Objective], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as raised:
        build()
    assert "\n" not in str(raised.value)


COMPILE = """
import torch, saunet
from saunet.geometry.depth import disparity_to_depth, sigmoid_to_disparity
from saunet.geometry.pose import pose_matrix
from saunet.geometry.warp import synthesize
from saunet.types import DepthPyramid

batch = {key: torch.rand(2, 3, 16, 24) for key in ("target", "loss_target")}
batch |= {key: torch.rand(2, 2, 3, 16, 24) for key in ("sources", "loss_sources")}
batch["K"] = torch.tensor([[20.0, 0, 11.5], [0, 20.0, 7.5], [0, 0, 1]]).expand(2, 3, 3)
batch["target_depth"] = torch.rand(2, 1, 16, 24) * 9
objective = saunet.build("objective", NAME, **OPTIONS).eval()

def step(sigmoid, axisangle, translation):
    disparity = sigmoid_to_disparity(sigmoid, 0.1, 100.0)
    pyramid = DepthPyramid((sigmoid,), (disparity,), (disparity_to_depth(disparity),))
    poses = pose_matrix(axisangle, translation)
    views = (synthesize(batch["loss_sources"], pyramid.depth[0], batch["K"], poses),)
    return objective(batch, pyramid, poses, views).total

leaves = [torch.rand(2, 1, 16, 24) * 0.1, torch.randn(2, 2, 3) * 0.02, torch.randn(2, 2, 3) * 0.1]
leaves = [leaf.requires_grad_() for leaf in leaves]
compiled = torch.compile(step, fullgraph=True, backend="aot_eager")
expected, found = step(*leaves), compiled(*leaves)
torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)
for one, other in zip(torch.autograd.grad(found, leaves), torch.autograd.grad(expected, leaves)):
    torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-5)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("saunet", {}),
        ("monodepth2", {}),
        ("saunet", {"extra": {"lidar": {"term": "gradient", "weight": 0.2, "target": "lidar"}}}),
    ],
)
def test_compiles_as_one_graph(name: str, options: dict[str, Any]) -> None:
    # In a process of its own: the shape checks that pytest installs cannot be compiled.
    code = COMPILE.replace("NAME", repr(name)).replace("OPTIONS", repr(options))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@every_objective
def test_the_host_never_waits_for_a_gpu(name: str, make_inputs: Make) -> None:
    inputs, objective = make_inputs(), saunet.build("objective", name).cuda()
    for key, value in inputs.batch.items():
        inputs.batch[key] = value.cuda() if isinstance(value, torch.Tensor) else value
    leaves = [leaf.detach().cuda().requires_grad_() for leaf in inputs.leaves]
    objective(*inputs.rebuilt(*leaves)).total.backward()  # once before, so that nothing is left to initialize
    torch.cuda.set_sync_debug_mode("error")
    try:
        objective(*inputs.rebuilt(*leaves)).total.backward()
    finally:
        torch.cuda.set_sync_debug_mode("default")
