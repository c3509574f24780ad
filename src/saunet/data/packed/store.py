"""The files of a packed data set, local or remote: shards that are read in parts, and a description.

A shard is an uncompressed tar archive, so any tool can open it. Training reads byte ranges of it: every order of
samples costs the same, and nothing unused is downloaded.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, NamedTuple

import fsspec

from saunet.errors import DataError, UnreadableError
from saunet.io.atomic import write_bytes

DESCRIPTION, FORMAT = "pack.json", 1


class Part(NamedTuple):
    """Location of bytes: number of the shard, first byte and length."""

    shard: int
    start: int
    length: int


def shard_name(number: int) -> str:
    return f"shard_{number:06d}.tar"


class Store:
    """Reads whole files and parts of shards below a folder or an address such as ``s3://bucket/name``.

    ``starts`` has the position of each shard in the pack. The first ``keep`` bytes of the pack are kept in the folder
    ``cache`` once they were read. With shuffled epochs that serves far more reads than replacing the oldest bytes
    would, and processes need not coordinate.
    """

    def __init__(self, root: str, cache: Path | None = None, keep: int = 0) -> None:
        self.root, self.cache, self.keep = root.rstrip("/"), cache, keep
        self.starts: list[int] = []
        self._opened: tuple[int, Any, str] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_opened": None}

    def file(self, name: str) -> bytes:
        return self._read(name, None, None)

    def part(self, part: Part) -> bytes:
        name = shard_name(part.shard)
        kept = None
        if self.cache is not None and self.starts[part.shard] + part.start + part.length <= self.keep:
            kept = self.cache / name / str(part.start)
            if kept.is_file() and kept.stat().st_size == part.length:
                return kept.read_bytes()
        data = self._read(name, part.start, part.start + part.length)
        if len(data) != part.length:
            raise UnreadableError(
                f"{self.root}/{name} ends before byte {part.start + part.length}; copy the packed data again"
            )
        if kept is not None:
            write_bytes(kept, data)
        return data

    def _read(self, name: str, start: int | None, end: int | None) -> bytes:
        if self._opened is None or self._opened[0] != os.getpid():  # connections do not survive a fork
            try:
                system, base = fsspec.core.url_to_fs(self.root, skip_instance_cache=True)
            except (ImportError, ValueError) as reason:
                raise DataError(
                    f"{self.root} cannot be read ({reason}); for s3:// run pip install 'saunet[stream]'"
                ) from reason
            self._opened = os.getpid(), system, base
        _, system, base = self._opened
        try:
            return bytes(system.cat_file(f"{base}/{name}", start=start, end=end))
        except FileNotFoundError as reason:
            raise DataError(
                f"{self.root}/{name} does not exist; set data.root to a complete folder written by saunet prepare pack"
            ) from reason
        except Exception as reason:  # each kind of store has its own errors
            raise UnreadableError(
                f"cannot read {self.root}/{name} ({type(reason).__name__}: {reason}); check the connection and "
                "permissions"
            ) from reason
