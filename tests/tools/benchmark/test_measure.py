"""Measurements whose answer is known."""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import pytest
import torch
from torch import nn
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from saunet.models.depth import DepthNet
from saunet.models.layers.window import SwinStage, WindowAttention
from saunet.registry import decoders, encoders
from saunet.tools.benchmark.measure import count_flops, count_parameters, matmul_ceiling, measure_latency, peak_memory

CPU = torch.device("cpu")


def test_parameters() -> None:
    layer = nn.Linear(3, 5)
    assert count_parameters(layer) == 20
    assert count_parameters(nn.Sequential(layer, layer)) == 20
    assert count_parameters(None) == 0


def test_flops_of_a_convolution_by_hand() -> None:
    conv = nn.Conv2d(3, 8, 3, padding=1, bias=False)
    assert count_flops(conv, torch.zeros(1, 3, 10, 12)) == 2 * 10 * 12 * 8 * 3 * 9
    assert conv.training


def test_flops_count_attention() -> None:
    layer = WindowAttention(8, 2, 4)
    tokens, projections, attention = 64, 2 * 64 * 8 * (24 + 8), 2 * 2 * 64 * 16 * 8
    assert count_flops(layer, torch.zeros(1, 8, tokens // 8, 8)) == projections + attention


def test_flops_of_a_stage_in_closed_form() -> None:
    """Two blocks, the second's windows shifted by half, and a merging, as prediction on a CPU runs them."""
    dim, heads, window, side = 8, 2, 4, 8
    stage = SwinStage(dim, 2, heads, window, 4.0, (0.0, 0.0))
    tokens = side**2
    linear = (
        2 * tokens * dim * (3 * dim + dim + 2 * 4 * dim)
    )  # queries, keys, values; projection; two layers of the MLP
    whole = 2 * 2 * tokens * window**2 * dim  # pairs within 2x2 whole windows, scores and weighted sums
    rows = (2**2 + 4**2 + 2**2) ** 2  # shifted by 2, eight rows fall into 2, 4 and 2; pairs of tokens in all windows
    merging = 2 * (tokens // 4) * 4 * dim * 2 * dim
    expected = 2 * linear + whole + 2 * 2 * rows * dim + merging
    assert count_flops(stage, torch.zeros(1, side, side, dim)) == expected


@pytest.mark.parametrize("decoder", ["aunet", "unet"])
def test_flops_do_not_depend_on_the_way_that_blocks_run(decoder: str) -> None:
    network = DepthNet(encoders.build("stratified_nano"), decoders.partial(decoder)).eval()
    image = torch.zeros(1, 3, 64, 96)
    counter = FlopCounterMode(display=False)
    with sdpa_kernel(SDPBackend.MATH), counter:  # with gradients, layer by layer
        network(image)
    assert count_flops(network, image) == counter.get_total_flops()


def test_latency_of_known_calls(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]  # a clock of our own: a busy machine must not decide this test
    monkeypatch.setattr("saunet.tools.benchmark.measure.time", SimpleNamespace(perf_counter=lambda: clock[0]))
    waits = iter([0.05, 0.03, 0.01, 0.04, 0.02])
    ticks: list[int] = []

    def call() -> None:
        clock[0] += next(waits)

    latency = measure_latency(call, CPU, runs=4, warmup=1, done=lambda: ticks.append(1))
    assert len(ticks) == 5
    assert (latency.warmup, latency.fastest) == pytest.approx((0.05, 0.01))
    assert (latency.median, latency.p90) == pytest.approx((0.025, 0.037))


def test_peak_memory_sees_what_was_freed_again() -> None:
    size = 64 << 20
    peak = peak_memory(lambda: torch.ones(size // 4).sum(), CPU)
    if peak is None:
        pytest.skip("this system does not tell")
    assert 0.5 * size < peak < 2 * size  # the system moves other pages of the process at the same time


def test_ceiling_is_multiplications_and_additions_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    ticks = itertools.count()
    monkeypatch.setattr("saunet.tools.benchmark.measure.time", SimpleNamespace(perf_counter=lambda: 0.5 * next(ticks)))
    assert matmul_ceiling(CPU, torch.float32, side=8) == 2 * 8**3 / 0.5
