"""``saunet components``: every registered component with its keys, defaults and a sentence for each."""

from __future__ import annotations

import argparse

from saunet import schema
from saunet.cli import app
from saunet.cli.help import written
from saunet.errors import ConfigError, one_of
from saunet.registry import REGISTRIES, registry

NETWORKS = ("encoder", "decoder", "attention", "pose")
"""Kinds whose components are networks."""
COUNTED = {"decoder": ", after stratified_tiny", "attention": ", for 64 channels"}
"""What `count` assumes, for the kinds whose size depends on their neighbors."""


def describe(kind: str, name: str, node: schema.Node) -> str:
    """Return one component as text: how to choose it, what it is, and its keys."""
    group = REGISTRIES[kind].group
    choose = f"{group}={name}" if group else f'saunet.build("{kind}", "{name}", ...)'
    lines = [f"  {name}", f"      {node.summary}", f"      choose: {choose}"]
    for key in node.keys:
        default = "  (required)" if key.default == schema.REQUIRED else f" = {written(key.default)}"
        shown = key.annotation or (key.node.name if key.node else key.type)
        lines.append(f"      {key.name}: {shown}{'' if key.node else default}{f'  {key.help}' if key.help else ''}")
    return "\n".join(lines)


def count(kind: str, name: str) -> str:
    """Return the number of parameters of a network, in millions or as it is.

    Decoders follow the features of ``stratified_tiny``, attention sees 64 channels, AU-Net's width.
    """
    import torch

    from saunet.tools.benchmark import count_parameters

    owner = registry(kind)
    with torch.device("meta"):  # shapes without memory
        late: dict[str, object] = {"channels": 64} if "channels" in owner.late else {}
        if "features" in owner.late:
            late["features"] = registry("encoder").build("stratified_tiny").features
        network = owner.build(name, **late)
    number = count_parameters(network)
    return f"{number / 1e6:.2f} M" if number > 9999 else str(number)


def main() -> None:
    """Print what is registered.

    Raises:
        ConfigError: for an unknown kind or name.
    """
    parser = argparse.ArgumentParser(prog="saunet components", description=(__doc__ or "").partition("``: ")[2])
    parser.add_argument("kind", nargs="?", help=f"one of: {', '.join(REGISTRIES)}; all by default")
    parser.add_argument("name", nargs="?", help="one component of that kind")
    parser.add_argument("--count", action="store_true", help="only names and numbers of trainable weights, of networks")
    given = parser.parse_args()
    kinds = (
        [one_of("the kind", given.kind, REGISTRIES)] if given.kind else NETWORKS if given.count else list(REGISTRIES)
    )
    found = app.table().components
    for kind in kinds:
        if given.count and kind not in NETWORKS:
            raise ConfigError(f"--count is for networks: {', '.join(NETWORKS)}; got '{kind}'")
        names = [one_of(kind, given.name, found[kind])] if given.name else sorted(found[kind])
        print(f"{kind} ({len(found[kind])} registered{COUNTED.get(kind, '') if given.count else ''})")
        if given.count:
            print("\n".join(f"  {name:20}{count(kind, name):>12}" for name in names) + "\n")
        else:
            print("\n".join(describe(kind, name, found[kind][name]) for name in names) + "\n")
