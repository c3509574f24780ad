"""Components from outside the package, in modules that register them when imported.

Only modules that the user names or has installed are ever imported; a checkpoint only lists the plugins it needs.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
import warnings
from collections.abc import Iterable
from importlib.metadata import entry_points
from pathlib import Path

from saunet.errors import ConfigError

GROUP = "saunet.plugins"
"""Entry point group of installed packages: each entry names a module that registers components."""
_loaded: dict[str, None] = {}
_installed_loaded = False


def load(names: Iterable[str]) -> None:
    """Import modules by name (from the working directory too), or by the path of a ``.py`` file.

    A file's folder joins ``sys.path``, so that worker processes find the module as well.
    """
    for name in names:
        module = _module(name)
        if module in _loaded:
            continue
        try:
            importlib.import_module(module)
        except ConfigError:
            raise
        except Exception as reason:  # a user's file can raise anything
            raise ConfigError(
                f"plugins: '{name}' cannot be imported: {type(reason).__name__}: {' '.join(str(reason).split())}"
            ) from reason
        _loaded[module] = None


def _module(name: str) -> str:
    path = Path(name).expanduser()
    if name.endswith(".py") or path.is_file():
        if not path.is_file():
            raise ConfigError(f"plugins: no file at {name}; check the path")
        module, folder = path.stem, str(path.resolve().parent)
        _importable_from(folder)
        origin = getattr(_spec(module), "origin", None)
        if origin is None or Path(origin).resolve() != path.resolve():
            raise ConfigError(f"plugins: the name of {name} is taken by {origin or 'Python itself'}; rename the file")
        return module
    if not all(part.isidentifier() for part in name.split(".")):
        raise ConfigError(f"plugins: '{name}' is neither a module's name nor the path of a .py file")
    _importable_from(str(Path.cwd()))
    if _spec(name) is None:
        raise ConfigError(f"plugins: no module '{name}' here or among the installed packages; give its .py file's path")
    return name


def _importable_from(folder: str) -> None:
    if folder not in sys.path:
        sys.path.append(folder)  # last, so that it hides nothing
        importlib.invalidate_caches()


def _spec(module: str) -> importlib.machinery.ModuleSpec | None:
    try:
        return importlib.util.find_spec(module)
    except (ImportError, ValueError):
        return None


def load_installed() -> None:
    """Import the plugins of installed packages, once; one that fails is named and left out."""
    global _installed_loaded
    if _installed_loaded:
        return
    _installed_loaded = True
    for entry in entry_points(group=GROUP):
        try:
            entry.load()
        except Exception as reason:  # another package's fault must not stop this one
            warnings.warn(f"the installed plugin '{entry.name}' cannot be imported: {reason}", stacklevel=2)


def loaded() -> tuple[str, ...]:
    """Return the names of the modules that `load` imported, which a checkpoint's record keeps."""
    return tuple(_loaded)


def asked_for(path: str, names: Iterable[str] = ()) -> str:
    """Say what to do about a component at an import path that is not registered, given its record's plugins."""
    needed = [name for name in names if name not in _loaded] or [path.rpartition(".")[0]]
    if needed[0].split(".")[0] == "saunet":
        return "see `saunet components` for what is available"
    files = [each if "." in each else f"path/to/{each}.py" for each in needed]
    elsewhere = f", or plugins=[{','.join(files)}] for a file elsewhere" if files != needed else ""
    return (
        f"it needs the plugin '{needed[0]}'; if you trust it, add plugins=[{','.join(needed)}] if it is installed or "
        f"in the working directory{elsewhere}; in Python, import it"
    )
