"""Tidying up after a run that was killed in the middle of a file."""

from __future__ import annotations

from pathlib import Path


def remove_partial(folder: Path) -> None:
    """Remove the temporary files of writers that did not live to rename them (see `saunet.io.atomic.replacing`).

    Only one run may write into a folder at a time.
    """
    if folder.is_dir():
        for path in folder.glob(".*.partial*"):
            path.unlink(missing_ok=True)
