"""Measurements whose answer is known."""

from __future__ import annotations

import time

import pytest
import torch
from torch import nn

from saunet.benchmarking.measure import count_flops, count_parameters, matmul_ceiling, measure_latency, peak_memory
from saunet.checks import ConfigError
from saunet.layers.window_attention import WindowAttention

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


def test_latency_of_known_calls() -> None:
    waits = iter([0.05, 0.01, 0.02, 0.03, 0.04])
    ticks: list[int] = []
    latency = measure_latency(lambda: time.sleep(next(waits)), CPU, runs=4, warmup=1, done=lambda: ticks.append(1))
    assert len(ticks) == 5
    assert latency.warmup >= 0.05
    assert 0.01 <= latency.fastest < 0.02
    assert 0.025 <= latency.median < 0.035
    assert 0.037 <= latency.p90 < 0.06


@pytest.mark.parametrize(("runs", "warmup"), [(0, 1), (1, -1)])
def test_latency_refuses_no_runs(runs: int, warmup: int) -> None:
    with pytest.raises(ConfigError, match=r"runs is 0|warmup is -1"):
        measure_latency(lambda: None, CPU, runs, warmup)


def test_peak_memory_sees_what_was_freed_again() -> None:
    size = 64 << 20
    peak = peak_memory(lambda: torch.ones(size // 4).sum(), CPU)
    if peak is None:
        pytest.skip("this system does not tell")
    assert 0.9 * size < peak < 1.5 * size


def test_ceiling_is_a_speed() -> None:
    assert 1e8 < matmul_ceiling(CPU, torch.float32, side=64) < 1e14
