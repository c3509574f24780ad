"""Constructor signature -> typed Hydra schema.

The parameters of a component *are* its config keys: names, types and defaults are read from ``__init__`` and become
a dataclass that OmegaConf validates, so a misspelt key or a word where a number belongs fails while the config is
composed.
"""

from __future__ import annotations

import dataclasses
import inspect
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Optional, Union

_PRIMITIVES = (bool, int, float, str)


def parameters(target: Callable[..., Any]) -> dict[str, inspect.Parameter]:
    """Return the named parameters of a class or function, in order, with annotations resolved.

    Raises:
        TypeError: if it takes ``*args``, ``**kwargs`` or an unannotated parameter: a config key has a name and a type.
    """
    owner = target.__qualname__
    function: Any = target.__init__ if inspect.isclass(target) else target
    hints = typing.get_type_hints(function)
    found = {}
    for name, parameter in inspect.signature(target).parameters.items():
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            raise TypeError(f"{owner} takes '{parameter}'; a component names every parameter, each is a config key")
        if name not in hints:
            raise TypeError(f"{owner}: parameter '{name}' has no annotation; its type is needed for the config schema")
        found[name] = parameter.replace(annotation=hints[name])
    return found


def node(
    target: Callable[..., Any],
    preset: Mapping[str, Any] | None = None,
    late: Sequence[str] = (),
    root: str | None = None,
) -> type:
    """Build the dataclass that stands for ``target`` in a config.

    Args:
        target: A class or function with an annotated signature.
        preset: Defaults that differ from the signature's.
        late: Parameters that the caller gives at run time; they leave the schema, and the node is partial.
        root: Import path to store as ``_target_``; the target's own by default.

    Returns:
        A dataclass type whose fields are ``_target_``, ``_convert_``, ``_partial_`` (with ``late``) and the parameters.
    """
    preset = dict(preset or {})
    fields: list[tuple[str, Any, Any]] = [
        ("_target_", str, dataclasses.field(default=root or f"{target.__module__}.{target.__qualname__}")),
        ("_convert_", str, dataclasses.field(default="all")),
    ]
    if late:
        fields.append(("_partial_", bool, dataclasses.field(default=True)))
    for name, parameter in parameters(target).items():
        if name in late:
            continue
        nested = _component(parameter.annotation)
        if nested is not None and name not in preset:
            made = node(nested)
            fields.append((name, made, dataclasses.field(default_factory=made)))
            continue
        default = preset.get(name, parameter.default)
        fields.append((name, _config_type(parameter.annotation), _field(default)))
    return dataclasses.make_dataclass(target.__qualname__, fields)


def _component(annotation: Any) -> type | None:
    """Return the class of a nested component (``Term`` or ``Term | None``), None for plain values."""
    plain = _strip_optional(annotation)
    if not inspect.isclass(plain) or plain in (*_PRIMITIVES, Path, Any, type(None)) or typing.get_origin(plain):
        return None
    if plain.__module__ in ("builtins", "collections.abc", "typing"):
        return None
    return plain


def _strip_optional(annotation: Any) -> Any:
    if typing.get_origin(annotation) in (Union, types.UnionType):
        rest = [a for a in typing.get_args(annotation) if a is not type(None)]
        if len(rest) == 1:
            return rest[0]
    return annotation


def _config_type(annotation: Any) -> Any:
    """Translate a Python annotation to the nearest type that OmegaConf checks."""
    if annotation in _PRIMITIVES or annotation is Any:
        return annotation
    if annotation is Path:
        return str
    plain = _strip_optional(annotation)
    if plain is not annotation:
        inner = _config_type(plain)
        return Any if inner is Any else Optional[inner]  # noqa: UP045 (OmegaConf wants the typing form)
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is Literal:
        kinds = {type(a) for a in arguments}
        return kinds.pop() if len(kinds) == 1 else Any
    if origin in (list, tuple, Sequence):
        items = {_config_type(a) for a in arguments if a is not Ellipsis}
        item = items.pop() if len(items) == 1 else Any
        return list[item]  # type: ignore[valid-type]
    if origin in (dict, Mapping):
        value = _config_type(arguments[1])
        return dict[str, value]  # type: ignore[valid-type]
    return Any


def _field(default: Any) -> Any:
    if default is inspect.Parameter.empty:
        default = "???"  # OmegaConf's mark of a mandatory value
    if isinstance(default, tuple):
        default = list(default)
    if isinstance(default, Path):
        default = str(default)
    if isinstance(default, list | dict | Mapping):
        return dataclasses.field(default_factory=lambda: default.copy())  # type: ignore[union-attr]
    return dataclasses.field(default=default)
