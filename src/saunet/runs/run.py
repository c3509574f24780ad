"""A training as its folder tells it: config, curves, how it ended, checkpoint, scores."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

from saunet.metrics.functional import ERROR_NAMES, RISING
from saunet.runs.folder import LOST, Status, alive, began, read, read_file, read_mapping

SUBJECTS = ("model", "predictions")
"""What an evaluation calls what it scores: a checkpoint's network, or another system's files."""


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
    """Its number in a sweep that was read as a whole."""
    swept: bool = False
    """It is a job of a sweep, even if it was read by itself."""

    @property
    def called(self) -> str:
        """What a person calls it: its folder's name, unless that is a date or a job's number; else its experiment's."""
        unnamed = self.swept or re.match(r"\d{4}-\d\d-\d\d_", self.path.name)
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
        swept=job is not None or hydra.get("mode") == "MULTIRUN",
    )


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
    if alive(folder, record):
        return "running", None
    return "unfinished", f"it did not end normally: {LOST}"


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
