"""The words of a command line, made into overrides that Hydra reads as they were meant.

Hydra's grammar turns ``2024_05_01`` into a number and stumbles over ``=`` and brackets in a path. Where the table says
that a key holds text or a list, the words after ``=`` are quoted or put into a list first.
"""

from __future__ import annotations

import argparse
import fnmatch
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from saunet import schema
from saunet.cli.table import Table
from saunet.errors import ConfigError, suggest

_OVERRIDE = re.compile(r"(?P<sign>\+{0,2}|~)(?P<key>[\w@/.:][\w@/.:-]*)=(?P<value>.*)", re.DOTALL)
_GLOB = re.compile(r"""['"]?glob\(['"]?(?P<pattern>[^,()'"]*/[^,()'"]*)['"]?\)['"]?""")
_FUNCTIONS = "choice|range|interval|glob|sort|shuffle|tag|extend_list|int|float|str|bool|json_str"
_FUNCTION = re.compile(rf"({_FUNCTIONS})\(.*\)", re.DOTALL)
_PLAIN = re.compile(r"[A-Za-z/.~-][\w/.~-]*|\d+[A-Za-z/-][\w/.~-]*")
PLUGINS = schema.Key(
    "plugins", "list[str]", [], "Your own modules or .py files, imported first; they may register components."
)
"""The key that every tool has beside those of its options."""
_WORDS = ("true", "false", "yes", "no", "on", "off", "null", "none", "inf", "nan", "~")


@dataclass(frozen=True)
class Line:
    """What a command line says.

    Args:
        overrides: In Hydra's grammar.
        flags: Hydra's own options.
    """

    overrides: tuple[str, ...]
    flags: argparse.Namespace

    @property
    def again(self) -> list[str]:
        """The words with which another process does the same."""
        options = {"--config-dir": self.flags.config_dir, "--config-name": self.flags.config_name}
        return [*self.overrides, *(f"{name}={value}" for name, value in options.items() if value)]


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise ConfigError(f"{message}; see --help")


def split(words: Sequence[str]) -> tuple[argparse.Namespace, list[str]]:
    """Return Hydra's options and the other words.

    Raises:
        ConfigError: for an option that does not exist.
    """
    parser = _Parser(add_help=False, allow_abbrev=False)
    parser.add_argument("-h", "--help", action="store_true")
    parser.add_argument("-m", "--multirun", action="store_true")
    parser.add_argument("-c", "--cfg", choices=["job", "hydra", "all"])
    parser.add_argument("--resolve", action="store_true")
    parser.add_argument("-p", "--package")
    parser.add_argument("-i", "--info", nargs="?", const="all")
    parser.add_argument("-cd", "--config-dir")
    parser.add_argument("-cn", "--config-name")
    parser.add_argument("-r", "--run", action="store_true")
    flags, rest = parser.parse_known_args(words)
    for word in rest:
        if word.startswith("-") and not _OVERRIDE.fullmatch(word) and not re.fullmatch(r"-[\d.]+", word):
            position = rest.index(word)
            value = next(iter(rest[position + 1 : position + 2]), "VALUE")
            key = word.lstrip("-").replace("-", "_")
            said = key if "=" in key else f"{key}={value}"
            raise ConfigError(f"there is no option {word}; settings are written without dashes: {said}")
    return flags, rest


def overrides(
    words: Sequence[str],
    tool: str,
    table: Table,
    positional: str | None = None,
    aliases: dict[str, str] | None = None,
    conf: Path | None = None,
) -> Line:
    """Read the words after ``saunet TOOL``.

    Args:
        words: As the shell gave them.
        tool: The tool.
        table: Types of all keys.
        positional: The key that plain words stand for; a trailing ``*`` takes several.
        aliases: Short form -> key.
        conf: The folder of the YAML files, for ``experiment=glob(table3/*)``.

    Raises:
        ConfigError: for an option, or a plain word, that the tool has no use for.
    """
    flags, rest = split(words)
    sweeping = flags.multirun or any(word.startswith(("sweep=", "hydra.mode=MULTIRUN")) for word in rest)
    made, plain = [], []
    for word in rest:
        found = _OVERRIDE.fullmatch(word)
        if found is None and word.startswith("~"):
            made.append(word)
        elif found is None or (positional and not _is_key(found["key"], tool, table) and Path(word).exists()):
            plain.append(word)
        else:
            key = (aliases or {}).get(found["key"], found["key"])
            made += _override(found["sign"], key, found["value"], tool, table, sweeping, conf)
    made += _positional(plain, tool, positional, rest)
    return Line(tuple(made), flags)


def choices(overrides: Sequence[str]) -> dict[str, str]:
    """Return what overrides choose: ``{"data": "kitti"}`` for ``data=kitti``."""
    found = (_OVERRIDE.fullmatch(word) for word in overrides)
    return {each["key"]: each["value"] for each in found if each and "." not in each["key"]}


def named(words: Sequence[str]) -> list[str]:
    """Return the plugins that a command line names, which have to be imported before the rest is understood."""
    given = [word.partition("=")[2] for word in words if word.lstrip("+").startswith(f"{PLUGINS.name}=")]
    return [name for value in given for name in _items(value)]


def _positional(plain: Sequence[str], tool: str, key: str | None, words: Sequence[str]) -> list[str]:
    if not plain:
        return []
    if key is None or (len(plain) > 1 and not key.endswith("*")):
        raise ConfigError(f"'{plain[-1]}' is not KEY=VALUE; see `saunet {tool} --help` for the keys")
    name = key.rstrip("*")
    if any(word.startswith(f"{name}=") for word in words):
        raise ConfigError(f"{name} is given twice, as {name}=... and as {plain[0]}; leave out one")
    quoted = [_quoted(word) for word in plain]
    return [f"{name}=[{','.join(quoted)}]" if key.endswith("*") else f"{name}={quoted[0]}"]


def _override(sign: str, key: str, value: str, tool: str, table: Table, sweeping: bool, conf: Path | None) -> list[str]:
    glob = _GLOB.fullmatch(value)
    if glob and conf is not None:
        return [f"{sign}{key}={','.join(_matching(key, glob['pattern'], conf))}"]
    if key == "size":  # of images, height x width
        size = re.fullmatch(r"(\d+)x(\d+)", value)
        if size and table.tools[tool].key("size") is None:
            return [f"data.height={size[1]}", f"data.width={size[2]}"]
    group = key.replace(".", "/")
    if "." in key and value in table.group(group):
        raise ConfigError(f"{key}={value} sets a value; choose a component with a slash: {group}={value}")
    return [f"{sign}{key}={_meant(value, type_of(key, tool, table), sweeping)}"]


def type_of(key: str, tool: str, table: Table) -> str:
    """Return the type of a key as `saunet.schema.Key.type`; ``any`` for one that is not known."""
    found = {each.type for each in known(key, tool, table)}
    return found.pop() if len(found) == 1 else "any"


def _is_key(key: str, tool: str, table: Table) -> bool:
    return key in table.groups() or bool(known(key.split(".")[0], tool, table)) or key.startswith("hydra")


def known(key: str, tool: str, table: Table) -> list[schema.Key]:
    """Return what a key can be: of the tool's options, or of any component that has it."""
    own = table.tools[tool].key(key)
    if own is not None:
        return [own]
    if key == "plugins":
        return [PLUGINS]
    found = []
    for group, nodes in table.groups().items():
        prefix = group.replace("/", ".") + "."
        if key.startswith(prefix):
            found += [each for node in nodes.values() if (each := node.key(key[len(prefix) :])) is not None]
    return found


def _meant(value: str, kind: str, sweeping: bool) -> str:
    """Return a value as Hydra reads it back unchanged, for a key of this type."""
    kind = kind.rstrip("?")
    if value in ("", "null", "???") or "${" in value or _FUNCTION.fullmatch(value):
        return value
    if kind == "str":
        return ",".join(map(_quoted, _parts(value))) if sweeping else _quoted(value)
    if kind.startswith("list["):
        if sweeping:
            return ",".join(_list(each, kind) for each in _parts(value))
        return _list(value, kind)
    return value


def _list(value: str, kind: str) -> str:
    if value.startswith("[") and value.endswith("]"):
        items = _parts(value[1:-1])
    else:
        items = [value] if Path(value).exists() else _parts(value)
    text = kind.startswith("list[str")
    return f"[{','.join(_quoted(item.strip()) if text else item for item in items)}]"


def _items(value: str) -> list[str]:
    inner = value[1:-1] if value.startswith("[") and value.endswith("]") else value
    return [item.strip().strip("'\"") for item in _parts(inner)]


def _quoted(text: str) -> str:
    """Return text in quotes, where Hydra would read it as something else without."""
    if len(text) > 1 and text[0] in "'\"" and text[-1] == text[0]:
        return text
    plain = _PLAIN.fullmatch(text) and text.lower() not in _WORDS and not re.fullmatch(r"\d+e\d+", text, re.I)
    if plain or "${" in text:
        return text
    escaped = re.sub(r"(\\*)'", lambda quote: quote[1] * 2 + "\\'", text)
    trailing = len(escaped) - len(escaped.rstrip("\\"))
    return f"'{escaped}{chr(92) * trailing}'"


def _parts(text: str) -> list[str]:
    """Split at the commas outside of quotes and brackets."""
    parts, depth, quote, start = [], 0, "", 0
    for index, char in enumerate(text):
        if quote:
            quote = "" if char == quote and text[index - 1] != "\\" else quote
        elif char in "'\"":
            quote = char
        elif char in "[{(":
            depth += 1
        elif char in "]})":
            depth -= 1
        elif char == "," and depth == 0:
            parts.append(text[start:index])
            start = index + 1
    return [*parts, text[start:]] if text else []


def _matching(group: str, pattern: str, conf: Path) -> list[str]:
    """Return the names below a group that a pattern matches; Hydra's own glob sees the files of one folder only."""
    files = conf.glob(f"{group}/**/*.yaml")
    names = sorted(path.relative_to(conf / group).with_suffix("").as_posix() for path in files)
    matching = fnmatch.filter(names, pattern)
    if not matching:
        raise ConfigError(f"{group}=glob({pattern}) matches none of: {', '.join(names) or 'no files'}")
    return matching


def nearest(key: str, known: Sequence[str]) -> str:
    """Say that a key is unknown, with the nearest one and all."""
    return f"unknown key '{key}'{suggest(key, known) or ';'} allowed: {', '.join(known)}"
