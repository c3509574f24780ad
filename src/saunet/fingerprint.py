"""Telling sets of images apart by their names."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable


def fingerprint(names: Iterable[str]) -> str:
    """Return the SHA-256 of names sorted bytewise, joined by newlines, with a final one."""
    # Names of files may hold bytes that are not UTF-8, surrogates in Python.
    lines = sorted(name.encode(errors="surrogateescape") for name in names)
    return hashlib.sha256(b"\n".join([*lines, b""])).hexdigest()
