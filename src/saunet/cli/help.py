"""Help: what a tool's keys are, with type, default and a sentence each."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator, Mapping

from saunet import schema
from saunet.cli import words
from saunet.cli.app import Tool
from saunet.cli.config import config_dir
from saunet.cli.errors import HIDDEN
from saunet.cli.table import Table

WIDTH = 118


def tool_help(name: str, tool: Tool, table: Table, given: Mapping[str, str]) -> str:
    """Return the help of one tool.

    Args:
        name: Its name.
        tool: The tool.
        table: All keys.
        given: Group -> what the command line chooses.
    """
    plain = f" [{tool.positional.upper().replace('*', ' ...')}]" if tool.positional else ""
    node = table.tools[name]
    lines = [f"saunet {name}: {tool.summary}", "", f"usage: saunet {name}{plain} [KEY=VALUE ...]", "", "examples:"]
    lines += [f"  $ saunet {example}" for example in tool.examples]
    if tool.aliases:
        lines += ["", "short forms:", *(f"  {short}=... is {key}=..." for short, key in tool.aliases.items())]
    lines += ["", "keys:", *_keys((*node.keys, words.PLUGINS), "")]
    given = {**defaults(name), **given}
    for group, key in groups(node, table):
        now = given.get(group)
        lines += ["", f"{group}=NAME{f' (now {now})' if now else ''}, one of: {', '.join(choices(group, table))}"]
        inner = chosen(group, given, table)
        lines += _keys(inner.keys, f"{key}.") if inner else []
    return "\n".join(
        each for line in lines for each in (textwrap.wrap(line, WIDTH, subsequent_indent=" " * 8) if line else [""])
    )


def _keys(keys: tuple[schema.Key, ...], prefix: str) -> Iterator[str]:
    for key in keys:
        if key.node is not None:
            yield from _keys(key.node.keys, f"{prefix}{key.name}.")
        elif key.type not in ("component", "component?") and key.name not in ("trainer", "callbacks", "logger"):
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


def groups(node: schema.Node, table: Table) -> Iterator[tuple[str, str]]:
    """Yield the config groups of a tool, each with the key that it fills."""
    for key in node.keys:
        if key.type in ("component", "component?") or key.name in (*table.library, "callbacks", "logger"):
            yield key.name, key.name
        for inner in key.node.keys if key.node else ():
            if inner.type in ("component", "component?"):
                yield f"{key.name}/{inner.name}", f"{key.name}.{inner.name}"
        if key.name == "model":
            yield "model", "model"


def choices(group: str, table: Table) -> list[str]:
    """Return what a config group offers."""
    files = [path.stem for path in (config_dir() / group).glob("*.yaml")]
    return [each for each in sorted({*files, *table.group(group)}) if each not in HIDDEN]


def chosen(group: str, given: Mapping[str, str], table: Table) -> schema.Node | None:
    """Return the keys of what is chosen for a group; None where that brings no keys of its own."""
    return table.group(group).get("lightning" if group == "trainer" else given.get(group, ""))


def defaults(tool: str) -> dict[str, str]:
    """Return what a tool chooses for each group unless told otherwise."""
    found: dict[str, str] = {}
    for name in (tool, f"model/{_default(tool, 'model')}"):
        for line in re.findall(r"^  - (\w+): (\w+)$", _text(name), re.MULTILINE):
            found[f"model/{line[0]}" if "/" in name else line[0]] = line[1]
    return {group: name for group, name in found.items() if name != "null"}


def _default(tool: str, group: str) -> str:
    found = re.search(rf"^  - {group}: (\w+)$", _text(tool), re.MULTILINE)
    return found[1] if found else ""


def _text(name: str) -> str:
    path = config_dir() / f"{name}.yaml"
    return path.read_text() if path.is_file() else ""
