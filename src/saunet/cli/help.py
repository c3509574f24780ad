"""Help: what a tool's keys are, with type, default and a sentence each."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping

from saunet import schema
from saunet.cli import words
from saunet.cli.app import Tool, config_dir
from saunet.cli.errors import HIDDEN
from saunet.cli.table import Table

WIDTH = 118


def tool_help(name: str, tool: Tool, table: Table, given: Mapping[str, str]) -> str:
    """Return the help of one tool.

    Args:
        name: Its name.
        tool: The tool.
        table: All keys.
        given: Group -> what the command line, or else the tool's own file, chooses.
    """
    plain = f" [{tool.positional.upper().replace('*', ' ...')}]" if tool.positional else ""
    node = table.tools[name]
    lines = [f"saunet {name}: {tool.summary}", "", f"usage: saunet {name}{plain} [KEY=VALUE ...]", "", "examples:"]
    lines += [f"  $ saunet {example}" for example in tool.examples]
    if tool.aliases:
        lines += ["", "short forms:", *(f"  {short}=... is {key}=..." for short, key in tool.aliases.items())]
    lines += ["", "keys:", *_keys((*node.keys, words.PLUGINS), "")]
    for group, key in _groups(node, table):
        names = [each for each in _choices(group, table) if each not in HIDDEN]
        chosen = given.get(group)
        lines += ["", f"{group}=NAME{f' (now {chosen})' if chosen else ''}, one of: {', '.join(names)}"]
        inner = table.group(group).get("lightning" if group == "trainer" else chosen or "")
        lines += _keys(inner.keys, f"{key}.") if inner else []
    return "\n".join(
        each for line in lines for each in (textwrap.wrap(line, WIDTH, subsequent_indent=" " * 8) if line else [""])
    )


def _keys(keys: tuple[schema.Key, ...], prefix: str) -> Iterator[str]:
    for key in keys:
        if key.node is not None:
            yield from _keys(key.node.keys, f"{prefix}{key.name}.")
        elif key.type not in ("component", "component?"):
            shown = "|".join(map(str, key.choices)) if key.choices else key.annotation.replace(" | None", "")
            default = " (required)" if key.default == schema.REQUIRED else f" = {written(key.default)}"
            yield f"  {prefix}{key.name}: {shown}{default}{f'  {key.help}' if key.help else ''}"


def written(value: object) -> str:
    """Return a default as one writes it on the command line."""
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    if isinstance(value, list):
        return f"[{','.join(map(written, value))}]"
    return str(value)


def _groups(node: schema.Node, table: Table) -> Iterator[tuple[str, str]]:
    """Return the config groups of a tool, each with the key that it fills."""
    for key in node.keys:
        if key.type in ("component", "component?") or key.name in table.library:
            yield key.name, key.name
        for inner in key.node.keys if key.node else ():
            if inner.type in ("component", "component?"):
                yield f"{key.name}/{inner.name}", f"{key.name}.{inner.name}"


def _choices(group: str, table: Table) -> list[str]:
    files = [path.stem for path in (config_dir() / group).glob("*.yaml")]
    return sorted({*files, *table.group(group)})
