"""Every public name says what it is, what it takes, and what it raises; read from the source, so nothing is missed."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[2] / "src" / "saunet"
FILES = sorted(path for path in SOURCE.rglob("*.py") if "cli" not in path.parts)  # tools are run, not imported
ERRORS = {"ConfigError", "DataError", "CheckpointError"}
Function = ast.FunctionDef | ast.AsyncFunctionDef


def _public(tree: ast.Module) -> Iterator[tuple[str, ast.ClassDef | Function, ast.ClassDef | None]]:
    """Yield public classes, functions, and methods of public classes, with the class of a method."""
    for node in tree.body:
        if isinstance(node, ast.ClassDef | Function) and not node.name.startswith("_"):
            yield node.name, node, None
            if isinstance(node, ast.ClassDef):
                for method in node.body:
                    if isinstance(method, Function) and not method.name.startswith("_"):
                        yield f"{node.name}.{method.name}", method, node


def _parameters(function: Function) -> list[str]:
    arguments = function.args
    names = [a.arg for a in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)]
    return [name for name in names if name not in ("self", "cls") and not name.startswith("_")]


def _raised(function: Function) -> set[str]:
    """Return the project's errors that a function's own body raises and does not catch itself."""
    found = set()
    for node in ast.walk(function):
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and isinstance(node.exc.func, ast.Name):
            found.add(node.exc.func.id)
    return found & ERRORS


def _problems(path: Path) -> list[str]:
    problems = []
    tree = ast.parse(path.read_text(encoding="utf-8"))
    if not ast.get_docstring(tree):
        problems.append("the module has no docstring")
    for name, node, owner in _public(tree):
        text = ast.get_docstring(node) or ""
        if not text:
            problems.append(f"{name} has no docstring")
            continue
        if isinstance(node, ast.ClassDef):
            init = next((f for f in node.body if isinstance(f, Function) and f.name == "__init__"), None)
            if init is not None:
                problems += [
                    f"{name} does not describe its parameter {parameter}"
                    for parameter in _parameters(init)
                    if not re.search(rf"^\s*{parameter}( \(.*\))?:", text, re.MULTILINE)
                ]
                if _raised(init) and "Raises:" not in text:
                    problems.append(f"{name} raises {sorted(_raised(init))} and does not say so")
        elif _raised(node) and "Raises:" not in text:
            problems.append(f"{name} raises {sorted(_raised(node))} and does not say so")
        elif owner is None and "Args:" in text:
            problems += [
                f"{name} describes some parameters, but not {parameter}"
                for parameter in _parameters(node)
                if not re.search(rf"^\s*{parameter}( \(.*\))?:", text, re.MULTILINE)
            ]
    return problems


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(SOURCE)))
def test_public_names_are_documented(path: Path) -> None:
    assert not _problems(path)
