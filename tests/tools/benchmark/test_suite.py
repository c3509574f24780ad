"""The suite measures every combination; tables, JSON and picture hold what it found."""

from __future__ import annotations

import builtins
import dataclasses
import functools
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from rich.console import Console
from torch import nn

from saunet.errors import ConfigError
from saunet.models.depth import DepthNet
from saunet.published import published
from saunet.registry import decoders, encoders, poses
from saunet.tables import show
from saunet.tools.benchmark import Measurement, Networks, Plan, measure, run_suite
from saunet.tools.benchmark.tool import BenchmarkOptions, draw_figure, size_table, speed_table, write_measurements


class Tiny(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.conv = nn.Conv2d(3, 2, 3)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        return self.conv(image)  # type: ignore[no-any-return]


@pytest.fixture(scope="module")
def results() -> list[Measurement]:
    plan = Plan(sizes=["8x16", "16x16"], precisions=["fp32", "bf16"], batch_sizes=[1, 3], runs=2, warmup=1)
    seen: list[tuple[int, int]] = []
    models = {"sau_net": Networks(Tiny(), nn.Linear(2, 2)), "ours": Networks(Tiny())}
    with pytest.MonkeyPatch.context() as patch:  # a large product in bf16 takes seconds where the processor lacks it
        patch.setattr(measure, "matmul_ceiling", functools.partial(measure.matmul_ceiling, side=64))
        results = run_suite(models, plan, lambda _, done, total: seen.append((done, total)))
    assert seen[-1] == (48, 48)
    return results


def test_every_combination_is_measured(results: list[Measurement]) -> None:
    assert len({(row.model, row.size, row.precision, row.batch_size) for row in results}) == len(results) == 16
    for row in results:
        assert row.depth_parameters == 56
        assert row.total_parameters == 56 + (6 if row.model == "sau_net" else 0)
        assert row.fastest <= row.median <= row.p90
        assert row.throughput == pytest.approx(row.batch_size / row.median)
        assert row.flops == 2 * 54 * (6 if row.size == "8x16" else 14) * 14
        assert row.ceiling_share > 0


def test_compiled_networks_are_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    compiled: list[nn.Module] = []
    monkeypatch.setattr(torch, "compile", lambda network, **_: compiled.append(network) or network)
    (row,) = run_suite({"ours": Networks(Tiny())}, Plan(sizes=["8x8"], modes=["compiled"], runs=1, warmup=0))
    assert row.mode == "compiled"
    assert len(compiled) == 1


def test_every_compiled_row_runs_code_for_its_own_shape(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten shapes: the compiler's own limit is eight, and from the second on it would write code for any shape."""
    shapes: list[list[object]] = []

    def backend(graph: torch.fx.GraphModule, inputs: list[torch.Tensor]) -> Callable[..., object]:
        shapes.extend(list(each.shape) for each in inputs if isinstance(each, torch.Tensor) and each.ndim == 4)
        return graph.forward

    monkeypatch.setattr(torch, "compile", functools.partial(torch.compile, backend=backend))
    plan = Plan(sizes=[f"{8 * i}x16" for i in range(1, 6)], modes=["compiled"], batch_sizes=[1, 2], runs=2, warmup=1)
    rows = run_suite({"ours": Networks(Tiny())}, plan)
    images = [shape for shape in shapes if shape[1] == 3 and shape[2] != 3]  # the others are weights
    assert images == [[row.batch_size, 3, int(row.size.partition("x")[0]), 16] for row in rows]
    assert all(type(side) is int for shape in images for side in shape)


def test_sizes_are_checked_before_anything_is_measured() -> None:
    network = Tiny()
    network.size_divisor = 8  # type: ignore[assignment]
    ticks: list[str] = []
    with pytest.raises(
        ConfigError, match=r"12x16 .* the encoder stride of ours, 8; the nearest valid size is (8|16)x16"
    ):
        run_suite({"ours": Networks(network)}, Plan(sizes=["8x16", "12x16"]), lambda text, *_: ticks.append(text))
    assert not ticks


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sizes": ["192"]}, "size is '192'; write height and width"),
        ({"sizes": ["0x64"]}, "size is '0x64'"),
        ({"precisions": ["fp23"]}, "did you mean 'fp32'"),
        ({"modes": ["complied"]}, "did you mean 'compiled'"),
        ({"devices": ["tpu9"]}, "device 'tpu9' cannot be used here"),
        ({"batch_sizes": [0]}, "batch_sizes is 0"),
        ({"batch_sizes": []}, "batch_sizes is empty, so nothing would be measured; give at least one, such as 1"),
        ({"sizes": []}, "sizes is empty, .* such as 192x640"),
        ({"modes": ()}, "modes is empty"),
        ({"runs": 0}, "runs is 0"),
        ({"warmup": -1}, "warmup is -1"),
    ],
)
def test_impossible_plans_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Plan(**changes)


def test_tables_stand_beside_the_paper(results: list[Measurement]) -> None:
    console = Console(width=160, record=True, file=io.StringIO())
    show((size_table(results), speed_table(results)), console)
    text = console.export_text()
    assert "58.8 (SAU-Net)" in text
    assert text.count("sau_net") == 2 + 8


@pytest.mark.parametrize("width", [80, 160])
def test_no_number_is_cut(results: list[Measurement], width: int) -> None:
    row = dataclasses.replace(results[0], model="sau_net (changed)", median=1.7089, p90=1.8089, warmup=12.345)
    other = dataclasses.replace(row, model="ours", size="320x1024", device="cuda", mode="compiled", batch_size=16)
    for rows in ([row], [row, other], [other, *results]):
        console = Console(width=width, record=True, file=io.StringIO())
        show((size_table(rows), speed_table(rows, width)), console)
        text = console.export_text()
        assert "…" not in text
        for each in rows:
            numbers = each.median * 1e3, each.p90 * 1e3, each.throughput
            words = [
                *(f"{number:.1f}" for number in numbers),
                *each.model.split(),
                each.size,
                each.precision,
                each.mode,
            ]
            assert all(word in text for word in words)


def test_settings_that_all_share_are_said_once(results: list[Measurement]) -> None:
    console = Console(width=160, record=True, file=io.StringIO())
    show([speed_table(results)], console)
    text = console.export_text()
    assert "ms per call, cpu, eager;" in text
    assert text.count("eager") == 1
    assert text.count("bf16") == 8


def test_json_has_everything(results: list[Measurement], tmp_path: Path) -> None:
    write_measurements(results, tmp_path / "out" / "benchmark.json")
    content = json.loads((tmp_path / "out" / "benchmark.json").read_text())
    assert content["machine"]["torch"] == torch.__version__
    assert [Measurement(**row) for row in content["results"]] == results


def test_picture(results: list[Measurement], tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    draw_figure(results, tmp_path / "benchmark.png", {"other": 0.1})
    assert (tmp_path / "benchmark.png").read_bytes().startswith(b"\x89PNG")


def test_picture_without_matplotlib_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    original = builtins.__import__

    def without(name: str, *rest: Any, **more: Any) -> Any:
        if name.startswith("matplotlib"):
            raise ImportError(name)
        return original(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ConfigError, match=r"pip install 'saunet\[plot\]'"):
        BenchmarkOptions(models={"ours": Networks(Tiny())}, figure=True)


def test_sau_net_has_no_more_parameters_than_published() -> None:
    depth = DepthNet(encoders.build("stratified_tiny"), decoders.partial("aunet"))
    pose = poses.build("resnet34")
    total = sum(parameter.numel() for network in (depth, pose) for parameter in network.parameters())
    printed = {row.method: row.megaparameters for row in published().table2}
    assert total <= printed["SAU-Net"] * 1e6
