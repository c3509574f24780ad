"""``saunet-components``: print every registered component with its options, defaults and one-line description."""

from __future__ import annotations

import argparse
import inspect
import sys
from collections.abc import Mapping
from typing import Any

from saunet import schema
from saunet.errors import ConfigError, SaunetError
from saunet.registry import REGISTRIES, Entry, Registry, registry

NETWORKS = ["encoder", "decoder", "attention", "pose"]
"""Kinds whose components are networks."""
COUNTED = {"decoder": ", after stratified_tiny", "attention": ", for 64 channels"}
"""What `count` assumes, for the kinds whose size depends on their neighbors."""


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


def count(owner: Registry, entry: Entry) -> str:
    """Return the number of parameters of a network, in millions or as it is.

    Decoders follow the features of ``stratified_tiny``, attention sees 64 channels, AU-Net's width.
    """
    import torch

    from saunet.tools.benchmark import count_parameters

    with torch.device("meta"):  # shapes without memory
        late: dict[str, Any] = {"channels": 64} if "channels" in owner.late else {}
        if "features" in owner.late:
            late["features"] = registry("encoder").build("stratified_tiny").features
        network = owner.build(entry.name, **late)
    number = count_parameters(network)
    return f"{number / 1e6:.2f} M" if number > 9999 else str(number)


def main() -> None:
    """Entry point of ``saunet-components``.

    Raises:
        SystemExit: with one sentence, for an unknown kind or name.
    """
    parser = argparse.ArgumentParser(prog="saunet-components", description=__doc__.partition("``: ")[2])
    parser.add_argument("kind", nargs="?", help=f"one of: {', '.join(REGISTRIES)}; all by default")
    parser.add_argument("name", nargs="?", help="one component of that kind")
    parser.add_argument("--count", action="store_true", help="only names and numbers of trainable weights, of networks")
    arguments = parser.parse_args()
    try:
        kinds = NETWORKS if arguments.count and not arguments.kind else list(REGISTRIES)
        owners = [registry(kind) for kind in ([arguments.kind] if arguments.kind else kinds)]
        for owner in owners:
            entries = [owner.entry(arguments.name)] if arguments.name else list(owner)
            if arguments.count and owner.kind not in NETWORKS:
                raise ConfigError(f"--count is for networks: {', '.join(NETWORKS)}; got '{owner.kind}'")
            assumed = COUNTED.get(owner.kind, "") if arguments.count else ""
            print(f"{owner.kind} ({len(list(owner))} registered{assumed})")
            if arguments.count:
                print("\n".join(f"  {entry.name:20}{count(owner, entry):>12}" for entry in entries) + "\n")
            else:
                print("\n".join(describe(owner, entry) for entry in entries) + "\n")
    except SaunetError as error:
        sys.exit(f"saunet-components: {error}")


if __name__ == "__main__":
    main()
