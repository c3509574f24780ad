"""Turn errors that the user can fix into one sentence."""

from __future__ import annotations

import re

from saunet.cli.table import HIDDEN, Table
from saunet.errors import SaunetError, suggest

_TYPES = {"Float": "float", "Integer": "int", "Boolean": "bool (true or false)"}
"""OmegaConf's words for what an annotation asks for."""


def sentence(error: BaseException, table: Table | None = None) -> str | None:
    """Return one sentence; None for a bug. The table has the allowed keys."""
    cause, kind = error.__cause__, type(error).__name__  # by name, to import nothing only for its errors
    text = f"{error}\n{cause or ''}"
    if isinstance(error, SaunetError):
        return str(error)
    if kind == "OutOfMemoryError":
        return (
            "the GPU has too little memory for this; lower the batch size (data.batch_size in training) or the image "
            "size"
        )
    if "Config group override must be a string or a list" in text:
        return "a config group cannot be null; choose logger=none, or set single keys of the group to null"
    spawned = re.search(r"^saunet\.errors\.\w+: (.*)", str(error), re.MULTILINE)
    if spawned:  # raised in another process, such as a sweep launcher's: only the text of its traceback arrives here
        return spawned[1]
    for each in (error, cause):
        if type(each).__name__ == "MisconfigurationException":  # Lightning's name for a user's error
            return _line(str(each))
    missing = re.search(r"\b(wandb|mlflow)\b", text) if isinstance(error, ModuleNotFoundError) else None
    if missing:
        return f"logger={missing[1]} needs a package that is not installed; run `pip install 'saunet[track]'`"
    if type(error).__module__.partition(".")[0] in ("hydra", "omegaconf"):
        return _of_hydra(str(getattr(error, "override", "")) if kind == "OverrideParseException" else "", text, table)
    if isinstance(error, OSError):
        return f"cannot use {error.filename or 'a file'}: {error.strerror or error}; check the path and its permissions"
    return None


def _of_hydra(unread: str, text: str, table: Table | None) -> str:
    if unread:
        key, _, value = unread.partition("=")
        return f"{unread} cannot be read; put the value in quotes: \"{key}='{value}'\""
    wanted = re.search(r"Could not find '([^']+)'", text)
    listed = re.search(r"Available options in '([^']+)':\n(.*?)(?=\n\S|\Z)", text, re.DOTALL)
    if wanted and listed:
        options = [option for option in listed[2].split() if option not in HIDDEN]
        name = wanted[1].rpartition("/")[2]
        return f"unknown {listed[1]} '{name}'{suggest(name, options) or ';'} available: {', '.join(options)}"
    if ambiguous := re.search(r"Ambiguous value for argument '([^=]+)=(.*)'", text):
        key, value = ambiguous.groups()
        sweep = f"{key}={value}: a comma means a sweep, one run for each value, and needs --multirun (-m)"
        kinds = {table.type(tool, key).rstrip("?") for tool in table.tools} if table else set()
        if "/" in key or kinds & {"int", "float", "bool"} or (table and key in table.groups):
            return sweep  # one number, or one choice
        return f"{sweep}; a list is written {key}=[{value}], and text with a comma in quotes: \"{key}='{value}'\""
    full_key = re.search(r"full_key: (\S+)", text)
    if unknown := re.search(r"Key '([\w-]+)' (?:is )?not in '(\w+)'", text):
        node = table.by_name(unknown[2]) if table else None
        allowed = [key.name for key in node.keys] if node else []
        key = full_key[1] if full_key else unknown[1]
        said = suggest(unknown[1], allowed).replace(f"'{unknown[1]}'", "")
        return f"unknown key '{key}'{said or ';'} allowed: {', '.join(allowed)}" if allowed else f"unknown key '{key}'"
    if there := re.search(r"Could not append to config\. An item is already at '([^']+)'", text):
        return f"+{there[1]}=... adds a key that exists already; leave out the plus sign: {there[1]}=..."
    typed = re.search(r"Value ('.*') of type '\w+' could not be converted to (\w+)", text)
    if typed and full_key:  # as the components say it
        return f"{full_key[1]} is {typed[1]}; it must be {_TYPES.get(typed[2], typed[2])}"
    wrong = re.search(r"Value '.*' of type .*|Cannot (?:assign|convert) .*|Invalid value .*", text)
    if wrong and full_key:
        return f"{full_key[1]}: {wrong[0][0].lower()}{wrong[0][1:]}"
    return _line(text)


def _line(text: str) -> str:
    return " ".join(text.split())
