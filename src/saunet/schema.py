"""Signature -> plain description of the config keys that a component, or a tool's options, has.

The parameters of a component *are* its config keys: names, types, defaults and the sentence in the docstring are read
from its signature. Descriptions are plain data, so the command line can keep them in a file and check a configuration
without importing what it configures.
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
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Union

from typing_extensions import Unpack

REQUIRED = "???"
"""Default of a key that must be given; OmegaConf's own mark."""
_PRIMITIVES = {bool: "bool", int: "int", float: "float", str: "str", Path: "str"}


@dataclasses.dataclass(frozen=True, slots=True)
class Key:
    """One config key.

    Args:
        name: The parameter's name.
        type: ``bool``, ``int``, ``float``, ``str``, ``any``, ``list[...]`` or ``dict[...]`` of these, ``component`` for
            a `saunet.registry.Spec`, ``node`` for nested keys; with a trailing ``?`` where None is allowed too.
        default: Plain data; `REQUIRED` where there is none.
        help: What it does, in a sentence.
        choices: The values allowed, where they are few.
        annotation: The type as Python writes it.
        node: The nested keys of type ``node``.
    """

    name: str
    type: str
    default: Any = REQUIRED
    help: str = ""
    choices: tuple[Any, ...] = ()
    annotation: str = ""
    node: Node | None = None


@dataclasses.dataclass(frozen=True, slots=True)
class Node:
    """The config keys of a class or function.

    Args:
        name: The class's name.
        path: What to build, the config's ``_target_``; None for a tool's options.
        summary: First line of the docstring.
        keys: The keys in order.
        partial: Whether parameters are missing that the caller supplies.
    """

    name: str
    path: str | None
    summary: str
    keys: tuple[Key, ...]
    partial: bool = False

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
    """Let components take ``**kwargs: Unpack[keywords]``: parameters with the types and defaults of a dataclass.

    Args:
        keywords: A ``TypedDict`` with the names of the fields.
        options: The dataclass.
    """
    _UNPACKED[keywords] = options


def parameters(target: Callable[..., Any]) -> dict[str, inspect.Parameter]:
    """Return the named parameters of a class or function, in order, with annotations resolved.

    Raises:
        TypeError: if it takes ``*args``, an unannotated parameter, or ``**kwargs`` that no ``Unpack`` of keywords made
            known by `unpacked` describes: a config key has a name and a type.
    """
    owner = target.__qualname__
    function: Any = target.__init__ if inspect.isclass(target) else target
    hints = typing.get_type_hints(function)
    found: dict[str, inspect.Parameter] = {}
    for name, parameter in inspect.signature(target).parameters.items():
        options = _options(parameter, hints.get(name))
        if options is not None:
            found |= parameters(options)
            continue
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            raise TypeError(f"{owner} takes '{parameter}'; a component names every parameter, each is a config key")
        if name not in hints:
            raise TypeError(f"{owner}: parameter '{name}' has no annotation; its type is needed for the config schema")
        found[name] = parameter.replace(annotation=hints[name])
    return found


def _options(parameter: inspect.Parameter, annotation: Any) -> type | None:
    """Return the options class behind ``**kwargs: Unpack[Keywords]``, None for any other parameter."""
    if parameter.kind is not parameter.VAR_KEYWORD or typing.get_origin(annotation) is not Unpack:
        return None
    return _UNPACKED.get(typing.get_args(annotation)[0])


def summary(target: Callable[..., Any]) -> str:
    """Return the first line of a docstring."""
    return (inspect.getdoc(target) or "").partition("\n")[0]


def node(
    target: Callable[..., Any],
    preset: Mapping[str, Any] | None = None,
    late: Sequence[str] = (),
    path: str | None = "",
) -> Node:
    """Describe the config keys of ``target``.

    Args:
        target: A class or function with an annotated signature.
        preset: Defaults that differ from the signature's.
        late: Parameters that the caller gives at run time; they are no keys, and the node is partial.
        path: Import path to build from; the target's own by default, None for options, which are not built by path.
    """
    preset = dict(preset or {})
    owners: list[Callable[..., Any]] = [target, *_all_options(target)]
    said = {name: each for owner in reversed(owners) for name, each in _sentences(owner).items()}
    fields = {name: each for owner in owners for name, each in getattr(owner, "__dataclass_fields__", {}).items()}
    hidden = {name for name, field in fields.items() if not field.metadata.get("cli", True)}
    keys = []
    for name, parameter in parameters(target).items():
        if name in late or name in hidden:
            continue
        default = _plain(preset.get(name, _default(fields.get(name), parameter)))
        nested = _component(parameter.annotation)
        kind, choices = _type(parameter.annotation)
        if nested is not None and name not in preset:
            inner = node(nested, path=None if path is None else "")
            keys.append(Key(name, "node", None, said.get(name, ""), node=inner))
        else:
            shown = inspect.formatannotation(parameter.annotation)
            shown = re.sub(r"\b(typing|collections\.abc|pathlib)\.", "", shown)
            keys.append(Key(name, kind, default, said.get(name, ""), choices, shown))
    own = f"{target.__module__}.{target.__qualname__}" if path == "" else path
    return Node(target.__qualname__, own, summary(target), tuple(keys), bool(late))


def _all_options(target: Callable[..., Any]) -> list[type]:
    """Return the options classes that ``**kwargs`` stand for."""
    function: Any = target.__init__ if inspect.isclass(target) else target
    hints = typing.get_type_hints(function)
    found = (_options(each, hints.get(name)) for name, each in inspect.signature(target).parameters.items())
    return [each for each in found if each is not None]


def _default(field: Any, parameter: inspect.Parameter) -> Any:
    if field is not None and field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return REQUIRED if parameter.default is inspect.Parameter.empty else parameter.default


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
    plain = _strip_optional(annotation)
    if plain is not annotation:
        inner, choices = _type(plain)
        return (inner if inner == "any" else f"{inner}?"), choices
    if typing.get_origin(annotation) in (Union, types.UnionType):
        names = {_type(each)[0] for each in typing.get_args(annotation) if each is not type(None)}
        if len(names) == 1:  # such as str | Path
            return names.pop() + ("?" if type(None) in typing.get_args(annotation) else ""), ()
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is Literal:
        kinds = {type(a) for a in arguments}
        return (_PRIMITIVES[kinds.pop()] if len(kinds) == 1 else "any"), arguments
    if origin in (list, tuple, Sequence) or origin in (dict, Mapping):
        values = {_type(a)[0] for a in arguments[origin in (dict, Mapping) :] if a is not Ellipsis}
        return f"{'dict' if origin in (dict, Mapping) else 'list'}[{values.pop() if len(values) == 1 else 'any'}]", ()
    return "any", ()


def _sentences(target: Callable[..., Any]) -> dict[str, str]:
    """Return what is said of each parameter, here or in a base: in ``Args:``, or in the string below a field."""
    said: dict[str, str] = {}
    for owner in reversed(target.__mro__) if inspect.isclass(target) else [target]:
        text = inspect.cleandoc(owner.__doc__ or "")
        section = re.search(r"^Args:\n(.*?)(?=^\S|\Z)", text, re.DOTALL | re.MULTILINE)
        pieces = re.split(r"^    \**(\w+): ", section[1], flags=re.MULTILINE)[1:] if section else []
        said |= zip(pieces[::2], pieces[1::2], strict=True)
    function: Any = target.__init__ if inspect.isclass(target) else target
    for name, parameter in inspect.signature(function).parameters.items():
        if (options := _options(parameter, typing.get_type_hints(function).get(name))) is not None:
            said = {**_sentences(options), **said}
    if dataclasses.is_dataclass(target):
        body = ast.parse(textwrap.dedent(inspect.getsource(target))).body[0].body  # type: ignore[attr-defined]
        for field, below in itertools.pairwise(body):
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(below, ast.Expr):
                said[field.target.id] = str(ast.literal_eval(below.value))
    return {name: " ".join(each.split()).replace("``", "") for name, each in said.items()}
