"""The exported names are fully described, with examples that run; what has a docstring elsewhere has a sensible one.

Exported is what ``saunet.__all__`` names. Each says what it takes (``Args:``, or a sentence per field of a dataclass),
returns and raises, the shape of its arrays, and shows an example. All else is internal: a docstring where one helps.
"""

from __future__ import annotations

import ast
import dataclasses
import doctest
import inspect
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from tiny_checkpoint import write_checkpoint

import saunet

SOURCE = Path(__file__).parents[2] / "src" / "saunet"
EXPORTED = sorted(name for name in saunet.__all__ if name != "__version__")
ERRORS = {"ConfigError", "DataError", "CheckpointError"}
Function = ast.FunctionDef | ast.AsyncFunctionDef
SHAPED = r"(?:Float|Int|UInt|Bool|Num|Shaped)\d*\[(?:[^\[\]]|\[[^\]]*\])*\]"
"""An annotation of jaxtyping."""
SHAPE = re.compile(
    r"\b\w+ x \w|\b[bnhwsc] (?:\d|[bnhwsc]\b)|\bscalar\b"
    r"|\b(?:one|two|each of the n) (?:\w+ )?(?:numbers?|values?|row|pixels)"
)
"""A shape in words, such as ``h x w x 3``, ``b 1 h w`` or one number per frame."""


def _raised(function: Function) -> set[str]:
    """Return the project's errors that a function's own body raises."""
    found = set()
    for node in ast.walk(function):
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            called = node.exc.func
            found.add(called.id if isinstance(called, ast.Name) else getattr(called, "attr", ""))
    return found & ERRORS


def _says(text: str, name: str) -> bool:
    return re.search(rf"^\s*{name}( \(.*\))?:", text, re.MULTILINE) is not None


def _function_problems(name: str, function: Function, text: str, *, constructor: bool = False) -> list[str]:
    arguments = function.args
    every = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
    own = {each.arg: ast.unparse(each.annotation) if each.annotation else "" for each in every}
    own = {arg: kind.replace('"', "'") for arg, kind in own.items() if arg not in ("self", "cls")}
    problems = [f"{name} does not describe its argument {arg}" for arg in own if not _says(text, arg)]
    returned = ast.unparse(function.returns) if function.returns else "None"
    if not constructor and returned != "None" and "Returns:" not in text and "Yields:" not in text:
        problems.append(f"{name} does not say what it returns")
    if _raised(function) and "Raises:" not in text:
        problems.append(f"{name} raises {sorted(_raised(function))} and does not say so")
    bare = [re.sub(SHAPED, "", each) for each in (*own.values(), returned)]
    if any(re.search(r"\b(?:Tensor|NDArray|ndarray)\b", each) for each in bare) and not SHAPE.search(text):
        problems.append(f"{name} does not say the shape of an array")
    return problems


def _class_problems(name: str, node: ast.ClassDef, text: str) -> list[str]:
    problems = []
    init = next((each for each in node.body if isinstance(each, Function) and each.name == "__init__"), None)
    if init is not None:
        problems += _function_problems(name, init, text, constructor=True)
    for field, after in zip(node.body, [*node.body[1:], None], strict=True):
        if init is None and isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
            described = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
            if not (field.target.id.startswith("_") or described or _says(text, field.target.id)):
                problems.append(f"{name} does not describe its field {field.target.id}")
    for method in node.body:
        if isinstance(method, Function) and not method.name.startswith("_"):
            said = ast.get_docstring(method) or ""
            if not said:
                problems.append(f"{name}.{method.name} has no docstring")
            if _raised(method) and "Raises:" not in said:
                problems.append(f"{name}.{method.name} raises {sorted(_raised(method))} and does not say so")
    return problems


def _problems(name: str, source: str) -> list[str]:
    """Return what the docstring of one exported class or function lacks."""
    (node,) = ast.parse(textwrap.dedent(source)).body
    assert isinstance(node, ast.ClassDef | Function), f"{name} is neither a class nor a function"
    text = ast.get_docstring(node) or ""
    if not text:
        return [f"{name} has no docstring"]
    problems = [] if ">>> " in text else [f"{name} has no example"]
    if isinstance(node, ast.ClassDef):
        return problems + _class_problems(name, node, text)
    return problems + _function_problems(name, node, text)


def test_exported_names_are_described() -> None:
    problems = []
    for name in EXPORTED:
        thing: Any = getattr(saunet, name)
        if inspect.isclass(thing) and issubclass(thing, Exception):
            assert inspect.getdoc(thing)
        elif inspect.isclass(thing) or inspect.isfunction(thing):
            problems += _problems(name, inspect.getsource(inspect.unwrap(thing)))
            if dataclasses.is_dataclass(thing) and (thing.__doc__ or "").startswith(f"{name}("):
                problems.append(f"{name} has the docstring that dataclass makes up")
    assert not problems, "\n".join(problems)


def test_modules_say_what_they_hold() -> None:
    silent = [
        str(path.relative_to(SOURCE))
        for path in sorted(SOURCE.rglob("*.py"))
        if path.name != "__init__.py" and not ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))
    ]
    assert not silent


def _examples() -> Iterator[doctest.DocTest]:
    finder = doctest.DocTestFinder(recurse=False)
    for name in EXPORTED:
        thing = getattr(saunet, name)
        if not (inspect.isclass(thing) or inspect.isfunction(thing)):
            continue
        for each in finder.find(inspect.unwrap(thing), f"saunet.{name}", module=False, globs={}):
            if each.examples:
                yield each


@pytest.fixture(scope="session")
def examples_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as a user may have it: a trained model ``last.ckpt`` and a picture ``road.png``."""
    folder = tmp_path_factory.mktemp("examples")
    write_checkpoint(folder / "last.ckpt")
    rows, columns = np.mgrid[:96, :160].astype(np.uint8)
    cv2.imwrite(str(folder / "road.png"), np.stack([rows, columns, rows + columns], -1))
    return folder


@pytest.mark.parametrize("example", list(_examples()), ids=lambda example: example.name)
def test_the_example_runs(
    example: doctest.DocTest, examples_folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Examples import nothing but what they show; they may read ``last.ckpt`` and ``road.png``."""
    for path in examples_folder.iterdir():
        (tmp_path / path.name).symlink_to(path)
    monkeypatch.chdir(tmp_path)
    example.globs.update(saunet=saunet, torch=torch, np=np)
    said: list[str] = []
    options = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    result = doctest.DocTestRunner(optionflags=options).run(example, out=said.append, clear_globs=False)
    assert not result.failed, "".join(said)


@pytest.mark.parametrize(
    ("source", "problem"),
    [
        ("def f(a: int) -> None:\n    '''Do.\n\n    Args:\n        a: A.\n\n    >>> 1\n    '''", None),
        ("def f(a: int) -> None:\n    '''Do.\n\n    >>> 1\n    '''", "argument a"),
        ("def f(a: int) -> None:\n    '''Do.\n\n    Args:\n        a: A.\n    '''", "no example"),
        ("def f() -> int:\n    '''Do.\n\n    >>> 1\n    '''", "what it returns"),
        ("def f() -> None:\n    '''Do.\n\n    >>> 1\n    '''\n    raise DataError('x')", "raises"),
        ("def f(x: Tensor) -> None:\n    '''Do.\n\n    Args:\n        x: X.\n\n    >>> 1\n    '''", "shape"),
        ("def f(x: Tensor) -> None:\n    '''Do.\n\n    Args:\n        x: X, b 1 h w.\n\n    >>> 1\n    '''", None),
        ("class A:\n    '''A.\n\n    >>> 1\n    '''\n    a: int = 1", "field a"),
        ("class A:\n    '''A.\n\n    >>> 1\n    '''\n    a: int = 1\n    '''The a.'''", None),
        ("class A:\n    '''A.\n\n    >>> 1\n    '''\n    def go(self): pass", "A.go has no docstring"),
        ("class A:\n    '''A.\n\n    >>> 1\n    '''\n    def __init__(self, a: int) -> None: pass", "argument a"),
        ("def f(): pass", "no docstring"),
    ],
)
def test_the_rule_finds_what_it_should(source: str, problem: str | None) -> None:
    found = _problems("A" if source.startswith("class") else "f", source)
    assert len(found) == (problem is not None)
    if problem:
        assert problem in found[0]
