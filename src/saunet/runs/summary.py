"""One training as it lies on disk: its config, how it ended, its curves, checkpoint and scores."""

from __future__ import annotations

import os
import re
import socket
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

from saunet.metrics.functional import ERROR_NAMES, RISING
from saunet.reporting.files import read_json, read_mapping, read_numbers, read_yaml

Status = Literal["finished", "running", "failed", "interrupted", "unfinished", "unknown"]
BROKEN: tuple[Status, ...] = ("failed", "interrupted", "unfinished")
"""How a run can end without having trained to its end."""
SUBJECTS = ("model", "predictions")
"""What ``saunet-evaluate`` calls what it scores: a checkpoint's network, or another system's files."""
SIGN_OF_LIFE = 600.0
"""Seconds: a run on another machine that wrote nothing for so long does not run any more."""


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
    """Photometric error after warping the neighbors, SAU-Net eqs. (8) to (10)."""
    unwarped: float
    """The same without warping."""
    explained: float
    """Share of pixels that warping brings closer."""
    fingerprint: str = ""
    """SHA-256 of the names of the images of all conditions; empty where it was not recorded."""
    how: str = ""
    """Settings that change the numbers, as in `Score`."""


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
    evaluations: tuple[Path, ...] = ()
    """Folders of the evaluations that the scores come from."""
    job: int | None = None
    """Its number in a sweep."""

    @property
    def seconds(self) -> float | None:
        """How long it took, by its own record."""
        try:
            ends = [datetime.fromisoformat(self.record[key]) for key in ("started", "ended")]
        except (KeyError, TypeError, ValueError):
            return None
        return (ends[1] - ends[0]).total_seconds()

    def component(self, slot: str) -> str:
        """Return the registered name of what fills ``model/encoder``, ``objective`` and so on; its class if unknown."""
        if slot in self.choices:
            return self.choices[slot]
        node: Any = self.config
        for key in slot.split("/"):
            node = node.get(key) if isinstance(node, Mapping) else None
        target = node.get("_target_", "") if isinstance(node, Mapping) else ""
        return str(target).rpartition(".")[2]


def read_run(folder: Path, checkpoint: str = "best", job: int | None = None) -> Run:
    """Read the folder of a training, whatever of it there is.

    Args:
        folder: The run's folder.
        checkpoint: Which of its checkpoints is wanted, ``best`` or ``last``; the other one where it is missing.
        job: Its number in a sweep.
    """
    record = read_json(folder / "run.json")
    record = record if isinstance(record, dict) else {}
    hydra = read_mapping(folder / ".hydra" / "hydra.yaml").get("hydra") or {}
    choices = record.get("choices") or (hydra.get("runtime") or {}).get("choices") or {}
    config = record.get("config") or read_mapping(folder / ".hydra" / "config.yaml")
    overrides = record.get("overrides") or read_yaml(folder / ".hydra" / "overrides.yaml") or []
    status, error = _state(folder, record)
    history = read_numbers(folder / "csv" / "metrics.csv")
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
    """Tell whether a folder holds what a training writes besides its config."""
    return any((folder / name).exists() for name in ("run.json", "csv", "checkpoints"))


def home(folder: Path) -> Path:
    """Return where the run is whose config Hydra left in a folder: elsewhere where ``output_dir`` led it."""
    if began(folder):
        return folder
    config = read_mapping(folder / ".hydra" / "config.yaml")
    hydra = read_mapping(folder / ".hydra" / "hydra.yaml").get("hydra") or {}

    def looked_up(reference: re.Match[str]) -> str:
        if reference[0] == "${hydra:runtime.output_dir}":
            return str(folder)  # which may have been moved since
        node: Any = hydra if reference[1] else config
        for key in reference[2].split("."):
            node = node.get(key) if isinstance(node, Mapping) else None
        return reference[0] if node is None else str(node)

    given = re.sub(r"\$\{(hydra:)?([\w.]+)\}", looked_up, str(config.get("output_dir") or folder))
    return Path((hydra.get("runtime") or {}).get("cwd") or "", given).resolve()


def split_overrides(overrides: Sequence[str]) -> dict[str, str]:
    """Return what ``key=value`` overrides set, without Hydra's leading ``+`` and ``~``."""
    pairs = [str(text).lstrip("+~").partition("=") for text in overrides]
    return {key: value for key, _, value in pairs}


def _state(folder: Path, record: Mapping[str, Any]) -> tuple[Status, str | None]:
    """Return how a run ended; one that claims to run but shows no sign of life is unfinished."""
    status, error = record.get("status"), record.get("error")
    if status in ("finished", "failed", "interrupted"):
        return status, str(error) if error else None
    if status != "running":
        return "unknown", None
    if _alive(folder, record):
        return "running", None
    return "unfinished", "it was never ended: killed, out of memory, or the machine went down"


def _alive(folder: Path, record: Mapping[str, Any]) -> bool:
    if record.get("host") == socket.gethostname() and isinstance(record.get("pid"), int):
        try:
            os.kill(record["pid"], 0)
        except ProcessLookupError:
            return False
        except OSError:  # it exists and belongs to someone else
            return True
        return True
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
