"""Who may import whom, held by reading the imports."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[1] / "src" / "saunet"

# room -> the saunet rooms it may import (its own is always allowed)
ALLOWED: dict[str, set[str]] = {
    "schema": set(),
    "checks": set(),
    "types": set(),
    "registry": {"schema", "checks"},
    "geometry": {"types", "checks"},
    "layers": {"checks"},
    "models": {"registry", "types", "checks", "layers", "geometry.depth", "geometry.pose", "torch_files"},
    "losses": {"registry", "types", "checks", "geometry"},
    "metrics": {"types", "checks", "geometry.depth"},
    "data": {
        "registry",
        "types",
        "checks",
        "geometry.camera",
        "atomic",
        "fingerprint",
        "progress",
        "images",
        "trajectories",
        "videos",
    },
    "atomic": {"checks"},
    "torch_files": {"checks"},
    "fingerprint": set(),
    "progress": set(),
    "images": {"checks", "atomic"},
    "trajectories": {"checks", "atomic"},
    "videos": {"checks"},
    "record": {"registry", "checks"},
    "checkpoint": {"registry", "types", "checks", "models", "atomic", "record", "torch_files"},
    "evaluation": {
        "types",
        "checks",
        "fingerprint",
        "metrics",
        "atomic",
        "progress",
        "images",
        "trajectories",
        "geometry",
        "losses.functional",
        "infer.colour",
    },
    "infer": {
        "types",
        "checks",
        "atomic",
        "progress",
        "images",
        "trajectories",
        "videos",
        "record",
        "checkpoint",
        "geometry",
        "metrics.functional",
        "metrics.odometry",
        "models.depth",
    },
    "lit": {
        "registry",
        "types",
        "checks",
        "atomic",
        "progress",
        "record",
        "checkpoint",
        "geometry",
        "metrics",
        "infer",
        "images",
        "data.module",
        "data.workers",
        "losses.base",
    },
    "published": set(),
    "benchmarking": {"checks", "atomic", "published"},
    "prepare": {"checks", "atomic", "progress", "images", "data", "infer"},
    "scale": {"types", "checks", "geometry", "record", "images"},
    "report": {
        "checks",
        "atomic",
        "images",
        "checkpoint",
        "infer",
        "evaluation",
        "metrics.functional",
        "published",
        "benchmarking.measure",
    },
    "roots": set(),
    "config": {"registry", "schema", "checks", "roots", "lit.optim", "lit.speed"},
}
# third-party package -> the rooms that may import it
THIRD_PARTY: dict[str, set[str]] = {
    "hydra": {"config", "cli"},
    "omegaconf": {"config", "roots", "cli"},
    "lightning": {"lit", "data", "cli", "config"},
    "torchmetrics": {"metrics", "lit"},
}


def _imports(path: Path) -> list[str]:
    names = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names += [f"{node.module}.{alias.name}" for alias in node.names]
    return names


def _room(path: Path) -> str:
    return path.relative_to(SOURCE).parts[0].removesuffix(".py")


FILES = sorted(path for path in SOURCE.rglob("*.py") if _room(path) != "__init__")


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(SOURCE)))
def test_imports_follow_the_plan(path: Path) -> None:
    room = _room(path)
    for name in _imports(path):
        package, _, rest = name.partition(".")
        if package == "saunet":
            assert rest.split(".")[0] != "cli" or room == "cli", f"{room} imports {name}; nothing imports cli"
            if room == "cli" or rest.split(".")[0] == room or rest == "__version__":
                continue
            assert room in ALLOWED, f"new room '{room}': say here what it may import"
            assert any(rest == allowed or rest.startswith(f"{allowed}.") for allowed in ALLOWED[room]), (
                f"{room} must not import {name}"
            )
        elif package in THIRD_PARTY:
            assert room in THIRD_PARTY[package], f"{room} must not import {package}"


def test_importing_saunet_costs_torch_but_not_lightning() -> None:
    import subprocess
    import sys

    code = (
        "import sys, saunet; print([m for m in ('lightning', 'hydra', 'kornia', 'torchmetrics') if m in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_every_source_file_is_short_enough_to_read_in_one_go() -> None:
    long = {str(path.relative_to(SOURCE)): len(path.read_text().splitlines()) for path in FILES}
    assert {name: lines for name, lines in long.items() if lines > 300} == {}
