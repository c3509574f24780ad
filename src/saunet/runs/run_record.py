"""``run.json``: what a run was and how it ended, in its folder from the first second on.

A run that is killed leaves ``running`` behind with its process number; every other end is written down.
"""

from __future__ import annotations

import json
import math
import os
import platform
import socket
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal

from saunet import __version__
from saunet.errors import ConfigError, SaunetError
from saunet.io.atomic import write_json

FILE = "run.json"
PACKAGES = ("torch", "lightning", "torchmetrics", "numpy", "hydra-core", "kornia", "opencv-python-headless")
"""Libraries whose versions can change what a training computes."""
Status = Literal["running", "finished", "failed", "interrupted"]


class Stopped(SystemExit):
    """A run that was asked to stop and did so in good order; the message says how to go on.

    Args:
        message: What the user is told.
        code: The exit status.
    """

    def __init__(self, message: str, code: int) -> None:
        super().__init__(code)
        self.message = message

    def __str__(self) -> str:
        return self.message


class RunRecord:
    """The record of one run, written whole whenever something is known.

    Only the first process of a run writes.

    Args:
        folder: The run's folder.
        name: The run's name.
    """

    def __init__(self, folder: str | Path, name: str) -> None:
        self.path = Path(folder) / FILE
        self.content: dict[str, Any] = {
            "status": "running",
            "started": _now(),
            "ended": None,
            "error": None,
            "name": name,
            "versions": versions(),
            "git": git_state(),
            "splits": {},
            "choices": {},
            "overrides": [],
            "protocol": None,
            "config": {},
            "resumed": None,
            "host": socket.gethostname(),
            "pid": os.getpid(),
        }

    def start(self) -> None:
        """Write the file, in place of one that an earlier run in this folder left.

        Raises:
            ConfigError: if the folder cannot be written to.
        """
        if first_process():
            _write(self.path.parent, self.content)

    def write(self, **changes: Any) -> None:
        """Change keys of the file; what other processes of the run wrote stays.

        Raises:
            ConfigError: if the folder cannot be written to.
        """
        self.content = {**self.content, **(read(self.path.parent) or {}), **changes}
        if first_process():
            _write(self.path.parent, self.content)

    def describe(self, config: Mapping[str, Any], choices: Mapping[str, str | None], overrides: Sequence[str]) -> None:
        """Write down what the run is, so that its folder says so wherever ``output_dir`` led it.

        Args:
            config: The whole configuration, resolved.
            choices: What was chosen for each config group, such as ``{"data": "kitti"}``.
            overrides: What the command line said.

        Raises:
            ConfigError: if the folder cannot be written to.
        """
        self.write(config=_finite(config), choices=dict(choices), overrides=list(overrides))

    def end(self, status: Status, error: str | None = None) -> None:
        """Say how the run ended."""
        self.write(status=status, error=error, ended=_now())


@contextmanager
def recording(
    folder: str | Path,
    name: str,
    describe: Callable[[Exception], str | None] = lambda error: None,
    check: Callable[[], None] = lambda: None,
) -> Iterator[RunRecord]:
    """Keep ``run.json`` while the block runs, however it ends.

    Args:
        folder: The run's folder.
        name: The run's name.
        describe: Says in one sentence what went wrong, or None for a defect of the program.
        check: Raises if the run cannot begin; an earlier run's record in the folder then stays as it is.
    """
    record = RunRecord(folder, name)
    of_earlier_run = record.path.is_file()
    try:
        check()
        of_earlier_run = False
        record.start()
        yield record
    except Exception as error:
        if of_earlier_run:
            raise
        sentence = str(error) if isinstance(error, SaunetError) else describe(error)
        with suppress(SaunetError):  # on a full disk, what filled it is the news, not that this cannot be noted
            record.end("failed", sentence or " ".join(f"{type(error).__name__}: {error}".split())[:500])
        raise
    except BaseException as error:  # Ctrl-C, or a stop that was asked for
        if of_earlier_run:
            raise
        record.end("interrupted", str(error) if isinstance(error, Stopped) else "interrupted")
        raise
    record.end("finished")


def read(folder: str | Path) -> dict[str, Any] | None:
    """Return the record of a run's folder; None where there is none that can be read."""
    try:
        content = json.loads((Path(folder) / FILE).read_bytes())
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) else None


def mark_lost(
    folder: str | Path, error: str = "ended without a word: killed, out of memory, or the machine went down"
) -> bool:
    """Mark a run as failed that still claims to run though nobody runs it; return whether it did.

    Args:
        folder: The run's folder.
        error: What is known of the reason.
    """
    content = read(folder)
    if content is None or content.get("status") != "running":
        return False
    _write(Path(folder), {**content, "status": "failed", "error": error, "ended": _now()})
    return True


def first_process() -> bool:
    """Tell whether this is the only or the first process of a run, however it was started."""
    environment = os.environ
    if "RANK" in environment:  # torchrun
        return environment["RANK"] == "0"
    return all(environment.get(name, "0") == "0" for name in ("NODE_RANK", "LOCAL_RANK", "SLURM_PROCID"))


def versions() -> dict[str, str]:
    """Return the versions of Python, of saunet and of the libraries that can change what a training computes."""
    found = {"python": platform.python_version(), "saunet": __version__}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:  # OpenCV, for one, comes in several packages
            continue
    return found


def git_state(file: str | Path = __file__) -> Mapping[str, Any] | None:
    """Return the commit that the code belongs to, and whether it was changed since; None outside a checkout.

    Args:
        file: A file of the code; it counts only if git tracks it, so a package installed below another project's
            folder does not take that project's commit for its own.
    """

    def git(*arguments: str) -> str | None:
        command = ["git", "-C", str(Path(file).resolve().parent), *arguments]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=False)
        except (OSError, subprocess.SubprocessError):
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    if git("ls-files", "--error-unmatch", str(Path(file).resolve())) is None:
        return None
    commit, changes = git("rev-parse", "HEAD"), git("status", "--porcelain", "--untracked-files=no")
    return {"commit": commit, "dirty": bool(changes)} if commit else None


def _write(folder: Path, content: Mapping[str, Any]) -> None:
    write_json(folder / FILE, content, ConfigError)


def _finite(value: Any) -> Any:
    """Return plain data with numbers that JSON does not know, such as a limit of infinity, as YAML writes them."""
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return ".nan" if math.isnan(value) else f"{'-' if value < 0 else ''}.inf"
    return value if isinstance(value, str | int | float | None) else str(value)


def _now() -> str:
    return datetime.now(timezone.utc).isoformat(timespec="seconds")
