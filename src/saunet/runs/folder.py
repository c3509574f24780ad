"""The record of a run in its folder: ``run.json``, what it was and how it ended, and the lock while it runs.

A run that is killed leaves ``running`` behind with its process number; every other end is written down.
"""

from __future__ import annotations

import math
import os
import platform
import socket
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal

from saunet import __version__
from saunet.errors import ConfigError, SaunetError
from saunet.io import plain
from saunet.io.atomic import process_lives, write_json

try:
    import fcntl
except ImportError:  # Windows: runs there are not locked
    fcntl = None  # type: ignore[assignment]

FILE = "run.json"
LOCK = ".lock"
PACKAGES = ("torch", "lightning", "torchmetrics", "numpy", "hydra-core", "kornia", "opencv-python-headless")
"""Libraries whose versions can change what a training computes."""
Status = Literal["finished", "running", "failed", "interrupted", "unfinished", "unknown"]
SIGN_OF_LIFE = 600.0
"""Seconds: a run on another machine that wrote nothing for so long does not run any more."""
LOST = "killed, out of memory, or the machine went down"
Describe = Callable[[Exception], "str | None"]
"""Says in one sentence what went wrong; None for a defect of the program."""


class Stopped(SystemExit):
    """A run that was asked to stop and did so in good order; the message says how to resume it."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(code)
        self.message = message

    def __str__(self) -> str:
        return self.message


class RunRecord:
    """``run.json``, written whole whenever something is known, by the first process of a run only.

    Args:
        folder: The run's folder.
        name: The run's name.
        known: What is known of it at its start, by key of the file.
    """

    def __init__(self, folder: str | Path, name: str, **known: Any) -> None:
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
            "samples": {},
            "choices": {},
            "overrides": [],
            "protocol": None,
            "config": {},
            "resumed": None,
            "health": {},
            "host": socket.gethostname(),
            "pid": os.getpid(),
            **_finite(known),
        }

    def start(self) -> None:
        """Write the file, in place of one that an earlier run in this folder left."""
        if first_process():
            write_json(self.path, self.content, ConfigError)

    def write(self, **changes: Any) -> None:
        """Change keys of the file; what other processes of the run wrote stays."""
        self.content = {**self.content, **read(self.path.parent), **_finite(changes)}
        self.start()

    def end(self, status: Status, error: str | None = None) -> None:
        """Say how the run ended."""
        self.write(status=status, error=error, ended=_now())


@contextmanager
def recording(
    folder: str | Path, name: str, describe: Describe = lambda error: None, **known: Any
) -> Iterator[RunRecord]:
    """Keep ``run.json`` while the block runs, however it ends; for ``known`` see `RunRecord`."""
    record = RunRecord(folder, name, **known)
    try:
        record.start()
        yield record
    except Exception as error:
        with suppress(SaunetError):  # on a full disk, the first error says more than the one raised here
            record.end("failed", _sentence(error, describe))
        raise
    except BaseException as error:  # Ctrl-C, or a requested stop
        record.end("interrupted", str(error) if isinstance(error, Stopped) else "interrupted")
        raise
    record.end("finished")


def record_failed_start(folder: str | Path, name: str, error: Exception, describe: Describe, **known: Any) -> None:
    """Write down why a job of a sweep did not start, unless its folder has a record already."""
    record = RunRecord(folder, name, **known)
    if not record.path.exists():
        with suppress(SaunetError):
            record.end("failed", _sentence(error, describe))


def _sentence(error: Exception, describe: Describe) -> str:
    sentence = str(error) if isinstance(error, SaunetError) else describe(error)
    return sentence or " ".join(f"{type(error).__name__}: {error}".split())[:500]


@contextmanager
def locked(folder: str | Path) -> Iterator[None]:
    """Make a run's folder and hold it, so that no second run writes there; the lock dies with its process.

    Of the processes of one run, the first one holds it.
    """
    path = Path(folder) / LOCK
    if fcntl is None or not first_process():
        yield
        return
    # Not flock(): loader processes would inherit that lock, and hold it for seconds after the run was killed.
    while True:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            file = path.open("a+")
        except OSError as reason:
            raise ConfigError(f"cannot write to {folder}: {reason.strerror or reason}; check the path") from reason
        try:
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError) as reason:
            file.close()
            other = read(folder)
            of = f" (process {other['pid']} on {other.get('host')})" if other.get("pid") else ""
            raise ConfigError(
                f"another run{of} is writing to {folder}; wait until it ends, or choose another folder"
            ) from reason
        except OSError:  # a file system without locks
            break
        with suppress(OSError):
            if os.fstat(file.fileno()).st_ino == path.stat().st_ino:
                break
        file.close()  # the run that held the lock has meanwhile removed the file
    try:
        yield
    finally:
        with suppress(OSError):
            path.unlink()
        file.close()


def read(folder: str | Path) -> dict[str, Any]:
    """Return the record of a run's folder; empty where there is none that can be read."""
    return read_mapping(Path(folder) / FILE)


def mark_lost(folder: str | Path, error: str = f"ended without a message: {LOST}") -> None:
    """Mark a run as failed that still claims to run though nobody runs it."""
    content = read(folder)
    if content.get("status") == "running":
        write_json(Path(folder) / FILE, {**content, "status": "failed", "error": error, "ended": _now()}, ConfigError)


def first_process() -> bool:
    """Return whether this is the only or the first process of a run, however it was started."""
    environment = os.environ
    if "RANK" in environment:  # torchrun
        return environment["RANK"] == "0"
    return all(environment.get(name, "0") == "0" for name in ("NODE_RANK", "LOCAL_RANK", "SLURM_PROCID"))


def versions() -> dict[str, str]:
    """Return the versions of Python, of saunet and of the libraries that can change what a training computes."""
    found = {"python": platform.python_version(), "saunet": __version__}
    for package in PACKAGES:
        with suppress(PackageNotFoundError):  # OpenCV comes in several packages, of which one is installed
            found[package] = version(package)
    return found


def git_state(file: str | Path = __file__) -> Mapping[str, Any] | None:
    """Return the commit that a file of the code belongs to, and whether tracked files were changed since.

    None where git does not track the file: a package installed below another project's folder does not take that
    project's commit for its own.
    """
    file = Path(file).resolve()

    def git(*arguments: str) -> str | None:
        command = ["git", "-C", str(file.parent), *arguments]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=False)
        except (OSError, subprocess.SubprocessError):
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    if git("ls-files", "--error-unmatch", str(file)) is None:
        return None
    commit, changes = git("rev-parse", "HEAD"), git("status", "--porcelain", "--untracked-files=no")
    return {"commit": commit, "dirty": bool(changes)} if commit else None


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


def began(folder: Path) -> bool:
    """Return whether a folder holds what a training writes besides its config."""
    return any((folder / name).exists() for name in (FILE, "csv", "checkpoints"))


def alive_elsewhere(folder: Path) -> bool:
    """Return whether another process is at work on a run."""
    record = read(folder)
    return record.get("pid") != os.getpid() and alive(folder, record)


def alive(folder: Path, record: Mapping[str, Any]) -> bool:
    if record.get("host") == socket.gethostname() and isinstance(record.get("pid"), int):
        return process_lives(record["pid"])
    newest = max((path.stat().st_mtime for path in folder.rglob("*") if path.is_file()), default=0.0)
    return time.time() - newest < SIGN_OF_LIFE


def read_file(path: Path) -> Any:
    """Return what a JSON or YAML file holds; None if it is missing, or a killed run left it half-written."""
    try:
        return (plain.read_json if path.suffix == ".json" else plain.read_yaml)(path)
    except (OSError, ValueError):
        return None


def read_mapping(path: Path) -> dict[str, Any]:
    """Return the mapping that a JSON or YAML file holds; an empty one where there is none."""
    content = read_file(path)
    return content if isinstance(content, dict) else {}
