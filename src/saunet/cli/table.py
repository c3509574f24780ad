"""What can be configured, as plain data in a file: the command line reads it instead of importing every component.

The file lies in the user's cache folder and counts only while the sources, the installed packages and Python are the
ones that it was made from; otherwise it is made again, which imports everything once.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import cast

import saunet
from saunet import schema
from saunet.registry import REGISTRIES

LIBRARY = {("trainer", "lightning"): ("lightning:Trainer", "lightning.Trainer")}
"""Config nodes that are not components: (group, name) -> what it configures, and the path to build it from."""


@dataclass(frozen=True)
class Table:
    """Config keys by tool and by component.

    Args:
        tools: Tool -> the keys of its options.
        components: Kind -> name -> the component's keys.
        library: Group -> name -> the keys of a node that is no component.
    """

    tools: dict[str, schema.Node]
    components: dict[str, dict[str, schema.Node]]
    library: dict[str, dict[str, schema.Node]]

    def group(self, name: str) -> dict[str, schema.Node]:
        """Return the nodes of a config group such as ``model/encoder`` or ``trainer``; none for an unknown one."""
        for kind, registry in REGISTRIES.items():
            if registry.group == name:
                return self.components[kind]
        return self.library.get(name, {})

    def groups(self) -> dict[str, dict[str, schema.Node]]:
        """Return the nodes of all groups."""
        named = {registry.group: self.components[kind] for kind, registry in REGISTRIES.items() if registry.group}
        return {**named, **self.library}

    def by_path(self, path: object) -> schema.Node | None:
        """Return the keys of what a ``_target_`` names; None if it is no component."""
        return next((node for each in self.groups().values() for node in each.values() if node.path == path), None)

    def by_name(self, name: str) -> schema.Node | None:
        """Return the keys of a class, by its name alone, as in Hydra's messages."""
        found = [*self.tools.values(), *(node for each in self.groups().values() for node in each.values())]
        inner = [key.node for node in found for key in node.keys if key.node]
        return next((node for node in [*found, *inner] if node.name == name), None)


def imported(path: str) -> Callable[..., object]:
    """Return what ``module:name`` names."""
    module, _, name = path.partition(":")
    found: Callable[..., object] = getattr(importlib.import_module(module), name)
    return found


def read(tools: dict[str, str]) -> Table:
    """Return the table, from the file or, where that is missing or outdated, made now and written.

    What plugins registered in this process is part of it and never written.

    Args:
        tools: Tool -> its options as ``module:Class``.
    """
    plain = _read() or _write(_make(tools))
    components = {kind: _nodes(each) for kind, each in plain["components"].items()}
    for kind, registry in REGISTRIES.items():
        for entry in registry.registered():
            if entry.name not in components[kind]:
                components[kind][entry.name] = schema.node(entry.target, entry.preset, registry.late)
    library = {group: _nodes(each) for group, each in plain["library"].items()}
    return Table(_nodes(plain["tools"]), components, library)


def _nodes(plain: Mapping[str, object]) -> dict[str, schema.Node]:
    return {name: schema.Node.from_plain(cast(Mapping[str, object], each)) for name, each in plain.items()}


_Plain = dict[str, dict[str, dict[str, object]]]


def _make(tools: dict[str, str]) -> _Plain:
    library: dict[str, dict[str, object]] = {}
    own = [entry for each in REGISTRIES.values() for entry in each.registered() if entry.path.split(".")[0] != "saunet"]
    for (group, name), (target, path) in LIBRARY.items():
        library.setdefault(group, {})[name] = asdict(schema.node(imported(target), path=path))
    return {
        "tools": {name: asdict(schema.node(imported(path), path=None)) for name, path in tools.items()},
        "components": {
            kind: {entry.name: asdict(registry.node(entry.name)) for entry in registry if entry not in own}
            for kind, registry in REGISTRIES.items()
        },
        "library": library,
    }


def _file() -> Path:
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    where = hashlib.sha256(f"{sys.executable} {saunet.__path__[0]}".encode()).hexdigest()[:12]
    return Path(cache) / "saunet" / f"keys-{where}.json"


def _state() -> str:
    """Return what the table depends on: our sources, the folders of installed packages, and Python."""
    root = Path(saunet.__path__[0])
    sources = [path.stat() for path in sorted(root.rglob("*.py"))]
    folders = [Path(each) for each in sys.path if Path(each).name in ("site-packages", "dist-packages")]
    packages = [each.stat().st_mtime_ns for each in folders if each.is_dir()]
    state = [sys.version, saunet.__version__, [(each.st_mtime_ns, each.st_size) for each in sources], packages]
    return hashlib.sha256(json.dumps(state).encode()).hexdigest()


def _read() -> _Plain | None:
    with suppress(OSError, ValueError):
        plain = json.loads(_file().read_bytes())
        if plain.pop("state", None) == _state():
            found: _Plain = plain
            return found
    return None


def _write(plain: _Plain) -> _Plain:
    file = _file()
    with suppress(OSError):  # without a cache folder it is only slower
        file.parent.mkdir(parents=True, exist_ok=True)
        temporary = file.with_suffix(f".{os.getpid()}")
        temporary.write_text(json.dumps({"state": _state(), **plain}))
        temporary.replace(file)
    return plain
