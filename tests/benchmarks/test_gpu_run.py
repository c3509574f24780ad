"""The run that waits for a GPU, tried on the CPU; and that its parts fail alone and in time."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def gpu(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("gpu")


@pytest.mark.slow
def test_all_parts_run_on_a_cpu(tmp_path):
    words = ["bash", str(BENCHMARKS / "gpu.sh"), str(tmp_path), "--device", "cpu", "--tiny", "--budget", "1500"]
    environment = {**os.environ, "PYTHON": sys.executable, "OMP_NUM_THREADS": "1", "LIMIT": "1600"}
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    parts = json.loads((tmp_path / "gpu.json").read_text())["parts"]
    assert {name: part["error"] for name, part in parts.items() if part["error"]} == {}, done.stderr[-3000:]
    assert done.returncode == 0
    assert set(parts) == {
        "machine", "correctness", "training sau_net_nano float32", "graphs", "loader", "street", "runtimes"
    }  # fmt: skip
    assert parts["correctness"]["sau_net_nano"]["float32"]["gradient"] > 0
    step = parts["training sau_net_nano float32"]
    assert 0 < step["least_ms"] < step["ms"]
    assert "the figures mean nothing" in (tmp_path / "gpu.md").read_text()


def test_a_part_fails_alone_and_the_time_is_kept(gpu, monkeypatch, tmp_path, capsys):
    def good(setting, keep):
        keep(answer=42)

    def bad(setting, keep):
        keep(before=1.0)
        raise ValueError("no such kernel\nand more")

    def gone(setting, keep):
        os._exit(3)

    def slow(setting, keep):
        keep(half=True)
        time.sleep(600)

    plan = {"bad": (bad, 60), "gone": (gone, 60), "good": (good, 60), "slow": (slow, 1), "also slow": (slow, 60)}
    monkeypatch.setattr(gpu, "plan", lambda tiny: {**plan, "last": (good, 60)})
    setting = SimpleNamespace(tiny=False, folder=tmp_path, device="cpu")
    began = time.monotonic()
    found = gpu.run(setting, 15, [])
    assert time.monotonic() - began < 25
    errors = {name: part["error"] for name, part in found.items()}
    assert errors.pop("good") is None
    assert errors["bad"] == "ValueError: no such kernel"
    assert "ended by itself" in errors["gone"]
    assert "stopped after 1 s" in errors["slow"]
    assert "stopped after" in errors["also slow"]
    assert "not run" in errors["last"]
    assert (found["good"]["answer"], found["bad"]["before"], found["slow"]["half"]) == (42, 1.0, True)
    shown = gpu.page(found, setting)
    assert all(f"**{name}** failed" in shown for name in errors)


def test_the_limits_of_known_operations(gpu):
    torch = gpu.torch
    a, b = torch.rand(8, 16), torch.rand(16, 4)
    with gpu.Roofline(1e9, 1e9) as roofline:
        product = a @ b
        product.t()  # a view moves nothing
        product.add_(1)
    assert roofline.flops == 2 * 8 * 16 * 4
    assert roofline.bytes == 4 * (8 * 16 + 16 * 4 + 8 * 4) + 4 * 2 * 8 * 4
    assert roofline.seconds == pytest.approx((max(1024, 4 * 224) + 256) / 1e9)
