"""``saunet benchmark`` from the command line."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from saunet.tools.benchmark import measure

Tool = Callable[..., Any]
QUICK = ("sizes=[32x64]", "devices=[cpu]", "runs=1", "warmup=0")


@pytest.fixture(autouse=True)
def _small_ceiling(monkeypatch: pytest.MonkeyPatch) -> None:
    """Multiply small matrices: the tool's own take a second."""
    monkeypatch.setattr(measure, "matmul_ceiling", functools.partial(measure.matmul_ceiling, side=64))


def test_models_are_measured_side_by_side(tool: Tool, tmp_path: Path) -> None:
    done = tool("benchmark", "models=[sau_net_nano,mono_r18]", *QUICK, f"hydra.run.dir={tmp_path}/out")
    assert done.code == 0, done.err
    assert "52.7 (Mono R18)" in done.out
    rows = json.loads((tmp_path / "out" / "benchmark.json").read_text())["results"]
    assert [row["model"] for row in rows] == ["sau_net_nano", "mono_r18"]


def test_a_wrong_size_is_one_sentence(tool: Tool) -> None:
    tool("benchmark", "model=sau_net_nano", "sizes=[33x64]", *QUICK[1:]).says("the nearest valid size is 32x64")


def test_a_changed_model_does_not_go_by_the_papers_name(tool: Tool, tmp_path: Path) -> None:
    nano, out = "model=sau_net_nano", f"hydra.run.dir={tmp_path}/out"
    done = tool("benchmark", "model/encoder=resnet18", "model/decoder=unet", *QUICK, out)
    assert done.code == 0, done.err
    assert "sau_net (changed)" in done.out
    assert "58.8" not in done.out
    rows = json.loads((tmp_path / "out" / "benchmark.json").read_text())["results"]
    assert [row["model"] for row in rows] == ["sau_net (changed)"]
    weights = ("model.encoder.weights=null", "model.pose.weights=null")
    for overrides, changed in (((), False), (weights, False), (("model.encoder.mlp_ratio=2.0",), True)):
        done = tool("benchmark", nano, *overrides, *QUICK, out)
        assert done.code == 0, done.err
        assert ("(changed)" in done.out) == changed


def test_accuracy_of_a_changed_model_may_be_given(tool: Tool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[dict[str, float]] = []
    monkeypatch.setattr("saunet.tools.benchmark.tool.draw_figure", lambda rows, path, given: drawn.append(given))
    change = ("model/encoder=resnet18", "model/decoder=unet", "figure=true")
    assert tool("benchmark", *change, "+abs_rel.sau_net=0.2", *QUICK, f"hydra.run.dir={tmp_path}").code == 0
    assert drawn[0]["sau_net (changed)"] == 0.2


@pytest.mark.parametrize("change", ["model/encoder=resnet18", "model.min_depth=0.5", "model=mono_r18"])
def test_named_models_are_not_changed(tool: Tool, change: str) -> None:
    tool("benchmark", "models=[sau_net_nano]", change, *QUICK).says(f"'{change}' would have no effect")


@pytest.mark.parametrize("threads", [-1, 0])
def test_impossible_threads(tool: Tool, threads: int) -> None:
    tool("benchmark", "model=sau_net_nano", f"threads={threads}", *QUICK).says(f"threads is {threads}; it must be")


def test_empty_lists_are_refused(tool: Tool) -> None:
    tool("benchmark", "model=sau_net_nano", "sizes=[]").says("sizes is empty")
