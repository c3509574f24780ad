"""Plain data from untrusted files, with limits set beforehand; no code in a file is ever run.

Anything wrong with the content becomes one sentence: size, depth, repeated keys, endless numbers, aliases that grow
exponentially, damaged headers. System errors (no such file, no permission) stay an `OSError`.
"""

from __future__ import annotations

import ast
import contextlib
import errno
import io
import json
import math
import pickle
import re
import struct
import tokenize
import zipfile
import zlib
from collections import OrderedDict
from collections.abc import Hashable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from saunet.errors import CheckpointError, SaunetError, UnreadableError

JSON_BYTES = 256 << 20
"""Largest JSON file; a manifest of a million frames has 10 MB."""
YAML_BYTES = 128 << 10
"""Largest YAML file; reading one of that size takes about two seconds."""
ARRAY_BYTES = 8 << 30
"""Largest array."""
DEPTH = 64
"""Lists and mappings inside each other."""
DIGITS = 30
"""Digits of an integer."""
ALIASES = 16
"""References to one place of a YAML file from another; some dozens can stand for more values than fit in memory."""
_EXCERPT = 160
_PART = 1 << 20
"""Characters of a long list that are read at a time; no object of it may have twice as many."""


class _LimitError(ValueError): ...


def read_bytes(path: str | Path, most: int = JSON_BYTES, error: type[SaunetError] = UnreadableError) -> bytes:
    """Return a file's content if it has at most so many bytes."""
    with Path(path).open("rb") as stream:
        data = stream.read(most + 1)
    if len(data) > most:
        raise error(f"{path} has more than {most:,} bytes, the most allowed for such a file; check what it is")
    return data


def read_text(path: str | Path, most: int = JSON_BYTES, error: type[SaunetError] = UnreadableError) -> str:
    """Return a file's text (UTF-8) if it has at most so many bytes."""
    try:
        return read_bytes(path, most, error).decode("utf-8-sig")
    except UnicodeDecodeError as reason:
        raise error(f"{path} is not text in UTF-8 ({_excerpt(reason)}); save it as UTF-8") from reason


def read_json(path: str | Path, error: type[SaunetError] = UnreadableError) -> Any:
    """Return what a JSON file holds; what cannot be read is a sentence of class ``error``, here and in the others."""
    return parse_json(read_text(path, error=error), str(path), error)


def parse_json(text: str | bytes, source: str, error: type[SaunetError] = UnreadableError) -> Any:
    """Return what JSON text holds; ``source`` names it in messages."""
    try:
        plain = json.loads(
            text, object_pairs_hook=_unique, parse_int=_integer, parse_float=_number, parse_constant=_constant
        )
        _check_depth(plain)
    except RecursionError as reason:
        raise error(f"{source} cannot be read as JSON (more than {DEPTH} levels of nesting)") from reason
    except ValueError as reason:
        raise error(f"{source} cannot be read as JSON ({_excerpt(reason)})") from reason
    return plain


def different_settings(recorded: Any, settings: Mapping[str, object], names: Mapping[str, str] | None = None) -> str:
    """Name the settings that differ from a record in JSON, such as ``different settings (camera, colormap)``.

    Args:
        recorded: The record; anything but a mapping has none of the settings.
        settings: The settings of today.
        names: What to call a setting, if not by its key.

    Returns:
        The end of a sentence that begins with "made with"; empty if none differs.
    """
    known, now = recorded if isinstance(recorded, dict) else {}, json.loads(json.dumps(dict(settings)))
    changed = [(names or {}).get(key, key) for key, value in now.items() if known.get(key) != value]
    return f"different settings ({', '.join(changed)})" if changed else ""


def iterate_json(path: str | Path, error: type[SaunetError] = UnreadableError) -> Iterator[Any]:
    """Yield the items of a JSON file that is one list of objects, of any length: a part is in memory at a time."""
    decoder, text, at, opened = json.JSONDecoder(parse_int=_integer, parse_constant=_constant), "", 0, False
    try:
        with Path(path).open(encoding="utf-8-sig") as stream:
            while more := stream.read(_PART):
                text, at = text[at:] + more, 0
                while at < len(text):
                    if text[at] in ", \t\r\n":
                        at += 1
                    elif opened and text[at] == "]":
                        return
                    elif text[at] != ("{" if opened else "["):
                        raise _LimitError(f"a list of objects is expected, and '{text[at]}' found")
                    elif not opened:
                        opened, at = True, at + 1
                    else:
                        try:
                            item, at = decoder.raw_decode(text, at)
                        except json.JSONDecodeError:
                            if len(text) - at > 2 * _PART:
                                raise
                            break  # the rest of the object follows
                        yield item
        raise _LimitError("its end is missing")
    except (RecursionError, ValueError) as reason:
        raise error(f"{path} cannot be read as a JSON list ({_excerpt(reason)})") from reason


def read_yaml(path: str | Path, error: type[SaunetError] = UnreadableError) -> Any:
    return parse_yaml(read_text(path, YAML_BYTES, error), str(path), error)


def parse_yaml(text: str, source: str, error: type[SaunetError] = UnreadableError) -> Any:
    """Return what YAML text holds, OpenCV's matrices as mappings; ``source`` names it in messages."""
    try:
        if len(text) > YAML_BYTES:
            raise _LimitError(f"more than {YAML_BYTES:,} characters")
        return yaml.load(text, _Loader)
    # A broken tag or date, a list as a key and so on raise whatever exception PyYAML runs into first.
    except (yaml.YAMLError, ValueError, TypeError, ArithmeticError, LookupError, AttributeError) as reason:
        if isinstance(reason, SaunetError):
            raise
        raise error(f"{source} cannot be read as YAML ({_excerpt(reason)})") from reason


def read_array(path: str | Path, *, mapped: bool = False, error: type[SaunetError] = UnreadableError) -> NDArray[Any]:
    """Return the numbers in a ``.npy`` file, of any shape; ``mapped``, they stay in it until they are looked at."""
    path = Path(path)
    try:
        with path.open("rb") as stream:
            _check_header(stream, path.stat().st_size)
        found: NDArray[Any] = np.load(path, mmap_mode="r" if mapped else None, allow_pickle=False)
    except _DAMAGED as reason:
        raise error(f"{path} cannot be read as a .npy file of numbers ({_excerpt(reason)})") from reason
    return found


def read_arrays(
    path: str | Path | io.BufferedIOBase, error: type[SaunetError] = UnreadableError
) -> dict[str, NDArray[Any]]:
    """Return the arrays in a ``.npz`` file by name."""
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(each.file_size for each in archive.infolist()) > ARRAY_BYTES:
                raise _LimitError(f"more than {ARRAY_BYTES:,} bytes")
            found = {}
            for each in archive.infolist():
                if each.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                    raise _LimitError(f"compression {each.compress_type}")
                data = archive.read(each)
                _check_header(io.BytesIO(data), len(data))
                found[each.filename.removesuffix(".npy")] = np.load(io.BytesIO(data), allow_pickle=False)
            return found
    # A damaged offset raises OSError (EINVAL), and an encrypted file RuntimeError.
    except (*_DAMAGED, zipfile.BadZipFile, zlib.error, RuntimeError, OSError) as reason:
        if isinstance(reason, OSError) and reason.errno != errno.EINVAL:
            raise
        raise error(f"{path} cannot be read as a .npz file of numbers ({_excerpt(reason)})") from reason


class StandIn:
    """Takes the place of an object in a file whose class is not ours to run: its state as data, and nothing else."""

    def __init__(self, *_: object) -> None:
        self.state: Any = {}

    def __new__(cls, *_: object) -> StandIn:
        made = super().__new__(cls)
        made.state = {}
        return made

    def __setstate__(self, state: object) -> None:
        self.state = state


_MAPPINGS = ("AttributeDict", "CfgNode", "ConfigDict", "EasyDict", "defaultdict")
"""Names of classes that are pickled as dictionaries."""
_STAND_INS = 100
"""Classes that a file may name."""


def read_torch(path: Path, what: str, *, stand_ins: bool = False) -> Any:
    """Return what ``torch.save`` wrote, on the CPU: plain containers, numbers, text and tensors.

    With ``stand_ins``, objects of any class become a `StandIn` or a dictionary, and calls in the file make one too:
    other systems pickle their settings beside the weights. Nothing of theirs is imported or run either way.
    """
    import torch

    known: dict[str, type] = {}
    while True:
        try:
            allowed: list[Any] = [(kind, name) for name, kind in known.items()]
            with torch.serialization.safe_globals(allowed) if allowed else contextlib.nullcontext():
                return torch.load(path, map_location="cpu", weights_only=True)
        except MemoryError:
            raise
        except pickle.UnpicklingError as reason:
            named = re.search(r"GLOBAL (\S+) was not an allowed global", str(reason))
            if stand_ins and named and len(known) < _STAND_INS:
                name = named[1] if "." in named[1] else f"builtins.{named[1]}"
                if name not in known:
                    known[name] = OrderedDict if name.rpartition(".")[2] in _MAPPINGS else StandIn
                    continue
            if any(mark in str(reason) for mark in ("GLOBAL", "Unsupported class", "Trying to")):
                raise CheckpointError(
                    f"{path} contains pickled objects, which could run code when read, so it is refused; save plain "
                    "containers and tensors only, as saunet train does"
                ) from reason
            raise CheckpointError(f"{path} is not {what}, or is damaged; copy it again") from reason
        except OSError as reason:
            raise CheckpointError(f"cannot read {path}: {reason.strerror or reason}") from reason
        except Exception as reason:  # the unpickler trusts what it reads: a broken file can raise anything
            raise CheckpointError(f"{path} is damaged or truncated and cannot be read; copy it again") from reason


_DAMAGED = (
    *(ValueError, TypeError, ArithmeticError, LookupError, AttributeError, MemoryError, RecursionError, EOFError),
    *(SyntaxError, tokenize.TokenError, struct.error),
)
"""What NumPy and Python's parser raise for damaged headers."""


def _check_header(stream: io.BufferedIOBase, size: int) -> None:
    """Check that an array of numbers follows, and that it is as long as the file, before memory is asked for."""
    major, minor = np.lib.format.read_magic(stream)
    if major not in (1, 2, 3):
        raise _LimitError(f"version {major}.{minor} of the format")
    length = int.from_bytes(stream.read(2 if major == 1 else 4), "little")
    if length > 10_000:
        raise _LimitError(f"a header of {length} bytes")
    header = ast.literal_eval(stream.read(length).decode("latin1").strip())
    shape, dtype = header["shape"], np.dtype(header["descr"])
    if dtype.kind not in "fiub":
        raise _LimitError(f"it holds {dtype}, not numbers")
    if not all(isinstance(side, int) and side >= 0 for side in shape):
        raise _LimitError(f"its shape is {_excerpt(shape)}")
    wanted, found = math.prod(shape) * dtype.itemsize, size - stream.tell()
    if wanted > ARRAY_BYTES or wanted > found:
        raise _LimitError(f"its header promises {wanted:,} bytes and {found:,} follow")


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader, with limits, that refuses a key given twice."""

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self._depth = self._aliases = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            self._aliases += 1
            if self._aliases > ALIASES:
                raise _LimitError(f"more than {ALIASES} aliases; write the values out")
        self._depth += 1
        if self._depth > DEPTH:
            raise _LimitError(f"more than {DEPTH} levels of nesting")
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[Any] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.tag != "tag:yaml.org,2002:merge":
                if key.value in seen:
                    raise _LimitError(
                        f"'{_excerpt(key.value)}' is given twice, again in line {key.start_mark.line + 1}"
                    )
                seen.add(key.value)
        return dict(super().construct_mapping(node, deep))

    def construct_yaml_int(self, node: Any) -> int:
        if len(str(node.value)) > DIGITS:
            raise _LimitError(f"an integer of {len(str(node.value))} digits")
        return int(super().construct_yaml_int(node))


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_yaml_int)
_Loader.add_multi_constructor(
    "tag:yaml.org,2002:opencv-", lambda loader, _, node: loader.construct_mapping(node, deep=True)
)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for place, key in enumerate(keys) if key in keys[:place])
        raise _LimitError(f"'{_excerpt(twice)}' is given twice")
    return found


def _integer(text: str) -> int:
    if len(text) > DIGITS:
        raise _LimitError(f"an integer of {len(text)} digits")
    return int(text)


def _number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise _LimitError(f"the number {_excerpt(text)} is out of range")
    return value


def _constant(text: str) -> float:
    raise _LimitError(f"{text} is no number in JSON")


def _check_depth(plain: Any) -> None:
    """Check the nesting, level by level, without recursion."""
    level = [plain] if isinstance(plain, dict | list) else []
    for _ in range(DEPTH + 1):
        inside = [each.values() if isinstance(each, dict) else each for each in level]
        level = [child for each in inside for child in each if isinstance(child, dict | list)]
        if not level:
            return
    raise _LimitError(f"more than {DEPTH} levels of nesting")


def _excerpt(reason: object) -> str:
    """Return the beginning of a reason on one line."""
    text = " ".join(str(reason)[: 4 * _EXCERPT].split())
    return text if len(text) <= _EXCERPT else f"{text[:_EXCERPT]}..."
