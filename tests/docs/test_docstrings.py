"""Every public name says what it is, what it takes, and what it raises; read from the source, so nothing is missed.

``Args:`` is asked of a function or method with three or more parameters whose type leaves open what they are: numbers,
words, paths and the like. A type of our own or an array with its shape says it; so does a reference to the function
that describes the same arguments. Arrays say their shape in the annotation or in words.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[2] / "src" / "saunet"
FILES = sorted(SOURCE.rglob("*.py"))
ERRORS = {"ConfigError", "DataError", "CheckpointError"}
Function = ast.FunctionDef | ast.AsyncFunctionDef
OPEN = 3
"""Parameters of open types from which on they are described."""
LIGHTNING = re.compile(r"on_\w+|setup|teardown|optimizer_step")
"""Its hooks, whose arguments it describes."""
DRIVE = {"image", "intrinsics", "depth", "pose"}
"""What `saunet.data.drive.Drive` describes for all recordings."""
SHAPED = r"(?:Float|Int|UInt|Bool|Num|Shaped)\d*\[(?:[^\[\]]|\[[^\]]*\])*\]"
"""An annotation of jaxtyping."""
SHAPE = re.compile(
    r"\b\w+ x \w|\b[bnhwsc] (?:\d|[bnhwsc]\b)|\bscalar\b"
    r"|\b(?:one|two|each of the n) (?:\w+ )?(?:numbers?|values?|row|pixels)"
)
"""A shape in words, such as ``h x w x 3``, ``b 1 h w`` or one number a frame."""


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


def _own_types() -> set[str]:
    trees = (ast.parse(path.read_text(encoding="utf-8")) for path in FILES)
    return {node.name for tree in trees for node in tree.body if isinstance(node, ast.ClassDef)}


OWN = _own_types()


def _annotated(function: Function) -> dict[str, str]:
    arguments = function.args
    every = (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)
    return {each.arg: ast.unparse(each.annotation).replace('"', "'") for each in every if each.annotation is not None}


def _is_open(annotation: str) -> bool:
    return not re.search(SHAPED, annotation) and not OWN & set(re.findall(r"\w+", annotation))


def _arguments_missing(function: Function, text: str) -> bool:
    """Tell whether a function should describe its arguments and does not."""
    known = _annotated(function)
    left_open = [name for name in _parameters(function) if _is_open(known.get(name, ""))]
    told = "Args:" in text or re.search(r"arguments as in `|for the arguments", text)
    return len(left_open) >= OPEN and not told and not LIGHTNING.fullmatch(function.name)


def _shape_missing(function: Function, text: str) -> bool:
    """Tell whether an array comes or goes of which neither the annotation nor the text says the shape."""
    returned = ast.unparse(function.returns) if function.returns else ""
    parts = [each for name, each in _annotated(function).items() if name in _parameters(function)]
    bare = [re.sub(SHAPED, "", each) for each in (*parts, returned)]
    arrays = [each for each in bare if re.search(r"\b(?:Tensor|NDArray|ndarray)\b", each)]
    arrays = [each for each in arrays if not re.search(r"\b(?:dict|Mapping)\b", each)]  # weights by name
    return bool(arrays) and not SHAPE.search(text)


def _problems(path: Path) -> list[str]:
    return _problems_of(path.read_text(encoding="utf-8"))


def _problems_of(source: str) -> list[str]:
    problems = []
    tree = ast.parse(source)
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
            continue
        if _raised(node) and "Raises:" not in text:
            problems.append(f"{name} raises {sorted(_raised(node))} and does not say so")
        if _arguments_missing(node, text):
            problems.append(f"{name} does not describe its arguments")
        if _shape_missing(node, text) and not (owner is not None and node.name in DRIVE):
            problems.append(f"{name} does not say the shape of an array")
        if "Args:" in text:
            problems += [
                f"{name} describes some parameters, but not {parameter}"
                for parameter in _parameters(node)
                if not re.search(rf"^\s*{parameter}( \(.*\))?:", text, re.MULTILINE)
            ]
    return problems


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(SOURCE)))
def test_public_names_are_documented(path: Path) -> None:
    assert not _problems(path)


@pytest.mark.parametrize(
    ("signature", "text", "problem"),
    [
        ("depth: Tensor", "Do it.", "f does not say the shape of an array"),
        ("depth: Tensor", "Do it with depth, b 1 h w.", None),
        ("depth: Float[Tensor, 'b 1 h w'], K: Float[Tensor, 'b 3 3'], T: Float[Tensor, 'b 4 4']", "Do it.", None),
        ("depth, K, T", "Do it.", "f does not describe its arguments"),
        ("name: str, path: Path, most: int", "Do it.", "f does not describe its arguments"),
        ("name: str, path: Path, most: int", "Do it; arguments as in `g`.", None),
        ("name: str, path: Path, scale: Scale", "Do it.", None),
        ("name: str", "Do it.\n\n    Args:\n        title: A name.\n    ", "f describes some parameters, but not name"),
    ],
)
def test_the_rule_finds_what_it_should(signature: str, text: str, problem: str | None) -> None:
    function = f'def f({signature}) -> None:\n    """{text}"""\n'
    found = _problems_of(f'"""A module."""\n{function}')
    assert found == ([problem] if problem else [])
    method = function.replace("def f(", "def f(self, ").replace("\n", "\n    ")
    assert len(_problems_of(f'"""A module."""\nclass A:\n    """A class."""\n\n    {method}\n')) == len(found)
