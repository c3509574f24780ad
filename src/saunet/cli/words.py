"""From the words of a command line to Hydra's overrides.

Hydra's grammar turns ``2024_05_01`` into a number and fails on ``=`` and brackets in a path, so values of keys that
hold text or a list are first quoted or put into a list.
"""

from __future__ import annotations

import argparse
import fnmatch
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from saunet import schema
from saunet.cli.table import PLUGINS, Table, Tool, config_dir
from saunet.errors import ELSEWHERE, ConfigError, suggest

_OVERRIDE = re.compile(r"(?P<sign>\+{0,2}|~)(?P<key>[\w@/.:][\w@/.:-]*)=(?P<value>.*)", re.DOTALL)
_GLOB = re.compile(r"""['"]?glob\(['"]?(?P<pattern>[^,()'"]*/[^,()'"]*)['"]?\)['"]?""")
_FUNCTION = re.compile(
    r"(choice|range|interval|glob|sort|shuffle|tag|extend_list|int|float|str|bool|json_str)\(.*\)", re.DOTALL
)
_PLAIN = re.compile(r"[A-Za-z/.~-][\w/.~-]*|\d+[A-Za-z/-][\w/.~-]*")
_NOT_TEXT = re.compile(r"true|false|yes|no|on|off|null|none|inf|nan|~|\d+e\d+", re.IGNORECASE)


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise ConfigError(f"{message}; see --help")


def split(words: Sequence[str]) -> tuple[argparse.Namespace, list[str]]:
    """Return Hydra's options and the other words."""
    parser = _Parser(add_help=False, allow_abbrev=False)
    for names in (("-h", "--help"), ("-m", "--multirun"), ("--resolve",), ("-r", "--run")):
        parser.add_argument(*names, action="store_true")
    for names in (("-p", "--package"), ("-cd", "--config-dir"), ("-cn", "--config-name")):
        parser.add_argument(*names)
    parser.add_argument("-c", "--cfg", choices=["job", "hydra", "all"])
    parser.add_argument("-i", "--info", nargs="?", const="all")
    flags, rest = parser.parse_known_args(words)
    for word, following in zip(rest, [*rest[1:], "VALUE"], strict=False):
        if word.startswith("-") and not _OVERRIDE.fullmatch(word) and not re.fullmatch(r"-[\d.]+", word):
            key = word.lstrip("-").replace("-", "_")
            said = key if "=" in key else f"{key}={following}"
            raise ConfigError(f"there is no option {word}; settings are written without dashes: {said}")
    return flags, rest


def choices(overrides: Sequence[str]) -> dict[str, str]:
    """Return what overrides choose: ``{"data": "kitti"}`` for ``data=kitti``."""
    found = (_OVERRIDE.fullmatch(word) for word in overrides)
    return {each["key"]: each["value"] for each in found if each and "." not in each["key"]}


def is_plugins(word: str) -> bool:
    return word.lstrip("+").startswith(f"{PLUGINS.name}=")


def named_plugins(words: Sequence[str]) -> list[str]:
    """Return the plugins on a command line; they must be imported before the rest is parsed."""
    given = [word.partition("=")[2] for word in words if is_plugins(word)]
    lists = (value[1:-1] if value.startswith("[") and value.endswith("]") else value for value in given)
    return [item.strip().strip("'\"") for each in lists for item in _parts(each)]


def read_words(
    words: Sequence[str], tool: Tool, table: Table, conf: Path | None = None
) -> tuple[argparse.Namespace, list[str]]:
    """Return Hydra's options and, in its grammar, the overrides among the words after ``saunet TOOL``.

    ``conf`` is the folder of YAML files for ``experiment=glob(table3/*)``, if not the usual one.
    """
    flags, rest = split(words)
    sweeping = flags.multirun or any(word.startswith(("sweep=", "hydra.mode=MULTIRUN")) for word in rest)
    own = flags.config_dir is None and flags.config_name is None
    return flags, _Reader(tool, table, sweeping, own, conf or config_dir()).overrides(rest)


@dataclass(frozen=True)
class _Reader:
    tool: Tool
    table: Table
    sweeping: bool
    own: bool
    """Whether all YAML files are ours, so that a key they do not have is a mistake, reported before Hydra starts."""
    conf: Path

    def overrides(self, words: Sequence[str]) -> list[str]:
        made, plain = [], []
        for word in words:
            found = _OVERRIDE.fullmatch(word)
            if found is None and word.startswith("~"):
                made.append(word)
            elif found is None or (self.tool.positional and not self._is_key(found["key"]) and _is_place(word)):
                plain.append(word)
            else:
                key = self.tool.aliases.get(found["key"], found["key"])
                made += self._override(found["sign"], key, found["value"])
        return [*made, *self._positional(plain, words)]

    def _is_key(self, key: str) -> bool:
        first = re.split(r"[./@]", key)[0]
        return first == "hydra" or bool(self.table.known(self.tool.name, first)) or (self.conf / first).is_dir()

    def _short(self, own: schema.Node) -> list[str]:
        return [*self.tool.aliases, *(["size"] if own.key("data") and not own.key("size") else [])]

    def _below(self, own: schema.Node) -> Iterator[str]:
        """Yield the keys below those of the tool: nested options, and the components that it takes."""
        for key in own.keys:
            yield from (f"{key.name}.{each.name}" for each in (key.node.keys if key.node else ()))
        for group, nodes in self.table.groups.items():
            if own.key(group.replace("/", ".")):
                yield from (f"{group.replace('/', '.')}.{key.name}" for node in nodes.values() for key in node.keys)

    def _positional(self, plain: Sequence[str], words: Sequence[str]) -> list[str]:
        if not plain:
            return []
        key = self.tool.positional
        if not key or (len(plain) > 1 and not key.endswith("*")):
            model = key == "input" and self.table.tools[self.tool.name].key("checkpoint") is not None
            hint = f"; if it is the model, write checkpoint={plain[-1]}" if key and model else ""
            hint += "; for several images give a folder or a pattern" if key and model else ""
            raise ConfigError(
                f"'{plain[-1]}' is not KEY=VALUE{hint}; see `saunet {self.tool.name} --help` for the keys"
            )
        name = key.rstrip("*")
        if any(word.startswith(f"{name}=") for word in words):
            raise ConfigError(f"{name} is given twice, as {name}=... and as {plain[0]}; leave out one")
        quoted = ",".join(map(_quoted, plain))
        return [f"{name}=[{quoted}]" if key.endswith("*") else f"{name}={quoted}"]

    def _override(self, sign: str, key: str, value: str) -> list[str]:
        own = self.table.tools[self.tool.name]
        if glob := _GLOB.fullmatch(value):
            return [f"{sign}{key}={','.join(self._matching(key, glob['pattern']))}"]
        if self.own and not sign and key != "size" and not self._is_key(key):
            raise unknown(key, [each.name for each in own.keys], [*self._short(own), *self._below(own)])
        size = re.fullmatch(r"(\d+)x(\d+)", value) if key == "size" and own.key("size") is None else None
        if size:  # of images, height x width
            return [f"data.height={size[1]}", f"data.width={size[2]}"]
        if key == "size" and own.key("size") is None and own.key("data") and not sign:
            raise ConfigError(f"size is '{value}'; it needs height x width, such as size=192x640")
        if key == "data" and own.key("data") and self._is_path(value):
            return [f"{sign}data=video", f"data.root={self._meant(value, 'str')}"]
        group = key.replace(".", "/")
        if "." in key and value in self.table.groups.get(group, {}):
            raise ConfigError(f"{key}={value} sets a value; choose a component with a slash: {group}={value}")
        return [f"{sign}{key}={self._meant(value, self.table.type(self.tool.name, key).rstrip('?'))}"]

    def _is_path(self, value: str) -> bool:
        """Return whether ``data=`` names a video or a folder instead of a data module."""
        return value not in self.table.choices("data") and "${" not in value and ("/" in value or Path(value).exists())

    def _meant(self, value: str, kind: str) -> str:
        """Return a value as Hydra reads it back unchanged, for a key of this type."""
        if value in ("", "null", "???") or "${" in value or _FUNCTION.fullmatch(value):
            return value
        parts = _parts(value) if self.sweeping else [value]
        if kind == "str":
            return ",".join(map(_quoted, parts))
        return ",".join(_list(each, kind) for each in parts) if kind.startswith("list[") else value

    def _matching(self, group: str, pattern: str) -> list[str]:
        """Return the names below a group that a pattern matches; Hydra's own glob sees the files of one folder only."""
        folder = self.conf / group
        names = sorted(path.relative_to(folder).with_suffix("").as_posix() for path in folder.rglob("*.yaml"))
        matching = fnmatch.filter(names, pattern)
        if not matching:
            raise ConfigError(f"{group}=glob({pattern}) matches none of: {', '.join(names) or 'no files'}")
        return matching


def _is_place(word: str) -> bool:
    """Return whether a word with ``=`` in it is an address or a file."""
    return "://" in word.partition("=")[0] or Path(word).exists()


def _list(value: str, kind: str) -> str:
    if value.startswith("[") and value.endswith("]"):
        items = _parts(value[1:-1])
    else:
        items = [value] if Path(value).exists() else _parts(value)
    return f"[{','.join(_quoted(item.strip()) if kind.startswith('list[str') else item for item in items)}]"


def hydra_value(value: object) -> str:
    """Return a plain value, or a list of them, as Hydra's grammar has it."""
    if isinstance(value, list | tuple):
        return f"[{','.join(map(hydra_value, value))}]"
    if isinstance(value, str):
        return _quoted(value) if value else "''"
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def _quoted(text: str) -> str:
    """Return text in quotes if Hydra would otherwise misread it."""
    if len(text) > 1 and text[0] in "'\"" and text[-1] == text[0]:
        return text
    if (_PLAIN.fullmatch(text) and not _NOT_TEXT.fullmatch(text)) or "${" in text:
        return text
    escaped = re.sub(r"(\\*)'", lambda quote: quote[1] * 2 + "\\'", text)
    trailing = len(escaped) - len(escaped.rstrip("\\"))
    return f"'{escaped}{chr(92) * trailing}'"


def _parts(text: str) -> list[str]:
    """Split at the commas outside of quotes and brackets."""
    parts, depth, quote = [""], 0, ""
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
            parts.append("")
            continue
        parts[-1] += char
    return parts if text else []


def unknown(key: str, known: Sequence[str], further: Sequence[str] = ()) -> ConfigError:
    """Return the error for an unknown key, with the allowed keys; ``further`` are short and nested ones."""
    names = (key, ELSEWHERE.get(key))
    same = next((each for each in further if each.rpartition(".")[2] in names), None)
    hint = f"; did you mean '{same}'?" if same else suggest(key, known)
    return ConfigError(f"unknown key '{key}'{hint or ';'} allowed: {', '.join(known)}")
