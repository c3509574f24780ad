"""A tool's help, the list of components, and Tab completion, all from the table of keys alone."""

from __future__ import annotations

import argparse
import itertools
import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

from saunet import plugins, schema
from saunet.cli.table import PLUGINS, TOOLS, TRAINER, Table, Tool, config_dir, read
from saunet.cli.words import choices, is_plugins, named_plugins
from saunet.errors import ConfigError, one_of
from saunet.registry import REGISTRIES, registry

WIDTH = 118
COMPONENT = ("component", "component?")
PARTS = (TRAINER[0], "callbacks", "logger")
"""Keys filled by a config group that are not components."""
RECIPES = {
    "experiment": "a complete training, one of",
    "loss": "a variant of the objective, one of",
    "sweep": "several trainings, one of",
}
"""Config groups of ``train`` that no component fills, and what they choose."""
NETWORKS = ("encoder", "decoder", "attention", "pose")
COUNTED = {"decoder": ", after stratified_tiny", "attention": ", for 64 channels"}
"""What `count` assumes, for the kinds whose size depends on their neighbors."""
SCRIPTS = {
    "bash": """_saunet() {
  local IFS=$'\\n' line="${COMP_LINE:0:$COMP_POINT}" word cut
  word="${line##* }"; cut="${word%"${word##*[=:]}"}"
  COMPREPLY=($(saunet --complete "$line" 2>/dev/null))
  COMPREPLY=("${COMPREPLY[@]#"$cut"}")
}
complete -o nospace -o default -F _saunet saunet""",
    "zsh": """_saunet() {
  local -a found
  found=("${(@f)$(saunet --complete "${LBUFFER}" 2>/dev/null)}")
  compadd -U -S '' -- $found
}
compdef _saunet saunet""",
    "fish": """function _saunet
  saunet --complete (commandline -cp) 2>/dev/null
end
complete -c saunet -f -a '(_saunet)'""",
}
"""Shell -> the script that it evaluates: ``eval "$(saunet --completion bash)"``."""


def tool_help(tool: Tool, table: Table, values: Mapping[str, object], chosen: Mapping[str, str]) -> str:
    """Return the help of one tool, with the current values of its keys and the choice of each group."""
    plain = f" [{tool.positional.upper().replace('*', ' ...')}]" if tool.positional else ""
    node, said = table.tools[tool.name], f"saunet {tool.name}"
    lines = [f"{said}: {tool.summary}", "", f"usage: {said}{plain} [KEY=VALUE ...]", "", "examples:"]
    lines += [f"  $ saunet {example}" for example in tool.examples]
    if tool.aliases:
        lines += ["", "short forms:", *(f"  {short}=... is {key}=..." for short, key in tool.aliases.items())]
    for group, what in RECIPES.items() if tool.name == "train" else ():
        found = list(recipes(group))
        width = max(len(name) for name, _ in found)
        lines += ["", f"{group}=NAME, {what}:", *(f"  {name:{width}}  {told}" for name, told in found)]
    lines += ["", "keys:", *described(_with_folder(node.keys, tool), "  ", values)]
    for group in groups(node):
        now = chosen.get(group)
        lines += ["", f"{group}=NAME{f' (now {now})' if now else ''}, one of: {', '.join(table.choices(group))}"]
        lines += described(chosen_keys(group, chosen, table), f"  {group.replace('/', '.')}.", values)
    return "\n".join(
        each for line in lines for each in (textwrap.wrap(line, WIDTH, subsequent_indent=" " * 8) if line else [""])
    )


def recipes(group: str) -> Iterator[tuple[str, str]]:
    """Yield the name of each YAML file of a group, and the first sentence of its comment."""
    folder = config_dir() / group
    for file in sorted(folder.rglob("*.yaml"), key=lambda each: (len(each.parts), each)):
        comment = itertools.takewhile(lambda line: line.startswith("#"), file.read_text(encoding="utf-8").splitlines())
        text = " ".join(line.lstrip("# ") for line in comment if not line.startswith("# @"))
        first = re.match(r".*?[.?!](?=\s|$)", text)
        yield file.relative_to(folder).with_suffix("").as_posix(), first[0] if first else text


def _with_folder(keys: Sequence[schema.Key], tool: Tool) -> list[schema.Key]:
    """Give the key of the results folder the default from the tool's YAML file."""
    found = re.search(r"^(?:    dir|output): (outputs/\S+)", _yaml(tool), re.MULTILINE)
    folder = found and found[1].replace("${name}", "NAME").partition("${now")[0] + "DATE_TIME"
    return [replace(key, default=folder) if folder and key.name in ("output", "output_dir") else key for key in keys]


def _yaml(tool: Tool) -> str:
    file = config_dir() / f"{tool.config or tool.name}.yaml"
    return file.read_text(encoding="utf-8") if file.is_file() else ""


def described(
    keys: Sequence[schema.Key], prefix: str, values: Mapping[str, object] = MappingProxyType({})
) -> Iterator[str]:
    """Yield a line for each key with a value, its name behind a prefix; ``values`` override defaults."""
    for name, key in leaves(keys, prefix):
        if key.name not in PARTS:
            shown = "|".join(map(str, key.choices)) if key.choices else key.annotation.replace(" | None", "")
            value = values.get(name.strip(), key.default)
            value = key.default if "${" in str(value) else value  # it follows another key
            default = " (required)" if value == schema.REQUIRED else f" = {written(value)}"
            if value is None:
                default = " (Lightning's default)" if name.strip().startswith(f"{TRAINER[0]}.") else " (not set)"
            yield f"{name}: {shown}{default}{f'  {key.help}' if key.help else ''}"


def leaves(keys: Sequence[schema.Key], prefix: str = "") -> Iterator[tuple[str, schema.Key]]:
    """Yield the keys with a value, including those of nested options, with their full names."""
    for key in keys:
        if key.node is not None:
            yield from leaves(key.node.keys, f"{prefix}{key.name}.")
        elif key.type not in COMPONENT:
            yield f"{prefix}{key.name}", key


def written(value: object) -> str:
    """Return a default as one writes it on the command line."""
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    return f"[{','.join(map(written, value))}]" if isinstance(value, list) else str(value)


def groups(node: schema.Node) -> Iterator[str]:
    """Yield the config groups of a tool."""
    for key in node.keys:
        if key.type in COMPONENT or key.name in PARTS:
            yield key.name
        yield from (
            f"{key.name}/{inner.name}" for inner in (key.node.keys if key.node else ()) if inner.type in COMPONENT
        )
        if key.name == "model":
            yield "model"


def chosen_names(tool: Tool, table: Table, given: Mapping[str, str]) -> dict[str, str]:
    """Return the choice for each group: from the command line, else from the tool's YAML file."""
    chosen = {**dict(re.findall(r"^  - (\w+): (?!null$)(\w+)$", _yaml(tool), re.MULTILINE)), **given}
    model = table.components["model"].get(chosen.get("model", ""))
    parts = {f"model/{key.name}": str(key.default) for key in (model.keys if model else ())}
    return {**{group: name for group, name in parts.items() if group in table.groups}, **chosen}


def chosen_keys(group: str, chosen: Mapping[str, str], table: Table) -> Sequence[schema.Key]:
    """Return the keys that the choice for a group brings; none where that has no keys of its own."""
    node = table.groups.get(group, {}).get(TRAINER[1] if group == TRAINER[0] else chosen.get(group, ""))
    return node.keys if node else ()


def components(arguments: Sequence[str]) -> None:
    """Print what is registered: all, a kind, or one component."""
    parser = argparse.ArgumentParser(
        prog="saunet components",
        description="every registered component with its keys, defaults and one sentence",
        epilog=f"{PLUGINS.name}=[my_file.py,...]  {PLUGINS.help}",
    )
    parser.add_argument("kind", nargs="?", help=f"one of: {', '.join(REGISTRIES)}; all by default")
    parser.add_argument("name", nargs="?", help="one component of that kind")
    parser.add_argument(
        "--count", action="store_true", help="for networks: only names and numbers of trainable weights"
    )
    plugins.load(named_plugins(arguments))
    given = parser.parse_args([word for word in arguments if not is_plugins(word)])
    everything = NETWORKS if given.count else tuple(REGISTRIES)
    found = read().components
    for kind in (one_of("the kind", given.kind, REGISTRIES),) if given.kind else everything:
        if given.count and kind not in NETWORKS:
            raise ConfigError(f"--count is for networks: {', '.join(NETWORKS)}; got '{kind}'")
        names = [one_of(kind, given.name, found[kind])] if given.name else sorted(found[kind])
        print(f"{kind} ({len(found[kind])} registered{COUNTED.get(kind, '') if given.count else ''})")
        for name in names:
            if given.count:
                print(f"  {name:20}{count(kind, name):>12}")
                continue
            node, group = found[kind][name], "model" if kind == "model" else REGISTRIES[kind].group
            if kind == "term":  # added to an objective instead of replacing another component
                choose = f"+objective.extra.{name}.weight=..."
            else:
                choose = f"{group}={name}" if group else f'saunet.build("{kind}", "{name}", ...)'
            print(f"  {name}\n      {node.summary}\n      choose: {choose}", *described(node.keys, "      "), sep="\n")
        print()


def count(kind: str, name: str) -> str:
    """Return a network's number of parameters, in millions or exactly."""
    import torch

    from saunet.tools.benchmark import count_parameters

    owner = registry(kind)
    with torch.device("meta"):  # shapes only, no memory
        late: dict[str, object] = {"channels": 64} if "channels" in owner.late else {}
        if "features" in owner.late:
            late["features"] = registry("encoder").build("stratified_tiny").features
        try:
            network = owner.build(name, **late)
        except ConfigError:  # of a package that is not installed
            return "?"
    number = count_parameters(network)
    return f"{number / 1e6:.2f} M" if number > 9999 else str(number)


def completion(shell: str) -> list[str]:
    """Return the script that makes a shell complete ``saunet``."""
    return [SCRIPTS[one_of("--completion", shell, SCRIPTS)]]


def complete(line: str) -> list[str]:
    """Return the completions of a line's last word, given the line from ``saunet`` up to the cursor."""
    given, table = line.split(" ")[1:], read()
    word = given[-1] if given else ""
    if len(given) < 2:
        return [each for each in ("--help", "--version", *TOOLS, "resume") if each.startswith(word)]
    tool = "train" if given[0] == "resume" else given[0]
    if tool not in table.tools:
        return []
    key, equals, value = word.lstrip("+~").partition("=")
    sign = word[: len(word) - len(word.lstrip("+~"))]
    if equals:
        return [f"{sign}{key}={each}" for each in _values(key, value, tool, table)]
    return [f"{sign}{each}" for each in _completed(key, tool, table, choices(given[1:-1]))]


def _completed(start: str, tool: str, table: Table, given: Mapping[str, str]) -> list[str]:
    """Return keys, one level at a time: ``data.`` and then ``data.root=``."""
    chosen = chosen_names(TOOLS[tool], table, given)
    found = {name for name, _ in leaves(table.tools[tool].keys)}
    found.update(RECIPES if tool == "train" else ())
    for group in groups(table.tools[tool]):
        inner = leaves(chosen_keys(group, chosen, table), f"{group.replace('/', '.')}.")
        found |= {group, *(name for name, _ in inner)}
    rests = (each[len(start) :].partition(".") for each in found if each.startswith(start))
    return sorted({f"{start}{inner}{dot or '='}" for inner, dot, _ in rests})


def _values(key: str, start: str, tool: str, table: Table) -> list[str]:
    names = table.choices(key)
    for each in () if names else table.known(tool, key)[:1]:
        names = [written(choice) for choice in each.choices]
        names = names or (["true", "false"] if each.type.startswith("bool") else [])
        if not names and each.type.rstrip("?") in ("str", "any", "list[str]"):
            folder = Path(start if start.endswith("/") else Path(start).parent)
            files = sorted(folder.iterdir()) if folder.is_dir() else []
            names = [f"{file}/" if file.is_dir() else str(file) for file in files if not file.name.startswith(".")]
    return [name for name in names if name.startswith(start)]
