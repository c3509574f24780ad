"""The parameters of a component, or of a tool's options, *are* its config keys: signature -> plain description.

Names, types, defaults and the sentence in the docstring are read from the signature. Descriptions are plain data, so
the command line can keep them in a file and check a configuration without importing what it configures.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import itertools
import re
import textwrap
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Optional, Union

from typing_extensions import Unpack

REQUIRED = "???"
"""Default of a key that must be given; OmegaConf's own mark."""
_PRIMITIVES = {bool: "bool", int: "int", float: "float", str: "str", Path: "str"}
_TYPES: dict[str, Any] = {"bool": bool, "int": int, "float": float, "str": str}


@dataclasses.dataclass(frozen=True, slots=True)
class Key:
    """One config key."""

    name: str
    type: str
    """``bool``, ``int``, ``float``, ``str``, ``any``, ``list[...]`` or ``dict[...]`` of these, ``component`` for a
    `saunet.registry.Spec`, ``node`` for nested keys; with a trailing ``?`` where None is allowed too."""
    default: Any = REQUIRED
    help: str = ""
    choices: tuple[Any, ...] = ()
    """The values allowed, where they are few."""
    annotation: str = ""
    """The type as Python writes it."""
    node: Node | None = None


@dataclasses.dataclass(frozen=True, slots=True)
class Node:
    """The config keys of a class or function."""

    name: str
    path: str | None
    """What to build, the config's ``_target_``; None for a tool's options."""
    summary: str
    """First line of the docstring."""
    keys: tuple[Key, ...]
    partial: bool = False
    """Whether parameters are missing that the caller supplies."""

    def key(self, dotted: str) -> Key | None:
        """Return the key ``a.b.c`` below this node, or None."""
        first, _, rest = dotted.partition(".")
        found = next((key for key in self.keys if key.name == first), None)
        if not rest or found is None:
            return found
        return found.node.key(rest) if found.node else None

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> Node:
        """Read what ``dataclasses.asdict`` wrote."""
        keys = [
            Key(**{**key, "choices": tuple(key["choices"]), "node": key["node"] and cls.from_plain(key["node"])})
            for key in plain["keys"]
        ]
        return cls(**{**plain, "keys": tuple(keys)})


_UNPACKED: dict[Any, type] = {}


def unpacked(keywords: Any, options: type) -> None:
    """Let components take ``**kwargs: Unpack[keywords]``, whose types and defaults are those of a dataclass."""
    _UNPACKED[keywords] = options


def parameters(target: Callable[..., Any], given: Sequence[str] = ()) -> dict[str, inspect.Parameter]:
    """Return the named parameters of a class or function, in order, with annotations resolved.

    A config key has a name and a type: ``*args`` and unannotated parameters are refused, and ``**kwargs`` but for an
    ``Unpack`` of keywords made known by `unpacked`. Those that are always ``given`` are no keys and need no annotation.
    """
    found: dict[str, inspect.Parameter] = {}
    for parameter, options in _signature(target):
        if options is not None:
            found |= parameters(options)
            continue
        name, owner = parameter.name, target.__qualname__
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            raise TypeError(f"{owner} takes '{parameter}'; a component names every parameter, each is a config key")
        if parameter.annotation is parameter.empty and name in given:
            parameter = parameter.replace(annotation=Any)
        if parameter.annotation is parameter.empty:
            raise TypeError(f"{owner}: parameter '{name}' has no annotation; its type is needed for the config schema")
        found[name] = parameter
    return found


def _signature(target: Callable[..., Any]) -> Iterator[tuple[inspect.Parameter, type | None]]:
    """Yield each parameter with its annotation resolved, and the options class that ``**kwargs`` stand for."""
    function: Any = target.__init__ if inspect.isclass(target) else target
    hints = typing.get_type_hints(function)
    for name, parameter in inspect.signature(target).parameters.items():
        hint = hints.get(name, parameter.empty)
        unpacks = parameter.kind is parameter.VAR_KEYWORD and typing.get_origin(hint) is Unpack
        options = _UNPACKED.get(typing.get_args(hint)[0]) if unpacks else None
        yield (parameter if unpacks else parameter.replace(annotation=hint)), options


def node(
    target: Callable[..., Any], preset: Mapping[str, Any] | None = None, late: Sequence[str] = (), path: str | None = ""
) -> Node:
    """Describe the config keys of an annotated class or function, with a preset of other defaults.

    ``late`` parameters are given by the caller at run time; they are no keys, and the node is partial. ``path`` is what
    to build, the target's own import path by default, None for options.
    """
    preset, said = dict(preset or {}), _sentences(target)
    owners: list[Callable[..., Any]] = [target, *(options for _, options in _signature(target) if options)]
    fields = {name: each for owner in owners for name, each in getattr(owner, "__dataclass_fields__", {}).items()}
    hidden = {name for name, field in fields.items() if not field.metadata.get("cli", True)}
    keys = []
    for name, parameter in parameters(target, late).items():
        if name in late or name in hidden:
            continue
        nested = _component(parameter.annotation)
        if nested is not None and name not in preset:
            inner = node(nested, path=None if path is None else "")
            keys.append(Key(name, "node", None, said.get(name, ""), node=inner))
            continue
        default, field = parameter.default, fields.get(name)
        if field is not None and field.default_factory is not dataclasses.MISSING:
            default = field.default_factory()
        default = preset.get(name, REQUIRED if default is parameter.empty else default)
        kind, choices = _type(parameter.annotation)
        kind = field.metadata.get("type", kind) if field is not None else kind
        shown = inspect.formatannotation(parameter.annotation)
        shown = re.sub(r"\b(typing|collections\.abc|pathlib|saunet\.registry)\.", "", shown)
        keys.append(Key(name, kind, _plain(default), said.get(name, ""), choices, shown))
    own = f"{target.__module__}.{target.__qualname__}" if path == "" else path
    return Node(target.__qualname__, own, (inspect.getdoc(target) or "").partition("\n")[0], tuple(keys), bool(late))


def _plain(value: Any) -> Any:
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value if isinstance(value, str | int | float | bool | None) else None


def _component(annotation: Any) -> type | None:
    """Return the class of a nested component or nested options, None for plain values."""
    plain = _strip_optional(annotation)
    if not inspect.isclass(plain) or plain in (*_PRIMITIVES, Any, type(None)) or typing.get_origin(plain):
        return None
    return None if plain.__module__ in ("builtins", "collections.abc", "typing") or _is_spec(plain) else plain


def _is_spec(annotation: Any) -> bool:
    return getattr(annotation, "__name__", "") == "Spec" and annotation.__module__ == "saunet.registry"


def _strip_optional(annotation: Any) -> Any:
    if typing.get_origin(annotation) in (Union, types.UnionType):
        rest = [a for a in typing.get_args(annotation) if a is not type(None)]
        if len(rest) == 1:
            return rest[0]
    return annotation


def _type(annotation: Any) -> tuple[str, tuple[Any, ...]]:
    """Return the name of a type as in `Key.type`, and the values allowed."""
    if annotation in _PRIMITIVES:
        return _PRIMITIVES[annotation], ()
    if _is_spec(annotation):
        return "component", ()
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin in (Union, types.UnionType):
        found = {_type(each) for each in arguments if each is not type(None)}
        names = {name for name, _ in found}
        if len(names) > 1 or "any" in names:
            return "any", ()
        choices = found.pop()[1] if len(found) == 1 else ()
        return names.pop() + ("?" if type(None) in arguments else ""), choices  # such as str | Path | None
    if origin is Literal:
        kinds = {type(a) for a in arguments}
        return (_PRIMITIVES[kinds.pop()] if len(kinds) == 1 else "any"), arguments
    if origin in (list, tuple, Sequence) or origin in (dict, Mapping):
        values = {_type(a)[0] for a in arguments[origin in (dict, Mapping) :] if a is not Ellipsis}
        return f"{'dict' if origin in (dict, Mapping) else 'list'}[{values.pop() if len(values) == 1 else 'any'}]", ()
    return "any", ()


def python_type(name: str) -> Any:
    """Return the type that a `Key.type` names, for a tool that checks values by it."""
    if name.endswith("?"):
        return Optional[python_type(name[:-1])]  # noqa: UP045 (OmegaConf wants the typing form)
    kind, _, item = name.partition("[")
    if kind in ("list", "dict"):
        inner = python_type(item[:-1])
        return list[inner] if kind == "list" else dict[str, inner]  # type: ignore[valid-type]
    return _TYPES.get(name, Any)


def _sentences(target: Callable[..., Any]) -> dict[str, str]:
    """Return what is said of each parameter, here or in a base: in ``Args:``, or in the string below a field."""
    said: dict[str, str] = {}
    for owner in reversed(target.__mro__) if inspect.isclass(target) else [target]:
        text = inspect.cleandoc(owner.__doc__ or "")
        section = re.search(r"^Args:\n(.*?)(?=^\S|\Z)", text, re.DOTALL | re.MULTILINE)
        pieces = re.split(r"^    \**(\w+): ", section[1], flags=re.MULTILINE)[1:] if section else []
        said |= zip(pieces[::2], pieces[1::2], strict=True)
    for _, options in _signature(target):
        said = {**(_sentences(options) if options else {}), **said}
    if dataclasses.is_dataclass(target):
        body = ast.parse(textwrap.dedent(inspect.getsource(target))).body[0].body  # type: ignore[attr-defined]
        for field, below in itertools.pairwise(body):
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(below, ast.Expr):
                said[field.target.id] = str(ast.literal_eval(below.value))
    return {name: " ".join(each.split()).replace("``", "") for name, each in said.items()}
