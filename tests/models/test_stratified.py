"""The stratified transformer: sizes, numbers, and everything a network must survive."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from types import SimpleNamespace

import pytest
import torch
import torch.nn.functional as F
from processes import python

from saunet.errors import ConfigError
from saunet.models.encoders.stratified import StratifiedTransformer
from saunet.models.layers import window
from saunet.models.layers.conv import DropPath
from saunet.registry import encoders
from saunet.training.speed import Speed


def little(**changes: object) -> StratifiedTransformer:
    settings = {"dim": 8, "depths": (2, 2, 2, 2), "heads": (1, 2, 4, 8), "window": (4, 4, 4, 4)}
    return StratifiedTransformer(**{**settings, **changes})  # type: ignore[arg-type]


@pytest.mark.parametrize("size", [(32, 32), (64, 96), (32, 160)])
@pytest.mark.parametrize("window", [(4, 4, 4, 4), (7, 7, 7, 7), (8, 6, 3, 2)])
def test_features_are_as_announced(size: tuple[int, int], window: tuple[int, ...]) -> None:
    encoder = little(window=window)
    maps = encoder(torch.rand(2, 3, *size))
    assert [spec.stride for spec in encoder.features] == [2, 4, 8, 16]
    for feature, spec in zip(maps, encoder.features, strict=True):
        assert feature.shape == (2, spec.channels, size[0] // spec.stride, size[1] // spec.stride)
        tokens = feature.permute(0, 2, 3, 1)
        assert tokens.mean(-1).abs().max() < 1e-5  # each output has its own LayerNorm
        assert tokens.is_contiguous()


def test_tiny_is_the_papers() -> None:
    with torch.device("meta"):
        encoder, small = encoders.build("stratified_tiny"), encoders.build("stratified_small")
    assert [spec.channels for spec in encoder.features] == [96, 192, 384, 768]
    assert [len(stage.blocks) for stage in encoder.layers] == [2, 2, 6, 2]
    assert encoder.size_divisor == 32
    assert len(small.layers[2].blocks) == 18


def test_stem_by_hand() -> None:
    encoder = little()
    image = torch.rand(1, 3, 32, 32)
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    normal = (image - mean.view(1, 3, 1, 1)) / std.view(1, 3, 1, 1)
    conv = encoder.stem["conv"]
    expected = F.layer_norm(F.conv2d(normal, conv.weight, conv.bias, stride=2, padding=1).permute(0, 2, 3, 1), (8,))
    torch.testing.assert_close(encoder.tokens((image - encoder.mean) / encoder.std), expected)


def test_all_parameters_learn_and_streaming_agrees() -> None:
    encoder = little(window=(7, 5, 4, 3)).eval()
    image = torch.rand(2, 3, 64, 96)
    maps = encoder(image)
    sum(feature.square().mean() for feature in maps).backward()
    assert all(parameter.grad is not None and parameter.grad.isfinite().all() for parameter in encoder.parameters())
    with torch.no_grad():
        for whole, streamed in zip(maps, encoder(image), strict=True):
            torch.testing.assert_close(streamed, whole.detach(), atol=1e-5, rtol=1e-5)


def test_the_drop_path_schedule_rises_over_all_stages() -> None:
    """Linear from 0 in the first block to ``drop_path`` in the last one, as Swin has it."""
    encoder = little(drop_path=0.3)
    rates = [module.rate for module in encoder.modules() if isinstance(module, DropPath)]
    count = len(rates)
    assert count > 2
    assert rates == pytest.approx([0.3 * index / (count - 1) for index in range(count)])


def test_recomputation_gives_the_same_gradients() -> None:
    plain = little(drop_path=0.2).train()
    thrifty = little(drop_path=0.2).train()
    thrifty.load_state_dict(plain.state_dict())
    for speed, network in ((Speed(), plain), (Speed(checkpoint_activations=True), thrifty)):
        speed.apply(SimpleNamespace(depth=network, pose=None), torch.device("cpu"))
    image, gradients = torch.rand(2, 3, 32, 64), []
    for encoder in (plain, thrifty):
        torch.manual_seed(1)
        sum(feature.square().mean() for feature in encoder(image)).backward()
        gradients.append([parameter.grad for parameter in encoder.parameters()])
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda encoder: pickle.loads(pickle.dumps(encoder))])
def test_survives_copies_after_use(duplicate: Callable[[StratifiedTransformer], StratifiedTransformer]) -> None:
    encoder = little().eval()
    image = torch.rand(1, 3, 32, 32)
    with torch.no_grad():
        expected = encoder(image)
        for one, other in zip(duplicate(encoder)(image), expected, strict=True):
            torch.testing.assert_close(one, other)
    assert not any("index" in name or "mask" in name for name in encoder.state_dict())


COMPILE = """
import torch
from saunet.models.encoders.stratified import StratifiedTransformer

torch.manual_seed(0)
encoder = StratifiedTransformer(dim=8, depths=(2,), heads=(1,), window=(5,)).eval()
compiled = torch.compile(encoder, fullgraph=True, backend=BACKEND)
for shape in ((1, 3, 16, 24), (3, 3, 16, 24), (1, 3, 16, 32)):
    image = torch.rand(shape)
    for grad in (False, True) if shape == (1, 3, 16, 24) else (False,):
        with torch.set_grad_enabled(grad):
            maps = compiled(image)
            for one, other in zip(maps, encoder(image)):
                torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-5)
    if grad:
        maps[-1].sum().backward()
    assert encoder.stem["conv"].weight.grad is not None
with torch.no_grad():
    traced = torch.jit.trace(encoder, image)
    assert "addmm_" not in str(traced.inlined_graph)  # the plain way, without writing into buffers
    for one, other in zip(traced(image), encoder(image)):
        torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-5)
"""


@pytest.mark.parametrize("backend", ["eager", pytest.param("aot_eager", marks=pytest.mark.slow)])
def test_compiles_as_one_graph_for_any_batch_and_size_and_traces(backend: str) -> None:
    # in a process of its own: the shape checks that run under pytest cannot be traced
    done = python("-c", COMPILE.replace("BACKEND", repr(backend)))
    assert done.returncode == 0, done.stderr


TRACE = """
import torch
from saunet.models.encoders.stratified import StratifiedTransformer

torch.manual_seed(0)
encoder = StratifiedTransformer(dim=8, depths=(2, 2), heads=(1, 2), window=WINDOW).eval()
for grad in (False, True):
    with torch.set_grad_enabled(grad):
        traced = torch.jit.trace(encoder, torch.rand(2, 3, 32, 48))  # it checks its graph against a second trace
        image = torch.rand(2, 3, 32, 48)
        for one, other in zip(traced(image), encoder(image), strict=True):
            torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-5)
        for shape in ((2, 3, 32, 64), (2, 3, 64, 48), (2, 3, 32, 32), (1, 3, 32, 48), (3, 3, 32, 48)):
            try:
                traced(torch.rand(shape))
            except (RuntimeError, IndexError):
                continue
            raise AssertionError(f"a trace for one shape took {shape}")
"""


@pytest.mark.parametrize("window", ["(8, 4)", "(5, 3)"])
def test_a_trace_is_right_and_refuses_other_shapes(window: str) -> None:
    done = python("-c", TRACE.replace("WINDOW", window))
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("warm", [False, True])
def test_exports_with_constant_plans_and_leaves_no_traces(warm: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(window, "_KEPT", {})
    encoder = little(depths=(2, 1, 1, 1)).eval()
    image = torch.rand(1, 3, 32, 64)
    with torch.no_grad():
        if warm:
            encoder(image)
        program = torch.export.export(encoder, (image,))
        assert not any("arange" in str(node.target) for node in program.graph.nodes)
        for one, other in zip(program.module()(image), encoder(image), strict=True):
            torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-5)


def test_bfloat16_stays_near() -> None:
    encoder = little().eval()
    image = torch.rand(1, 3, 64, 64)
    with torch.no_grad():
        expected = encoder(image)
        with torch.autocast("cpu", torch.bfloat16):
            automatic = encoder(image)
        low = copy.deepcopy(encoder).bfloat16()(image.bfloat16())
    for one, two, other in zip(automatic, low, expected, strict=True):
        assert (one.float() - other).abs().mean() < 0.02  # features have standard deviation 1
        assert (two.float() - other).abs().mean() < 0.03


def test_refuses_sizes_that_do_not_fit() -> None:
    with pytest.raises(ConfigError, match=r"190x640 .* nearest valid size is 192x640"):
        little()(torch.rand(1, 3, 190, 640))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"heads": (1, 2, 4)}, "depths, heads and window have 4, 3 and 4 entries"),
        ({"window": (4, 4, 4, 0)}, "window is 0"),
        ({"heads": (3, 2, 4, 8)}, "heads is 3; it must divide the 8 channels"),
        ({"depths": (2, 0, 2, 2)}, "depths is 0"),
        ({"drop_path": 1.5}, "drop_path is 1.5"),
        ({"mlp_ratio": 0.0}, "mlp_ratio is 0"),
    ],
)
def test_refuses_impossible_settings(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        little(**changes)
