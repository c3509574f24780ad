"""Any encoder with any decoder and any attention: built, run, back-propagated, pickled, exported, compiled, halved.

A handful of combinations in which every decoder and attention occurs is tested always, all of them as slow tests. The
networks are those registered, not smaller ones.
"""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from networks import assert_all_have_gradients, assert_pickles, buildable_encoders, settle
from processes import python
from torch import nn

import saunet
from saunet.models.depth import DepthNet
from saunet.registry import decoders, encoders

HEIGHT, WIDTH = 64, 96
HALF_TOLERANCE = 0.03
"""How far sigmoid disparity under bfloat16 autocast may be from float32, where the range is (0, 1)."""
FEW = (
    "stratified_nano+lite_mono",
    "lite_mono_tiny+packnet",
    "resnet18+unet",
    "resnet18+unet_narrow",
    "resnet18+aunet+se",
    "resnet18+aunet+eca",
    "resnet18+aunet+cbam",
    "resnet18+aunet+gct",
    "resnet18+aunet+none",
)


def heads() -> list[str]:
    """Every decoder, and the one that has an attention with each."""
    plain = [name for name in saunet.available("decoder") if name != "aunet"]
    return plain + [f"aunet+{attention}" for attention in saunet.available("attention")]


def build(encoder: nn.Module, head: str) -> DepthNet:
    decoder, _, attention = head.partition("+")
    return DepthNet(encoder, decoders.partial(decoder, **({"attention": attention} if attention else {})))


def check(net: DepthNet, image: torch.Tensor) -> None:
    """Do with a network all that is promised of every one."""
    pyramid = net.train()(image)
    for scale, disparity in enumerate(pyramid.sigmoid):
        assert disparity.shape == (len(image), 1, HEIGHT // 2**scale, WIDTH // 2**scale)
    sum(depth.mean() for depth in pyramid.depth).backward()
    assert_all_have_gradients(net)
    net.zero_grad(set_to_none=True)
    assert_pickles(net)
    net.eval()
    with torch.no_grad():
        full = net(image)
        with torch.autocast("cpu", torch.bfloat16):
            half = net(image)
        program = torch.export.export(net, (image,))
        torch.testing.assert_close(program.module()(image).depth, full.depth, rtol=1e-3, atol=1e-4)
    assert half.depth[0].dtype == torch.float32
    for one, other in zip(full.sigmoid, half.sigmoid, strict=True):
        assert (one - other).abs().max() < HALF_TOLERANCE


def compile_networks(backend: str, *names: str) -> None:
    """Compile networks in a process of its own: the compiler cannot look into the tests' type checker."""
    program = Path(__file__).parents[1] / "helpers" / "compile_networks.py"
    done = python(str(program), backend, *names, timeout=3600)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == list(names)


def test_few_are_representative() -> None:
    used = {part for name in FEW for part in name.split("+")[1:]}
    assert used == {*saunet.available("decoder"), *saunet.available("attention")}


@pytest.mark.parametrize("name", FEW)
def test_a_few(name: str) -> None:
    encoder, _, head = name.partition("+")
    image = torch.rand(2, 3, HEIGHT, WIDTH)
    check(build(settle(encoders.build(encoder), image), head), image)


def test_a_few_compile_to_one_graph() -> None:
    compile_networks("eager", "stratified_nano+aunet+gct", "lite_mono_tiny+packnet", "resnet18+lite_mono")


@pytest.mark.slow
@pytest.mark.parametrize("encoder", buildable_encoders())
def test_all(encoder: str) -> None:
    image = torch.rand(2, 3, HEIGHT, WIDTH)
    network = settle(encoders.build(encoder), image)
    for head in heads():
        try:
            check(build(network, head), image)
        except AssertionError as reason:
            raise AssertionError(f"{encoder}+{head}: {reason}") from reason


@pytest.mark.slow
@pytest.mark.parametrize("encoder", buildable_encoders())
def test_all_compile_to_one_graph(encoder: str) -> None:
    compile_networks("eager", *(f"{encoder}+{head}" for head in heads()))


@pytest.mark.slow
@pytest.mark.parametrize("name", [f"resnet18+{head}" for head in heads()])
def test_compiled_code_gives_the_same_numbers_with_every_head(name: str) -> None:
    compile_networks("inductor", name)


@pytest.mark.slow
@pytest.mark.parametrize("encoder", buildable_encoders())
def test_compiled_code_gives_the_same_numbers_with_every_encoder(encoder: str) -> None:
    compile_networks("inductor", f"{encoder}+aunet+eca")
