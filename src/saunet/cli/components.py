"""``saunet-components``: print every registered component with its parameters, defaults and one-line description."""

from __future__ import annotations

import argparse
import inspect
import sys
from collections.abc import Mapping
from typing import Any

from saunet import schema
from saunet.checks import SaunetError
from saunet.registry import REGISTRIES, Entry, Registry, registry


def describe(owner: Registry, entry: Entry) -> str:
    """Return one component as text: how to choose it, what it is, and its parameters with their defaults."""
    choose = f"{owner.group}={entry.name}" if owner.group else f'saunet.build("{owner.kind}", "{entry.name}", ...)'
    lines = [f"  {entry.name}", f"      {entry.summary}", f"      choose: {choose}"]
    for name, parameter in schema.parameters(entry.target).items():
        if name not in owner.late:
            lines.append(f"      {name}: {_type(parameter)}{_default(name, parameter, entry.preset)}")
    return "\n".join(lines)


def _type(parameter: inspect.Parameter) -> str:
    return inspect.formatannotation(parameter.annotation).replace("typing.", "").replace("collections.abc.", "")


def _default(name: str, parameter: inspect.Parameter, preset: Mapping[str, Any]) -> str:
    value = preset.get(name, parameter.default)
    return "  (required)" if value is inspect.Parameter.empty else f" = {value!r}"


def main() -> None:
    """Entry point of ``saunet-components``."""
    parser = argparse.ArgumentParser(prog="saunet-components", description=__doc__.partition("``: ")[2])
    parser.add_argument("kind", nargs="?", help=f"one of: {', '.join(REGISTRIES)}; all by default")
    parser.add_argument("name", nargs="?", help="one component of that kind")
    arguments = parser.parse_args()
    try:
        owners = [registry(arguments.kind)] if arguments.kind else list(REGISTRIES.values())
        for owner in owners:
            entries = [owner.entry(arguments.name)] if arguments.name else list(owner)
            print(f"{owner.kind} ({len(list(owner))} registered)")
            print("\n".join(describe(owner, entry) for entry in entries) + "\n")
    except SaunetError as error:
        sys.exit(f"saunet-components: {error}")


if __name__ == "__main__":
    main()
