"""What ``saunet evaluate`` left behind: scores, on which images and with which settings, and of what."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from saunet.metrics.functional import ERROR_NAMES
from saunet.runs.files import read_json, read_mapping
from saunet.runs.folder import Explained, Run, Score


@dataclass(frozen=True)
class Evaluation:
    """The folder of one evaluation."""

    folder: Path
    checkpoint: Path | None
    predictions: str | None
    """Where the predictions of another system came from; None for a checkpoint."""
    data: str
    """What was scored, such as ``kitti, test split``."""
    how: str
    """Settings that change the numbers, as the command line says them; empty for none."""
    scores: tuple[Score, ...]
    explained: tuple[Explained, ...]

    @property
    def name(self) -> str:
        """What it goes by without a run: its folder, or the predictions where Hydra named the folder by the time."""
        dated = re.match(r"\d{4}-\d\d-\d\d_", self.folder.name)
        return self.predictions if dated and self.predictions else self.folder.name


def read_evaluation(folder: Path) -> Evaluation:
    """Read the scores of an evaluation and find out which checkpoint they belong to."""
    content: Any = read_json(folder / "metrics.json")
    content = content if isinstance(content, dict) else {}
    config = read_mapping(folder / ".hydra" / "config.yaml")
    hydra = read_mapping(folder / ".hydra" / "hydra.yaml").get("hydra") or {}
    runtime = hydra.get("runtime") or {}
    settings = content.get("settings")  # all there is where `output_dir` led the results out of the run's folder
    settings = settings if isinstance(settings, dict) else {}
    predictions = config.get("predictions") or settings.get("predictions")
    given = config.get("checkpoint") or settings.get("checkpoint")
    starts = [Path(runtime["cwd"])] if runtime.get("cwd") else [Path.cwd(), *folder.parents]
    candidates = [Path(start, str(given)).resolve() for start in starts] if given else []
    checkpoint = next((each for each in candidates if each.is_file()), next(iter(candidates), None))
    data = (runtime.get("choices") or {}).get("data") or settings.get("data") or "unknown data"
    place = f"{data}, {config.get('split') or settings.get('split') or 'test'} split"
    how = _how(settings)
    images = content.get("images") or {}
    scores = tuple(
        Score(
            row["predictor"],
            row["protocol"],
            place,
            row.get("images") or 0,
            tuple(row[key] for key in ERROR_NAMES),
            fingerprint=images.get(row["protocol"], ""),
            how=how,
        )
        for row in content.get("results", [])
        if all(isinstance(row.get(key), int | float) for key in ERROR_NAMES)
    )
    keys = ("condition", "images", "warped", "unwarped", "explained")
    explained = tuple(
        Explained(
            protocol=row["protocol"],
            data=place,
            fingerprint=images.get(row["protocol"], ""),
            how=how,
            **{key: row[key] for key in keys},
        )
        for row in content.get("views", [])
        if row.get("predictor") == "model" and all(row.get(key) is not None for key in keys)
    )
    named = str(predictions) if predictions else None
    return Evaluation(folder, checkpoint, named, place, how, scores, explained)


def belongs(evaluation: Evaluation, run: Run) -> bool:
    """Tell whether an evaluation is one of a run: of its checkpoint, or in its folder and not of another system."""
    if run.path == evaluation.folder:
        return True
    if evaluation.predictions is not None:
        return False
    if run.path.is_dir() and run.path in evaluation.folder.parents:
        return True
    place = evaluation.checkpoint
    return place is not None and (place in (run.path, run.checkpoint) or run.path in place.parents)


def _how(settings: Mapping[str, Any]) -> str:
    """Say what else than the images and the protocol decides the numbers, as `Subject.settings` recorded it."""
    scale = settings.get("scale")
    scale = scale if isinstance(scale, dict) else {}
    method = "stored" if scale.get("method") == "auto" else scale.get("method")
    told = (
        "flip=true" if settings.get("post_processing") else "",
        f"scale.method={method}" if scale.get("factor") else "",
    )
    return ", ".join(filter(None, told))
