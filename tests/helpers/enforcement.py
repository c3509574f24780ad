"""Annotations enforced at a tenth of the cost: jaxtyping binds the arguments of every call to compare shapes.

Where a function's annotations name no shape, beartype alone checks them.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib.machinery
import inspect
import types
import typing
from collections.abc import Callable
from typing import Any
from unittest import mock

import jaxtyping
from beartype import BeartypeConf, beartype
from beartype.roar import BeartypeDecorHintException
from jaxtyping import _import_hook as hook

_with_shapes = jaxtyping.jaxtyped
_plainly = beartype(conf=BeartypeConf(violation_type=jaxtyping.TypeCheckError))


def install() -> None:
    """Take the place of the decorator that jaxtyping's import hook puts on every function and class."""
    jaxtyping.jaxtyped = enforced  # type: ignore[assignment]
    hook._JaxtypingLoader.get_code = _get_code  # type: ignore[method-assign]
    hook._JaxtypingLoader.exec_module = importlib.machinery.SourceFileLoader.exec_module  # type: ignore[method-assign]


def _get_code(loader: hook._JaxtypingLoader, name: str) -> types.CodeType | None:
    """Name the hook's bytecode files apart while one is read, not while its module runs and imports other packages.

    These would be looked for under the hook's name, and compiled anew: thousands of modules.
    """
    own = functools.partial(hook._optimized_cache_from_source, loader._typechecker.get_hash())
    with mock.patch("importlib._bootstrap_external.cache_from_source", own):
        return importlib.machinery.SourceFileLoader.get_code(loader, name)


def enforced(target: Any = None, **typechecker: Callable[..., Any]) -> Any:
    """Return a function or dataclass that checks its arguments and what it returns."""
    if target is None:
        return functools.partial(enforced, **typechecker)
    if inspect.isclass(target):
        if dataclasses.is_dataclass(target) and "__init__" in vars(target):
            target.__init__ = enforced(target.__init__, **typechecker)  # type: ignore[misc]
        return target
    if isinstance(target, types.FunctionType) and not _names_shapes(target):
        with contextlib.suppress(BeartypeDecorHintException):  # it has not understood an annotation, such as P.args
            return _unless_disabled(target, _plainly(target))
    return _with_shapes(target, **typechecker)


def _unless_disabled(plain: Callable[..., Any], checked: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(plain)
    def either(*args: Any, **kwargs: Any) -> Any:
        return (plain if jaxtyping.config.jaxtyping_disable else checked)(*args, **kwargs)

    return either


def _names_shapes(function: types.FunctionType) -> bool:
    """Return whether an annotation names a shape, or cannot be read yet, as in a class that it is part of."""
    try:
        hints = typing.get_type_hints(function)
    except Exception:  # whatever evaluating an annotation raises: jaxtyping leaves that one out and checks the others
        return True
    return any(map(_is_shaped, hints.values()))


def _is_shaped(hint: object) -> bool:
    if isinstance(hint, list):  # the arguments of a Callable
        return any(map(_is_shaped, hint))
    shaped = isinstance(hint, type) and issubclass(hint, jaxtyping.AbstractArray)
    return shaped or any(map(_is_shaped, typing.get_args(hint)))
