"""Files written completely or not at all: a temporary file beside it takes the name only once complete."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import platform
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import TypeVar

from saunet.errors import DataError, SaunetError

_HOST = hashlib.sha256(platform.node().encode()).hexdigest()[:6]
_PARTIAL = re.compile(rf"\..*\.{_HOST}\.(\d+)\.partial(\.\w+)?")


def partial_name(name: str, suffix: str = "") -> str:
    """Return this process's name for the file or folder ``name`` while it is incomplete."""
    return f".{name}.{_HOST}.{os.getpid()}.partial{suffix}"


def remove_partial_files(folder: str | Path, pattern: str = "**/.*.partial*") -> list[Path]:
    """Remove and return incomplete files left in a folder by killed processes of this machine."""
    found = ((path, _PARTIAL.fullmatch(path.name)) for path in Path(folder).glob(pattern))
    gone = [path for path, name in found if name and not process_lives(int(name[1]))]
    for path in gone:
        with contextlib.suppress(OSError):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    return gone


def process_lives(pid: int) -> bool:
    """Return whether a process of this machine exists."""
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # it exists but belongs to another user
        return True
    return True


@contextlib.contextmanager
def replacing(path: str | Path, error: type[SaunetError] = DataError) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` that replaces it if the block succeeds and is removed if it fails.

    The temporary name keeps the suffix, for writers that choose a format by it. Missing parent folders are created.
    Nobody ever reads half a file, even after Ctrl-C, a full disk or a power failure (data reach the disk before the
    name).
    """
    path = Path(path)
    temporary = path.with_name(partial_name(path.stem[:100], path.suffix))
    try:
        if path.is_dir():
            raise error(f"cannot write {path}: a folder has this name; choose another name")
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        with temporary.open("rb") as stream:
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    except OSError as reason:
        raise error(
            f"cannot write {path}: {reason.strerror or reason}; check the folder, its permissions and free space"
        ) from reason
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


S = TypeVar("S", bound="Session")


class Session:
    """An object with a ``with`` block, which runs at the ``yield`` of its `session`: where files are completed."""

    def session(self) -> Iterator[None]:
        yield

    def __enter__(self: S) -> S:
        self._block = contextlib.contextmanager(self.session)()
        self._block.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._block.__exit__(kind, error, trace)


def check_folder(folder: str | Path, error: type[SaunetError] = DataError) -> Path:
    """Return a folder, which need not exist, after checking that files can be written to it.

    Incomplete files of killed processes directly in it are removed.
    """
    place = Path(folder).absolute()
    while not os.path.lexists(place):
        place = place.parent
    if not place.is_dir():
        raise error(f"cannot write to {folder}: {place} is not a folder; choose another one")
    if not os.access(place, os.W_OK | os.X_OK):
        raise error(
            f"cannot write to {folder}: no permission to write to {place}; change the permissions, or choose another "
            "one"
        )
    remove_partial_files(folder, ".*.partial*")
    return Path(folder)


def write_bytes(path: str | Path, data: bytes, error: type[SaunetError] = DataError) -> None:
    """Write ``data`` to ``path``, completely or not at all."""
    with replacing(path, error) as temporary:
        temporary.write_bytes(data)


def write_json(path: str | Path, content: object, error: type[SaunetError] = DataError, indent: int | None = 2) -> None:
    """Write plain data to ``path`` as JSON in UTF-8, completely or not at all."""
    try:
        text = json.dumps(content, indent=indent, ensure_ascii=False, allow_nan=False)
    except ValueError as reason:
        raise error(f"cannot write {path}: {reason}; JSON has only finite numbers") from reason
    # File names may contain bytes that are not UTF-8, surrogates in Python; these become \u escapes in JSON.
    write_bytes(path, f"{text}\n".encode(errors="backslashreplace"), error)
