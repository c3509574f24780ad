"""``saunet-benchmark`` from the command line."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path


def run(tmp_path: Path, *overrides: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "saunet.cli.benchmark", f"hydra.run.dir={tmp_path}/out", *overrides]
    return subprocess.run(command, capture_output=True, text=True, timeout=900, cwd=tmp_path)


def test_models_are_measured_side_by_side(tmp_path: Path) -> None:
    done = run(tmp_path, "models=[sau_net_nano,mono_r18]", "sizes=[32x64]", "devices=[cpu]", "runs=1", "warmup=0")
    assert done.returncode == 0, done.stderr
    assert "52.7 (Mono R18)" in done.stdout
    rows = json.loads((tmp_path / "out" / "benchmark.json").read_text())["results"]
    assert [row["model"] for row in rows] == ["sau_net_nano", "mono_r18"]


def test_a_wrong_size_is_one_sentence(tmp_path: Path) -> None:
    done = run(tmp_path, "model=sau_net_nano", "sizes=[33x64]", "devices=[cpu]", "runs=1", "warmup=0")
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert "the nearest valid size is 32x64" in done.stderr
