"""Files that appear whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from saunet.checks import DataError


@contextmanager
def atomic(path: Path) -> Iterator[TextIO]:
    """Open a text file that takes its place at ``path`` only when the block ends without an error.

    Args:
        path: Where the file goes; its folder is created.

    Yields:
        The open file, UTF-8 with newlines as written.

    Raises:
        DataError: if the place cannot be written to.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}.part")  # the same folder, so that the rename is atomic
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with part.open("w", encoding="utf-8", newline="") as file:
                yield file
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        reason = error.strerror or str(error)
        raise DataError(f"cannot write '{path}': {reason}; choose a folder that you may write to") from error
