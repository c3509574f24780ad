"""Files that are written whole or not at all: a temporary neighbor takes the name only once it is complete."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator
from pathlib import Path

from saunet.errors import DataError, SaunetError


@contextlib.contextmanager
def replacing(path: str | Path, error: type[SaunetError] = DataError) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` that replaces it when the block ends well and vanishes when it does not.

    The temporary name keeps the suffix, for writers that choose a format by it. Missing parent folders are made. Nobody
    ever reads half a file, even after Ctrl-C, a full disk or a power cut (data reach the disk before the name does).

    Args:
        path: The file to write.
        error: What to raise when the system refuses.

    Yields:
        The path to write to, in the same folder.

    Raises:
        SaunetError: of class ``error``, naming the file and the system's reason, if it cannot be written.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem[:100]}.{os.getpid()}.partial{path.suffix}")
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
            f"cannot write {path}: {reason.strerror or reason}; check the folder, its rights and its space"
        ) from reason
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def check_folder(folder: str | Path, error: type[SaunetError] = DataError) -> None:
    """Check that files can be written to a folder, which need not exist, before anything long is started.

    Args:
        folder: The folder; nothing is made.
        error: What to raise otherwise.

    Raises:
        SaunetError: of class ``error``, if a file is in the way or the rights are missing.
    """
    place = Path(folder).absolute()
    while not os.path.lexists(place):
        place = place.parent
    if not place.is_dir():
        raise error(f"cannot write to {folder}: {place} is not a folder; choose another one")
    if not os.access(place, os.W_OK | os.X_OK):
        raise error(f"cannot write to {folder}: no right to write to {place}; change the rights, or choose another one")


def write_bytes(path: str | Path, data: bytes, error: type[SaunetError] = DataError) -> None:
    """Write ``data`` to ``path``, whole or not at all.

    Raises:
        SaunetError: of class ``error``, if the system refuses.
    """
    with replacing(path, error) as temporary:
        temporary.write_bytes(data)


def write_json(path: str | Path, content: object, error: type[SaunetError] = DataError, indent: int | None = 2) -> None:
    """Write plain data to ``path`` as JSON in UTF-8, whole or not at all.

    Args:
        path: The file to write.
        content: Dictionaries, lists, text, numbers, booleans and None.
        error: What to raise when it cannot be written.
        indent: Spaces a level; None puts everything on one line.

    Raises:
        SaunetError: of class ``error``, if the system refuses, or a number is NaN or infinite, which JSON cannot say.
    """
    try:
        text = json.dumps(content, indent=indent, ensure_ascii=False, allow_nan=False)
    except ValueError as reason:
        raise error(f"cannot write {path}: {reason}; JSON has finite numbers only") from reason
    # Names of files may hold bytes that are not UTF-8, surrogates in Python: these become JSON's own \u escapes.
    write_bytes(path, f"{text}\n".encode(errors="backslashreplace"), error)
