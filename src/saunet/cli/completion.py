"""Tab completion: from the table of keys alone, so that it answers at once."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from saunet import schema
from saunet.cli import help as help_
from saunet.cli import words
from saunet.cli.table import Table
from saunet.errors import one_of

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
"""Shell -> what it has to evaluate: ``eval "$(saunet --completion bash)"``."""


def script(shell: str) -> str:
    """Return what a shell evaluates to complete ``saunet``.

    Raises:
        ConfigError: for another shell.
    """
    return SCRIPTS[one_of("--completion", shell, SCRIPTS)]


def complete(line: str, tools: list[str], table: Table) -> list[str]:
    """Return what the last word of a command line can become.

    Args:
        line: The line up to the cursor, from the word ``saunet`` on.
        tools: All tools.
        table: All keys.
    """
    given = line.split(" ")[1:]
    word = given[-1] if given else ""
    if len(given) < 2:
        return [each for each in ("--help", "--version", *tools) if each.startswith(word)]
    tool = "train" if given[0] == "resume" else given[0]
    if tool not in table.tools:
        return []
    sign = word[: len(word) - len(word.lstrip("+~"))]
    key, equals, value = word.lstrip("+~").partition("=")
    choices = {**help_.defaults(tool), **words.choices(given[1:-1])}
    if equals:
        found = [f"{key}={each}" for each in _values(key, value, tool, table, choices)]
    else:
        found = list(_keys(key, tool, table, choices))
    return [f"{sign}{each}" for each in found]


def _keys(start: str, tool: str, table: Table, choices: dict[str, str]) -> Iterator[str]:
    """Yield keys, one level at a time: ``data.`` and then ``data.root=``."""
    found: set[str] = set()
    for group, key in help_.groups(table.tools[tool], table):
        found.add(f"{group}=")
        node = help_.chosen(group, choices, table)
        if node is not None:
            found.update(f"{key}.{each}" for each in _flat(node))
    found.update(_flat(table.tools[tool]))
    found.update(f"{each}=" for each in ("experiment", "loss", "sweep") if tool == "train")
    for each in sorted(found):
        if each.startswith(start):
            rest = each[len(start) :]
            inner, dot, _ = rest.partition(".")
            yield f"{start}{inner}." if dot else each


def _flat(node: schema.Node) -> Iterator[str]:
    for key in (*node.keys, *((words.PLUGINS,) if node.path is None else ())):
        if key.node is not None:
            yield from (f"{key.name}.{each}" for each in _flat(key.node))
        elif key.type not in ("component", "component?"):
            yield f"{key.name}="


def _values(key: str, start: str, tool: str, table: Table, choices: dict[str, str]) -> list[str]:
    names = help_.choices(key, table)
    found = words.known(key, tool, table)
    for each in () if names else found[:1]:
        names = [help_.written(choice) for choice in each.choices]
        names = names or (["true", "false"] if each.type.startswith("bool") else [])
        if not names and each.type.rstrip("?") in ("str", "any", "list[str]"):
            folder = Path(start if start.endswith("/") else Path(start).parent)
            files = sorted(folder.iterdir()) if folder.is_dir() else []
            names = [f"{file}/" if file.is_dir() else str(file) for file in files if not file.name.startswith(".")]
    return [name for name in names if name.startswith(start)]
