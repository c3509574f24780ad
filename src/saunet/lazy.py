"""Names of a package that are imported when they are first used: what needs no torch starts without it."""

from __future__ import annotations

import importlib
import inspect
import sys
from collections.abc import Callable, Mapping
from typing import Any


def lazily(
    package: str, homes: Mapping[str, str], functions: Callable[[Any], Any] = lambda function: function
) -> Callable[[str], Any]:
    """Return a package's ``__getattr__`` for the names (separated by spaces) that each of its modules defines.

    What ``functions`` makes of a function is what the package offers.
    """
    modules = {name: module for module, names in homes.items() for name in names.split()}

    def load(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        value = getattr(importlib.import_module(f"{package}.{modules[name]}"), name)
        value = functions(value) if inspect.isfunction(value) else value
        setattr(sys.modules[package], name, value)
        return value

    return load
