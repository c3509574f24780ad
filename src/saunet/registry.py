"""Components declared once, reachable from Python and from Hydra.

``@encoders.register("stratified_small", depths=(2, 2, 18, 2))`` on a class serves both
``saunet.build("encoder", "stratified_small", drop_path=0.1)`` and, on the command line,
``model/encoder=stratified_small model.encoder.drop_path=0.1``.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import pkgutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

from saunet import plugins, schema
from saunet.errors import ConfigError, check_arguments, checked, suggest

C = TypeVar("C", bound=Callable[..., Any])


@dataclass(frozen=True, slots=True, eq=False)
class Entry:
    """A registered name: what it builds and the defaults that make it this variant."""

    name: str
    target: Callable[..., Any]
    preset: Mapping[str, Any]

    @property
    def path(self) -> str:
        """Import path of the target, the ``_target_`` of its config node."""
        return f"{self.target.__module__}.{self.target.__qualname__}"


class Registry:
    """The components of one kind.

    Args:
        kind: What the components are, in the singular: ``"encoder"``.
        group: Hydra config group their nodes are stored in: ``"model/encoder"``; None keeps them out of the config.
        home: Module, or package of modules, that registers the built-in components; imported on first use.
        late: Parameters that the caller supplies when the rest of the system is known (a decoder's ``features``).

    Examples:
        A class of your own becomes a component, on the command line too where its module is one of ``plugins=``:

        >>> @saunet.encoders.register("mine")  # doctest: +SKIP
        ... class Mine(nn.Module): ...
        >>> saunet.attentions.names()
        ['cbam', 'eca', 'gct', 'none', 'se']
    """

    def __init__(self, kind: str, group: str | None, home: str, late: tuple[str, ...] = ()) -> None:
        self.kind, self.group, self.home, self.late = kind, group, home, late
        self._given = () if group else late  # what has a group is also built from its node
        self._imported = False
        self._entries: dict[str, Entry] = {}

    def register(self, name: str, /, **preset: Any) -> Callable[[C], C]:
        """Declare a class or function as component ``name``, with defaults that differ from its signature.

        Raises:
            ConfigError: if the name is taken.
            TypeError: if the signature cannot become a config schema, or the preset names no parameter.
        """

        def declare(target: C) -> C:
            if name in self._entries:
                paths = (self._entries[name].path, f"{target.__module__}.{target.__qualname__}")
                # A plugin may be imported before the built-in components; its class is the one to rename all the same.
                kept, renamed = sorted(paths, key=lambda path: not path.startswith("saunet."))
                raise ConfigError(f"{self.kind} '{name}' is already registered by {kept}; give {renamed} another name")
            for key in preset.keys() - schema.parameters(target, self._given).keys():
                raise TypeError(f"{self.kind} '{name}': preset key '{key}' is not a parameter of {target.__qualname__}")
            self._entries[name] = Entry(name, target, preset)
            return target

        return declare

    def build(self, name: str, /, **kwargs: Any) -> Any:
        """Build component ``name``; keywords override its defaults.

        Raises:
            ConfigError: for an unknown name or parameter, or one that is needed and not given.
        """
        entry = self.entry(name)
        parameters, given = schema.parameters(entry.target, self._given), {**entry.preset, **kwargs}
        _check_known(f"{self.kind} '{name}'", parameters, kwargs)
        check_arguments(entry.target, kwargs, {key: each.annotation for key, each in parameters.items()})
        missing = [key for key, each in parameters.items() if each.default is each.empty and key not in given]
        if missing:
            late = " (for a decoder, the encoder's features)" if missing == ["features"] else ""
            needed = ", ".join(f"{key}=..." for key in missing)
            raise ConfigError(f"{self.kind} '{name}' cannot be built without {needed}{late}")
        return entry.target(**given)

    def partial(self, name: str, /, **kwargs: Any) -> Callable[..., Any]:
        """Return a callable that builds ``name`` once its late parameters are known."""
        return functools.partial(self.build, name, **kwargs)

    def entry(self, name: str) -> Entry:
        """Return what is registered under ``name``; if nothing is, the error suggests the nearest name."""
        self._import_home()
        if name not in self._entries:
            hint = suggest(name, self._entries)
            raise ConfigError(f"unknown {self.kind} '{name}'{hint or ';'} available: {', '.join(self.names())}")
        return self._entries[name]

    def names(self) -> list[str]:
        """Return the registered names, sorted."""
        self._import_home()
        return sorted(self._entries)

    def __iter__(self) -> Iterator[Entry]:
        return iter([self._entries[name] for name in self.names()])

    def node(self, name: str) -> schema.Node:
        """Return the config keys of ``name``."""
        entry = self.entry(name)
        return schema.node(entry.target, entry.preset, self.late)

    def registered(self) -> list[Entry]:
        """Return what is registered so far; nothing is imported for it."""
        return list(self._entries.values())

    def by_path(self, path: str) -> Entry | None:
        """Return the entry with an import path, None if it is not registered; imports nothing outside of the home.

        Inside the home the class alone counts, so that a checkpoint outlives a move of the class to another module.
        """
        module, _, name = path.rpartition(".")
        at_home = f"{module}.".startswith(f"{self.home}.")
        if at_home:
            self._import_home() if module not in self._modules() else importlib.import_module(module)
        for entry in self._entries.values():
            owner, _, known = entry.path.rpartition(".")
            if entry.path == path or (at_home and known == name and f"{owner}.".startswith(f"{self.home}.")):
                return entry
        return None

    def _modules(self) -> list[str]:
        package = importlib.import_module(self.home)
        return [module.name for module in pkgutil.walk_packages(getattr(package, "__path__", ()), f"{self.home}.")]

    def _import_home(self) -> None:
        if self._imported:
            return
        self._imported = True
        for module in self._modules():
            importlib.import_module(module)
        plugins.load_installed()


encoders = Registry("encoder", "model/encoder", "saunet.models.encoders")
decoders = Registry("decoder", "model/decoder", "saunet.models.decoders", late=("features",))
attentions = Registry("attention", None, "saunet.models.attention", late=("channels",))
poses = Registry("pose", "model/pose", "saunet.models.poses")
terms = Registry("term", "term", "saunet.losses.terms")
objectives = Registry("objective", "objective", "saunet.losses.objectives")
datamodules = Registry("data", "data", "saunet.data")
outputs = Registry("output", None, "saunet.prediction.sinks", late=("clip",))  # of `saunet predict`: no part of a model
models = Registry("model", None, "saunet.models.systems")  # its members choose members of other groups

_ALL = (models, encoders, decoders, attentions, poses, terms, objectives, datamodules)
REGISTRIES: dict[str, Registry] = {registry.kind: registry for registry in _ALL}


@checked
def registry(kind: str) -> Registry:
    """Return the registry of a kind."""
    if kind not in REGISTRIES:
        raise ConfigError(f"unknown kind '{kind}'{suggest(kind, REGISTRIES) or ';'} kinds: {', '.join(REGISTRIES)}")
    return REGISTRIES[kind]


@checked
@dataclass(frozen=True, slots=True)
class Spec:
    """A component to build later: which one, and the parameters given so far.

    Options of tools hold components this way, because a tool may set some parameters itself (evaluation reads images at
    the network's size).

    Args:
        node: Plain containers: ``_target_`` and parameters; nested components are nodes too.
        name: The registered name, if known: several names can share a class.

    Examples:
        >>> data = saunet.Spec.of("data", "synthetic_tiny", workers=0)
        >>> data.get("workers"), data.changed(height=96).build().height
        (0, 96)
    """

    node: Mapping[str, Any]
    name: str | None = None
    example: ClassVar[str] = "saunet.Spec.of('data', 'video', root='clips')"
    """What a message shows where something else was given."""

    @classmethod
    def of(cls, kind: str, name: str, /, **kwargs: Any) -> Spec:
        """Describe component ``name`` of a kind: ``Spec.of("data", "kitti", root="/data/kitti")``.

        Raises:
            ConfigError: for an unknown kind, name or parameter.
        """
        entry = registry(kind).entry(name)
        _check_keys(f"{kind} '{name}'", entry.target, kwargs)
        return cls({"_target_": entry.path, **entry.preset, **kwargs}, name)

    @property
    def parameters(self) -> dict[str, inspect.Parameter]:
        """Parameters that the component takes."""
        return schema.parameters(_by_path(self.node["_target_"]).target)

    def get(self, key: str, default: Any = None) -> Any:
        """Return a parameter that was given, or a default."""
        return self.node.get(key, default)

    def changed(self, **changes: Any) -> Spec:
        """Return the same component with other parameters."""
        return Spec({**self.node, **changes}, self.name)

    def fitted(self, **changes: Any) -> Spec:
        """Return the same component with other parameters, as far as it takes them."""
        known = self.parameters
        return self.changed(**{key: value for key, value in changes.items() if key in known})

    def build(self, **changes: Any) -> Any:
        """Build the component, with some parameters changed.

        Raises:
            ConfigError: if a key is not a parameter of it, or the component is not registered.
        """
        return instantiate({**self.node, **changes})


def instantiate(node: Any) -> Any:
    """Build what plain containers describe: mappings with ``_target_`` become components, innermost first.

    Only registered components are ever built, whatever a file says, so a checkpoint's config cannot run foreign code.
    """
    if isinstance(node, Mapping):
        values = {key: instantiate(value) for key, value in node.items() if key not in ("_convert_", "_partial_")}
        if "_target_" not in node:
            return values
        path = values.pop("_target_")
        target = _by_path(path).target
        _check_keys(f"'{target.__qualname__}'", target, values)
        return functools.partial(target, **values) if node.get("_partial_") else target(**values)
    if isinstance(node, list | tuple):
        return [instantiate(item) for item in node]
    return node


def _by_path(path: str) -> Entry:
    found = find(path)
    if found is None:
        raise ConfigError(f"'{path}' is not a registered component, so it is not built; {plugins.asked_for(path)}")
    return found


def find(path: str, kinds: Iterable[str] = ()) -> Entry | None:
    """Return the registered component with an import path, of some kinds or any, None if there is none."""
    owners = [REGISTRIES[kind] for kind in kinds or REGISTRIES]
    for _ in range(2):
        for owner in owners:
            entry = owner.by_path(path)
            if entry is not None:
                return entry
        plugins.load_installed()
    return None


def _check_keys(what: str, target: Callable[..., Any], kwargs: Mapping[str, Any]) -> None:
    _check_known(what, schema.parameters(target), kwargs)


def _check_known(what: str, known: Mapping[str, Any], kwargs: Mapping[str, Any]) -> None:
    for key in kwargs:
        if key not in known:
            hint = suggest(key, known)
            raise ConfigError(f"{what} has no parameter '{key}'{hint or ';'} allowed: {', '.join(known)}")
