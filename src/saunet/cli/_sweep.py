"""Sweeps: each job has its folder, one failed job costs no other, and at the end every failure is named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from saunet.cli._runs import planned_jobs
from saunet.errors import ConfigError
from saunet.runs.run_record import FILE, mark_lost, read

UNKNOWN = "overrides unknown"
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


def summary(folder: Path) -> tuple[str, bool]:
    """Say how the jobs of a sweep ended, one line for each that did not finish; jobs that vanished are marked failed.

    Jobs that never started count too, where it is known which were to run.

    Args:
        folder: The sweep's folder, with one ``run.json`` in each job's.

    Returns:
        The text, and whether there were jobs and all of them finished.
    """
    jobs = {path.parent: path for path in sorted(folder.glob(f"**/{FILE}"), key=_in_order)}
    lines, finished = [], 0
    for job in jobs:
        mark_lost(job)
        content = read(job) or {}
        if content.get("status") == "finished":
            finished += 1
        else:
            reason = content.get("error") or "its record cannot be read"
            lines.append(f"  {job.relative_to(folder)} ({_overrides(job)}) {content.get('status', 'failed')}: {reason}")
    started = [_overrides(job) for job in jobs]
    planned = [", ".join(job) for job in planned_jobs(folder) or []]
    waiting = [each for each in planned if each not in started] if UNKNOWN not in started else []
    lines += [f"  ({each}) not started" for each in waiting]
    count = len(jobs) + len(waiting)
    head = f"sweep: {finished} of {count} jobs finished; results: {folder}"
    return "\n".join([head, *lines]), 0 < finished == count


def _in_order(path: Path) -> tuple[int, str]:
    name = path.parent.name
    return (int(name) if name.isdecimal() else -1, str(path))


def _overrides(job: Path) -> str:
    path = job / ".hydra" / "overrides.yaml"
    return ", ".join(str(each) for each in OmegaConf.load(path)) if path.is_file() else UNKNOWN
