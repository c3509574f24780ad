"""Sweeps: each job has its folder, one failed job costs no other, and at the end every failure is named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from saunet.errors import ConfigError

_folders: list[Path] = []


class NoteFolder(Callback):
    """Note where a sweep puts its jobs; they may run in other processes."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Note the folder before the first job starts."""
        _folders[:] = [Path(str(config.hydra.sweep.dir)).resolve()]


def swept_folder() -> Path | None:
    """Return the folder of the sweep that this process started, if it did, and forget it."""
    return _folders.pop() if _folders else None


def check_folder(output_dir: str, job: str) -> None:
    """Check that a job of a sweep writes into its own folder: one named for all would hold the last job alone.

    Args:
        output_dir: Where the job would write.
        job: The folder that the sweep gave to the job.

    Raises:
        ConfigError: if it would write anywhere else.
    """
    given, own = Path(output_dir).resolve(), Path(job).resolve()
    if own != given and own not in given.parents:
        raise ConfigError(
            f"output_dir is '{output_dir}' and the jobs of a sweep must not share a folder; "
            f"leave it out and set hydra.sweep.dir={output_dir}, below which each job gets its own"
        )
