"""A run's folder: ``run.json`` (what it was, how it ended), its config, curves and checkpoints; written here, and read.

A run that is killed leaves ``running`` behind with its process number; every other end is written down.
"""

from __future__ import annotations

import csv
import math
import os
import platform
import re
import socket
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal

from saunet import __version__
from saunet.errors import ConfigError, SaunetError
from saunet.io import plain
from saunet.io.atomic import process_lives, write_json
from saunet.metrics.functional import ERROR_NAMES, RISING

try:
    import fcntl
except ImportError:  # Windows: runs there are not locked
    fcntl = None  # type: ignore[assignment]

FILE = "run.json"
LOCK = ".lock"
PACKAGES = ("torch", "lightning", "torchmetrics", "numpy", "hydra-core", "kornia", "opencv-python-headless")
"""Libraries whose versions can change what a training computes."""
Status = Literal["finished", "running", "failed", "interrupted", "unfinished", "unknown"]
SUBJECTS = ("model", "predictions")
"""What an evaluation calls what it scores: a checkpoint's network, or another system's files."""
SIGN_OF_LIFE = 600.0
"""Seconds: a run on another machine that wrote nothing for so long does not run any more."""
_LOST = "killed, out of memory, or the machine went down"
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
        with suppress(SaunetError):  # on a full disk, what filled it is the news, not that this cannot be noted
            record.end("failed", _sentence(error, describe))
        raise
    except BaseException as error:  # Ctrl-C, or a stop that was asked for
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
    # A record lock, not flock(): loader processes would inherit that one, and outlive a killed run by seconds.
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
        file.close()  # the run that held it removed the file in between
    try:
        yield
    finally:
        with suppress(OSError):
            path.unlink()
        file.close()


def read(folder: str | Path) -> dict[str, Any]:
    """Return the record of a run's folder; empty where there is none that can be read."""
    return read_mapping(Path(folder) / FILE)


def mark_lost(folder: str | Path, error: str = f"ended without a word: {_LOST}") -> None:
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
        with suppress(PackageNotFoundError):  # OpenCV, for one, comes in several packages
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


@dataclass(frozen=True, slots=True)
class Score:
    """The seven errors of one predictor on one set of images."""

    predictor: str
    protocol: str
    data: str
    """What it was scored on, such as ``kitti, test split``."""
    images: int
    errors: tuple[float, ...]
    """In the order of `saunet.metrics.functional.ERROR_NAMES`."""
    validation: bool = False
    """Taken from the training's own validation, not from an evaluation."""
    fingerprint: str = ""
    """SHA-256 of the names of the images; empty where it was not recorded."""
    how: str = ""
    """Settings that change the numbers, such as ``flip=true, scale.method=speed``; empty for none."""

    @property
    def trivial(self) -> bool:
        """It is of a predictor that looks at no image, which stands beside what was scored."""
        return self.predictor not in SUBJECTS


@dataclass(frozen=True, slots=True)
class Explained:
    """How well a run's depth explains neighboring frames, where no depth is known: one condition of such data."""

    protocol: str
    data: str
    condition: str
    images: int
    warped: float
    """Photometric error after warping the neighbors, SAU-Net eqs. (8) to (10); ``unwarped``: the same without."""
    unwarped: float
    explained: float
    """Fraction of pixels that warping brings closer."""
    fingerprint: str = ""
    """Of the images of all conditions, as in `Score`; so is ``how``."""
    how: str = ""


@dataclass(frozen=True, slots=True)
class Detail:
    """What an evaluation of a run measured beside the errors of whole images: a line of a table."""

    kind: Literal["buckets", "shapes"]
    protocol: str
    data: str
    cells: tuple[str | float | int | None, ...]
    """Of ``buckets``: where, pixels, Abs Rel, RMSE and δ1; of ``shapes``: numbers as in ``metrics.json``."""
    fingerprint: str = ""
    """Of the images, as in `Score`; so is ``how``."""
    how: str = ""


@dataclass(frozen=True)
class Run:
    """One training; what it lacks is empty."""

    path: Path
    status: Status = "unknown"
    error: str | None = None
    """One sentence about how it broke off."""
    name: str = ""
    config: Mapping[str, Any] = field(default_factory=dict)
    choices: Mapping[str, str] = field(default_factory=dict)
    """What was chosen for each config group, such as ``{"model/encoder": "resnet18"}``."""
    overrides: Mapping[str, str] = field(default_factory=dict)
    """What the command line said."""
    record: Mapping[str, Any] = field(default_factory=dict)
    """Its ``run.json``."""
    history: Sequence[Mapping[str, float]] = ()
    """Rows of its CSV log."""
    checkpoint: Path | None = None
    scores: tuple[Score, ...] = ()
    explained: tuple[Explained, ...] = ()
    details: tuple[Detail, ...] = ()
    evaluations: tuple[Path, ...] = ()
    """Folders of the evaluations that the scores come from."""
    job: int | None = None
    """Its number in a sweep."""

    @property
    def called(self) -> str:
        """What a person calls it: its folder's name, unless that is a date or a job's number; else its experiment's."""
        unnamed = self.job is not None or re.match(r"\d{4}-\d\d-\d\d_", self.path.name)
        return self.path.name if self.config and not unnamed else self.name

    @property
    def seconds(self) -> float | None:
        """How long it took, by its own record."""
        try:
            began, ended = (datetime.fromisoformat(self.record[key]) for key in ("started", "ended"))
        except (KeyError, TypeError, ValueError):
            return None
        seconds = (ended - began).total_seconds()
        return seconds if seconds >= 0 else None  # the clock was set back

    def component(self, slot: str) -> str:
        """Return the registered name of what fills ``model/encoder``, ``objective`` and so on; its class if unknown."""
        target = _at(self.config, [*slot.split("/"), "_target_"], "")
        return self.choices.get(slot) or str(target).rpartition(".")[2]


def read_run(folder: Path, checkpoint: str = "best", job: int | None = None) -> Run:
    """Read whatever there is in the folder of a training.

    Of its checkpoints ``best`` or ``last`` is wanted, and the other one taken where it is missing.
    """
    record, (config, hydra) = read(folder), read_hydra(folder)
    choices = record.get("choices") or _at(hydra, ["runtime", "choices"], {})
    config = record.get("config") or config
    overrides = record.get("overrides") or read_file(folder / ".hydra" / "overrides.yaml") or []
    status, error = _state(folder, record)
    history = _read_numbers(folder / "csv" / "metrics.csv")
    score = _validation(history, config, choices, record)
    files = [folder / "checkpoints" / f"{name}.ckpt" for name in (checkpoint, "best", "last")]
    return Run(
        path=folder,
        status=status,
        error=error,
        name=str(record.get("name") or config.get("name") or folder.name),
        config=config,
        choices={key: str(value) for key, value in choices.items() if value and not key.startswith("hydra/")},
        overrides=split_overrides(overrides),
        record=record,
        history=history,
        checkpoint=next((file for file in files if file.is_file()), None),
        scores=(score,) if score else (),
        job=job,
    )


def began(folder: Path) -> bool:
    """Return whether a folder holds what a training writes besides its config."""
    return any((folder / name).exists() for name in (FILE, "csv", "checkpoints"))


def home(folder: Path) -> Path:
    """Return where the run is whose config Hydra left in a folder: elsewhere where ``output_dir`` led it."""
    if began(folder):
        return folder
    config, hydra = read_hydra(folder)

    def looked_up(reference: re.Match[str]) -> str:
        if reference[0] == "${hydra:runtime.output_dir}":
            return str(folder)  # which may have been moved since
        return str(_at(hydra if reference[1] else config, reference[2].split("."), reference[0]))

    given = re.sub(r"\$\{(hydra:)?([\w.]+)\}", looked_up, str(config.get("output_dir") or folder))
    return Path(_at(hydra, ["runtime", "cwd"], ""), given).resolve()


def split_overrides(overrides: Sequence[str]) -> dict[str, str]:
    """Return what ``key=value`` overrides set, without Hydra's leading ``+`` and ``~``."""
    pairs = [str(text).lstrip("+~").partition("=") for text in overrides]
    return {key: value for key, _, value in pairs}


def _at(node: Any, keys: Sequence[str], default: Any) -> Any:
    """Return what stands in nested mappings under these keys; the default where there is nothing."""
    for key in keys:
        node = node.get(key) if isinstance(node, Mapping) else None
    return default if node is None else node


def _state(folder: Path, record: Mapping[str, Any]) -> tuple[Status, str | None]:
    """Return how a run ended; one that claims to run but shows no sign of life is unfinished."""
    status, error = record.get("status"), record.get("error")
    if status in ("finished", "failed", "interrupted"):
        return status, str(error) if error else None
    if status != "running":
        return "unknown", None
    if _alive(folder, record):
        return "running", None
    return "unfinished", f"it did not end normally: {_LOST}"


def alive_elsewhere(folder: Path) -> bool:
    """Return whether another process is at work on a run."""
    record = read(folder)
    return record.get("pid") != os.getpid() and _alive(folder, record)


def _alive(folder: Path, record: Mapping[str, Any]) -> bool:
    if record.get("host") == socket.gethostname() and isinstance(record.get("pid"), int):
        return process_lives(record["pid"])
    newest = max((path.stat().st_mtime for path in folder.rglob("*") if path.is_file()), default=0.0)
    return time.time() - newest < SIGN_OF_LIFE


def _validation(
    history: Sequence[Mapping[str, float]],
    config: Mapping[str, Any],
    choices: Mapping[str, Any],
    record: Mapping[str, Any],
) -> Score | None:
    """Return the errors of the epoch that the run itself would call its best, if any was measured."""
    rows = [row for row in history if all(f"val/{name}" in row for name in ERROR_NAMES)]
    if not rows:
        return None
    monitor = str(config.get("monitor"))
    monitor = monitor if all(monitor in row for row in rows) else "val/abs_rel"
    best = (max if monitor.removeprefix("val/") in RISING else min)(rows, key=lambda row: row[monitor])
    data = f"{choices.get('data') or 'its data'}, validation split"
    errors = tuple(best[f"val/{name}"] for name in ERROR_NAMES)
    protocol = str(record.get("protocol") or config.get("protocol") or "of the data")
    images, fingerprint = int(best.get("val/images", 0)), (record.get("splits") or {}).get("val", "")
    return Score("model", protocol, data, images, errors, validation=True, fingerprint=fingerprint)


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


def read_hydra(folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the config that Hydra left in a folder, and what it wrote about itself."""
    config, hydra = (read_mapping(folder / ".hydra" / f"{name}.yaml") for name in ("config", "hydra"))
    return config, hydra.get("hydra") or {}


def _read_numbers(path: Path) -> list[dict[str, float]]:
    """Return the rows of a CSV file, each with the cells that hold a finite number."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            return [_numbers(row) for row in csv.DictReader(file)]
    except (OSError, csv.Error, UnicodeDecodeError):
        return []


def _numbers(row: Mapping[str | Any, str | Any]) -> dict[str, float]:
    found = {}
    for key, text in row.items():
        with suppress(TypeError, ValueError):  # an empty cell, or a line that was cut short
            found[key] = float(text)
    return {key: value for key, value in found.items() if math.isfinite(value)}
