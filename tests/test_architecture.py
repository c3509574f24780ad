"""Who may import whom, held by reading the imports."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

SOURCE = Path(__file__).parents[1] / "src" / "saunet"
PAGE = SOURCE.parents[1] / "docs" / "architecture.md"

# room -> the rooms of saunet that it may import, beside itself
ALLOWED: dict[str, set[str]] = {
    "errors": set(),
    "lazy": set(),
    "schema": set(),
    "threads": set(),
    "types": set(),
    "fingerprint": set(),
    "published": set(),
    "plugins": {"errors"},
    "registry": {"errors", "schema", "plugins"},
    "io": {"errors"},
    "tables": {"errors", "io"},
    "geometry": {"errors", "types"},
    "models": {"errors", "registry", "types", "io", "geometry"},
    "losses": {"errors", "registry", "types", "geometry"},
    "metrics": {"errors", "types", "geometry"},
    "data": {"errors", "registry", "schema", "threads", "types", "io", "fingerprint", "geometry", "synthetic"},
    "synthetic": {"errors", "io", "data"},
    "runs": {"plugins", "errors", "io", "registry", "metrics", "models", "__version__"},
    "weights": {"errors", "io", "registry", "runs"},
    "scale": {"errors", "lazy", "types", "io", "geometry", "runs", "weights"},
    "training": {
        "plugins",
        "errors",
        "registry",
        "threads",
        "types",
        "io",
        "geometry",
        "metrics",
        "models",
        "data",
        "losses",
        "prediction",
        "reporting",
        "runs",
        "weights",
    },
    "prediction": {
        "errors",
        "registry",
        "lazy",
        "types",
        "io",
        "data",
        "metrics",
        "models",
        "runs",
        "scale",
        "weights",
        "exporting",
    },
    "exporting": {"errors", "lazy", "io", "tables", "metrics", "models", "prediction", "runs", "weights"},
    "evaluation": {
        "errors",
        "registry",
        "types",
        "io",
        "tables",
        "fingerprint",
        "geometry",
        "losses",
        "metrics",
        "models",
        "data",
        "scale",
        "prediction",
        "runs",
        "weights",
    },
    "reporting": {
        "errors",
        "registry",
        "io",
        "tables",
        "metrics",
        "prediction",
        "evaluation",
        "runs",
        "weights",
        "published",
        "tools",
        "__version__",
    },
    "tools": {
        "errors",
        "registry",
        "threads",
        "io",
        "tables",
        "models",
        "data",
        "prediction",
        "published",
        "scale",
        "weights",
    },
}
# third-party package -> the rooms that may import it
THIRD_PARTY: dict[str, set[str]] = {
    "hydra": {"cli"},
    "omegaconf": {"cli"},
    "lightning": {"training", "data", "cli"},
    "torchmetrics": {"metrics", "training"},
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


def test_imports_follow_the_plan() -> None:
    wrong = []
    for path in SOURCE.rglob("*.py"):
        room = _room(path)
        if room == "__init__":
            continue
        assert room in ("cli", "__main__") or room in ALLOWED, (
            f"new room '{room}': say in {Path(__file__).name} what it may import"
        )
        for name in _imports(path):
            package, *parts = name.split(".")
            if (
                package == "saunet"
                and parts
                and parts[0] != room
                and room not in ("cli", "__main__")
                and parts[0] not in ALLOWED[room]
            ):
                wrong.append(f"{path.relative_to(SOURCE)} must not import {name}")
            if package in THIRD_PARTY and room not in THIRD_PARTY[package]:
                wrong.append(f"{path.relative_to(SOURCE)} must not import {package}")
    assert not wrong


def test_the_page_lists_the_packages_from_the_bottom_up() -> None:
    (table,) = re.findall(r"^\| package .*\n\|-.*\n((?:\|.*\n)+)", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    rows = [re.findall(r"`(\w+)/?`", row.split("|")[1]) for row in table.splitlines()]
    floor = {name: number for number, names in enumerate(rows) for name in names}
    folders = {path.parent.name for path in SOURCE.glob("*/__init__.py")}
    assert folders <= floor.keys()
    upwards = {
        (own, other) for own, others in ALLOWED.items() for other in others if floor.get(other, 0) > floor.get(own, 0)
    }
    assert upwards == {("data", "synthetic")}  # the data set that is rendered; the renderer knows `Drive` alone
    known = {name for path in (SOURCE / "synthetic").glob("*.py") for name in _imports(path) if "saunet.data" in name}
    assert known == {"saunet.data.drive.Drive"}


def test_importing_saunet_costs_torch_but_not_lightning() -> None:
    code = (
        "import sys, saunet; print([m for m in ('lightning', 'hydra', 'kornia', 'torchmetrics') if m in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
