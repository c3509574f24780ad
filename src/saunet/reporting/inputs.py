"""Inputs from the command line: runs, sweeps, checkpoints, evaluations, benchmarks, or folders of them."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from saunet.errors import CheckpointError, DataError
from saunet.evaluation.files import image_size
from saunet.io.plain import read_torch
from saunet.metrics.functional import ERROR_NAMES
from saunet.runs.folder import Status, began, read_mapping
from saunet.runs.run import Detail, Explained, Run, Score, home, read_hydra, read_run, split_overrides
from saunet.runs.sweep import read_plan
from saunet.weights.locate import is_shipped, locate, shipped

_KEPT = {"lr": "initial_lr", "weight_decay": "weight_decay"}
"""Settings of a recipe that are stored in an optimizer's state -> their names there."""


DETAILS: Mapping[Literal["buckets", "shapes"], tuple[str, ...]] = {
    "buckets": ("bucket", "pixels", "abs_rel", "rmse", "a1"),
    "shapes": ("edge_accuracy", "edge_completeness", "f_score", "precision", "recall"),
}
"""Details of an evaluation that a report shows."""


@dataclass(frozen=True)
class Sweep:
    """The jobs of one multirun folder, in order, including those that left nothing behind."""

    name: str
    runs: tuple[Run, ...]


@dataclass(frozen=True)
class Inputs:
    """All inputs of a report."""

    runs: tuple[Run, ...]
    """Single runs; those of sweeps are in ``sweeps``."""
    sweeps: tuple[Sweep, ...]
    benchmarks: tuple[Path, ...]

    @property
    def all_runs(self) -> tuple[Run, ...]:
        """Every run, single ones first."""
        return (*self.runs, *(run for sweep in self.sweeps for run in sweep.runs))


def collect(paths: Sequence[str | Path], checkpoint: str = "best", *, strangers: bool = True) -> Inputs:
    """Read everything at the given paths."""
    if not paths:
        raise DataError("no run given; add folders of runs or sweeps, or checkpoints: saunet report outputs/train/...")
    runs: dict[Path, Run] = {}
    sweeps: dict[Path, Sweep] = {}
    evaluations: dict[Path, Evaluation] = {}
    benchmarks: dict[Path, None] = {}
    order: dict[Path, int] = {}
    for path in map(Path, paths):
        found = [(kind, place.resolve()) for kind, place in _find(path)]
        if not found:
            raise DataError(f"no run, sweep, checkpoint, evaluation or benchmark in {path}; check the path")
        for _, place in found:
            order.setdefault(place, len(order))
        runs |= {place: read_run(place, checkpoint) for kind, place in found if kind == "run"}
        runs |= {place: _read_checkpoint(place) for kind, place in found if kind == "checkpoint"}
        sweeps |= {place: _read_sweep(place, checkpoint) for kind, place in found if kind == "sweep"}
        evaluations |= {place: read_evaluation(place) for kind, place in found if kind == "evaluation"}
        benchmarks |= {place: None for kind, place in found if kind == "benchmark"}
    known = [*runs.values(), *(run for sweep in sweeps.values() for run in sweep.runs)]
    for run in known:  # evaluations written into the run's own folder
        for file in sorted(run.path.rglob("metrics.json")) if run.path.is_dir() else ():
            evaluations.setdefault(file.parent, read_evaluation(file.parent))
    take, named = strangers or len(known) < 2, {Path(path).resolve() for path in paths}
    for evaluation in evaluations.values():
        # Foreign predictions belong to no run, so they were named explicitly.
        alone = take or evaluation.foreign or evaluation.folder.resolve() in named
        if alone and not any(belongs(evaluation, run) for run in known):
            orphan, origin = Run(evaluation.folder, name=evaluation.name), evaluation.checkpoint
            if origin is not None and origin.exists() and not evaluation.foreign:
                orphan = _read_checkpoint(origin)
            runs[orphan.path] = orphan
            order.setdefault(orphan.path, order.get(evaluation.folder, len(order)))
            known.append(orphan)

    def scored(run: Run) -> Run:
        mine = [evaluation for evaluation in evaluations.values() if belongs(evaluation, run)]
        scores = (*(score for evaluation in mine for score in evaluation.scores), *run.scores)
        explained = tuple(row for evaluation in mine for row in evaluation.explained)
        details = tuple(row for evaluation in mine for row in evaluation.details)
        folders = tuple(evaluation.folder for evaluation in mine)
        return dataclasses.replace(
            _as_trained(run), scores=scores, explained=explained, details=details, evaluations=folders
        )

    return Inputs(
        tuple(scored(runs[place]) for place in sorted(runs, key=lambda place: order[place])),
        tuple(dataclasses.replace(sweep, runs=tuple(map(scored, sweep.runs))) for sweep in sweeps.values()),
        tuple(benchmarks),
    )


def _as_trained(run: Run) -> Run:
    """Return a resumed run with the settings, such as the learning rate, kept by its checkpoint's optimizer."""
    optim = run.config.get("optim")
    if not run.record.get("resumed") or run.checkpoint is None or not isinstance(optim, Mapping):
        return run
    try:
        groups = read_torch(run.checkpoint, "a checkpoint")["optimizer_states"][0]["param_groups"]
    except (CheckpointError, KeyError, IndexError, TypeError):  # without it, only the requested settings are known
        return run
    kept = {key: groups[0].get(name) for key, name in _KEPT.items()}
    kept["encoder_lr"] = groups[1].get("initial_lr") if len(groups) > 1 else None
    real = {key: value for key, value in kept.items() if value is not None and key in optim}
    told = {f"optim.{key}": str(value) for key, value in real.items() if f"optim.{key}" in run.overrides}
    config = {**run.config, "optim": {**optim, **real}}
    return dataclasses.replace(run, config=config, overrides={**run.overrides, **told})


def _find(path: Path, depth: int = 3) -> list[tuple[str, Path]]:
    """Return (kind, path) of everything at or below a path, sorted by name; a shipped model counts as a checkpoint."""
    if not path.exists() and str(path) in shipped():
        return [("checkpoint", locate(str(path)))]
    if path.is_file():
        kinds = {".ckpt": "checkpoint", ".json": "benchmark" if path.stem == "benchmark" else "evaluation"}
        kind = kinds.get(path.suffix, "")
        return [(kind, path.parent if path.suffix == ".json" else path)] if kind else []
    if not path.is_dir():
        raise DataError(f"there is nothing at {path}; check the path, or use a shipped model: {', '.join(shipped())}")
    if (path / "multirun.yaml").is_file():
        return [("sweep", path)]
    if began(path):
        return [("run", path)]
    if (path / "benchmark.json").is_file():
        return [("benchmark", path)]
    if (path / "metrics.json").is_file():
        return [("evaluation", path)]
    if "optim" in read_mapping(path / ".hydra" / "config.yaml"):
        place = home(path)
        return [("run", place)] if began(place) or place == path.resolve() else []
    below = sorted(child for child in path.iterdir() if child.is_dir() and not child.name.startswith("."))
    return [found for child in below for found in _find(child, depth - 1)] if depth else []


def _read_sweep(folder: Path, checkpoint: str) -> Sweep:
    found: dict[int, Run] = {}
    for place in sorted(path.parent for path in folder.rglob(".hydra") if path.is_dir()):
        config, hydra = read_hydra(place)
        if "optim" not in config:
            continue  # an evaluation inside a run
        number = (hydra.get("job") or {}).get("num")
        number = number if isinstance(number, int) and number not in found else len(found)
        led = home(place)
        found[number] = read_run(led if began(led) else place, checkpoint, number)
    planned = read_plan(folder) or []
    last, running = max(found, default=-1), any(run.status == "running" for run in found.values())
    for number in set(range(max(last + 1, len(planned)))) - found.keys():
        overrides = split_overrides(planned[number]) if number < len(planned) else {}
        status: Status = "unfinished" if running and number > last else "failed"
        why = {"unfinished": "it is not started yet", "failed": "it left no folder: it failed before it began"}[status]
        found[number] = Run(folder / str(number), status, why, str(number), overrides=overrides, job=number, swept=True)
    runs = tuple(found[number] for number in sorted(found))
    name = read_mapping(folder / "multirun.yaml").get("name")
    return Sweep(str(name or next((run.name for run in runs if run.config), folder.name)), runs)


def _read_checkpoint(file: Path) -> Run:
    """Return the run that a checkpoint belongs to, with this checkpoint; the checkpoint alone if there is none."""
    folder = file.parents[1] if len(file.parents) > 1 else file.parent
    if file.parent.name == "checkpoints" and any((folder / name).exists() for name in (".hydra", "run.json")):
        run = read_run(folder, file.stem)
        return dataclasses.replace(run, checkpoint=file)
    return Run(file, name=file.stem, checkpoint=file)


@dataclass(frozen=True)
class Evaluation:
    """The folder of one evaluation."""

    folder: Path
    checkpoint: Path | None
    predictions: str | None
    """Path of another system's predictions, of unknown origin; None for a checkpoint."""
    data: str
    """The scored data, such as ``kitti, test split``."""
    how: str
    """Settings that change the numbers, as on the command line; empty for none."""
    motion: str
    """``motion=tracked`` if the camera's motion came from tracked points, else empty."""
    size: tuple[int, int] | None
    """Height and width that images were scored at; None if not recorded, as for another system's predictions."""
    scores: tuple[Score, ...]
    explained: tuple[Explained, ...]
    details: tuple[Detail, ...]

    @property
    def foreign(self) -> bool:
        return self.predictions is not None

    @property
    def shipped(self) -> bool:
        """Whether it belongs to a model that comes with saunet, wherever its results are."""
        return self.checkpoint is not None and is_shipped(self.checkpoint)

    @property
    def name(self) -> str:
        """Its name without a run: its folder, or the predictions if the folder's name is just Hydra's time stamp."""
        dated = re.match(r"\d{4}-\d\d-\d\d_", self.folder.name)
        return self.predictions if dated and self.predictions else self.folder.name


def read_evaluation(folder: Path) -> Evaluation:
    """Read the scores of an evaluation, and find the checkpoint that they belong to."""
    content, (config, hydra) = read_mapping(folder / "metrics.json"), read_hydra(folder)
    runtime = hydra.get("runtime") or {}
    # Only the settings help if `output_dir` put the results outside the run's folder.
    settings = _mapping(content.get("settings"))
    predictions = config.get("predictions") or settings.get("predictions")
    given = config.get("checkpoint") or settings.get("checkpoint")
    starts = [Path(runtime["cwd"])] if runtime.get("cwd") else [Path.cwd(), *folder.parents]
    candidates = [Path(start, str(given)).resolve() for start in starts] if given else []
    checkpoint = next((each for each in candidates if each.is_file()), next(iter(candidates), None))
    if given in shipped():  # as `locate` reads it: a local file of that name is ./street
        checkpoint = locate(str(given))
    data = (runtime.get("choices") or {}).get("data") or settings.get("data") or "unknown data"
    place = f"{data}, {config.get('split') or settings.get('split') or 'test'} split"
    how, images = _how(settings), content.get("images") or {}
    motion = "motion=tracked" if settings.get("motion") == "tracked" else ""
    size = image_size(settings)
    rows = [row for row in content.get("results", []) if all(isinstance(row.get(k), int | float) for k in ERROR_NAMES)]

    def common(row: Mapping[str, Any], told: str = how) -> dict[str, Any]:
        protocol = row["protocol"]
        return {"protocol": protocol, "data": place, "how": told, "fingerprint": images.get(protocol, "")}

    scores = tuple(
        Score(row["predictor"], images=row.get("images") or 0, errors=tuple(row[k] for k in ERROR_NAMES), **common(row))
        for row in rows
    )
    keys = ("condition", "images", "warped", "unwarped", "explained")
    seen_at = f"images of {size[0]}x{size[1]}" if size else ""  # photometric errors depend on it
    explained = tuple(
        Explained(**{key: row[key] for key in keys}, **common(row, ", ".join(filter(None, (how, motion, seen_at)))))
        for row in content.get("views", [])
        if row.get("predictor") == "model" and all(row.get(key) is not None for key in keys)
    )
    details = tuple(
        Detail(kind, cells=tuple(_cell(row.get(key)) for key in keys), **common(row))
        for kind, keys in DETAILS.items()
        for row in content.get(kind, [])
        if row.get("predictor") in ("model", "predictions") and row.get("group", "edges") in ("distance", "edges")
    )
    named = str(predictions) if predictions else None
    return Evaluation(folder, checkpoint, named, place, how, motion, size, scores, explained, details)


def _cell(value: Any) -> str | float | int | None:
    return value if isinstance(value, str | float | int) else None


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def belongs(evaluation: Evaluation, run: Run) -> bool:
    """Return whether an evaluation belongs to a run: its checkpoint, or its folder unless it is another system's."""
    if run.path == evaluation.folder:
        return True
    if evaluation.foreign or (evaluation.shipped and evaluation.checkpoint != run.checkpoint):
        return False
    if run.path.is_dir() and run.path in evaluation.folder.parents:
        return True
    place = evaluation.checkpoint
    return place is not None and (place in (run.path, run.checkpoint) or run.path in place.parents)


def _how(settings: Mapping[str, Any]) -> str:
    """Describe what besides images and protocol decides the numbers, as recorded by the evaluation."""
    scale = _mapping(settings.get("scale"))
    method = "stored" if scale.get("method") == "auto" else scale.get("method")
    flip = ["flip=true"] if settings.get("post_processing") else []
    return ", ".join([*flip, *([f"scale.method={method}"] if scale.get("factor") else [])])
