"""Several protocols side by side, each on the ground truth that it needs, from one request."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch

from saunet.errors import ConfigError, one_of
from saunet.evaluation.breakdown import Buckets
from saunet.evaluation.result import EvaluationResult, ImageRow
from saunet.evaluation.runner import Predictor, evaluate
from saunet.evaluation.statistics import compare, drive_of, spreads
from saunet.evaluation.views import Motion, evaluate_views
from saunet.evaluation.writers import read_rows
from saunet.metrics.protocols import Protocol as Rules
from saunet.metrics.protocols import protocol
from saunet.types import EvalBatch


@runtime_checkable
class EvaluationData(Protocol):
    """What an evaluation needs of a data module."""

    ground_truth: str
    neighbors: Sequence[str]
    datasets: Mapping[str, Any]

    @property
    def protocols(self) -> Sequence[str]:
        """Names of the protocols that fit it, its own first."""

    def setup(self, stage: str | None = None) -> None:
        """Find the images of a stage's splits."""

    def batches(self, split: str, device: str | torch.device) -> Iterator[EvalBatch]:
        """Yield the batches of a split, on a device."""


STAGES = {"test": "test", "val": "validate"}
"""Splits that can be evaluated, and the stage that sets each up."""


def evaluate_protocols(
    names: Sequence[str],
    data_with: Callable[[str | None], EvaluationData],
    predictors_for: Callable[[EvaluationData], Mapping[str, Predictor]],
    *,
    motion: Motion | None = None,
    split: str = "test",
    device: str | torch.device = "cpu",
    buckets: Buckets | None = None,
    progress: bool = True,
) -> EvaluationResult:
    """Score predictors under protocols, with one pass over the images for each ground truth that they need.

    Args:
        names: Names of protocols; none for the data set's own, of which those that need motion are left out where there
            is none.
        data_with: Makes the data, not set up, with the ground truth of a name; None for the data set's own.
        predictors_for: Makes the predictors for one pass over those data; they are set up.
        motion: Of the first predictor, for protocols without ground truth.
        split: ``test`` or ``val``.
        device: Where the predictors want their batches.
        buckets: Also sum the errors by these buckets of pixels.
        progress: Show a progress bar on a terminal or in a notebook.

    Raises:
        ConfigError: if a protocol does not fit the data, or needs motion and there is none.
        DataError: if there is no image, or none has ground truth.
    """
    one_of("split", split, STAGES)
    first: EvaluationData | None = data_with(None)
    assert first is not None
    own = first.ground_truth
    if not names:
        fitting = [name for name in first.protocols if motion or protocol(name).ground_truth != "none"]
        names = fitting or first.protocols
    results = []
    for kind, rules in passes([protocol(name) for name in names], own).items():
        # The data that were asked for their own ground truth serve the pass that wants it; others start anew.
        data = (
            first if kind in (own, "none") and first is not None else data_with(None if kind in (own, "none") else kind)
        )
        first = None if data is first else first
        if kind == "none":
            data.neighbors = (*data.neighbors, split)
        data.setup(STAGES[split])
        predictors = predictors_for(data)
        batches, total = data.batches(split, device), len(data.datasets[split])
        if kind != "none":
            results.append(
                evaluate(
                    predictors,
                    batches,
                    rules,
                    ground_truth=data.ground_truth,
                    buckets=buckets,
                    total=total,
                    progress=progress,
                )
            )
            continue
        if motion is None:
            raise ConfigError(
                f"protocol '{rules[0].name}' needs the motion of the camera, which only a model with a pose network "
                "predicts; evaluate such a checkpoint, or choose a protocol with ground truth"
            )
        group_of = _conditions(data, split)
        pair = {name: (predict, motion) for name, predict in list(predictors.items())[:1]}
        for rule in rules:
            results.append(evaluate_views(pair, batches, rule, group_of=group_of, total=total, progress=progress))
    joined = results[0]
    for result in results[1:]:
        joined = joined.joined(result)
    by_name = {rules.name: rules for rules in joined.protocols}
    return replace(joined, protocols=tuple(by_name[name] for name in names))


@dataclass(frozen=True, slots=True)
class Earlier:
    """Another evaluation, to compare with."""

    source: Path
    """Where it was read from."""
    rows: tuple[ImageRow, ...]
    """Its images."""


def read_earlier(source: Path) -> Earlier:
    """Read an evaluation back.

    Args:
        source: Its folder, or the ``per_image.csv`` in it.

    Raises:
        DataError: if it cannot be read.
    """
    return Earlier(source, read_rows(source / "per_image.csv" if source.is_dir() else source))


def with_statistics(result: EvaluationResult, level: float | None, earlier: Earlier | None = None) -> EvaluationResult:
    """Add bootstrap intervals of the means, and what changed since another evaluation of the same images.

    Args:
        result: The evaluation.
        level: Of the intervals, such as 0.95; None leaves them out (comparisons then use 0.95).
        earlier: The other evaluation, whose first predictor is compared with the first one here, under each protocol
            that both have.

    Raises:
        ConfigError: if the level is not between 0 and 1, or the evaluations share no protocol.
        DataError: if the earlier evaluation is of other images.
    """
    comparisons = []
    if earlier is not None:
        before = earlier.rows
        who = before[0].predictor if before else ""
        for rules in result.protocols:
            rows = [row for row in before if (row.predictor, row.protocol) == (who, rules.name)]
            now = result.select(result.predictors[0], rules.name)
            if rows and now:
                names = (f"{who} of {earlier.source}", result.predictors[0])
                comparisons.append(compare(rows, now, names=names, level=level or 0.95))
        if not comparisons:
            there = ", ".join(dict.fromkeys(row.protocol for row in before)) or "none"
            raise ConfigError(
                f"'{earlier.source}' has no protocol in common with this evaluation (its protocols: {there}); "
                "evaluate both under the same one"
            )
    return replace(result, spreads=spreads(result, level) if level else (), comparisons=tuple(comparisons))


def passes(protocols: Sequence[Rules], own: str) -> dict[str, list[Rules]]:
    """Sort protocols by the ground truth to load for them: the data set's own wherever it serves."""
    found: dict[str, list[Rules]] = {}
    for rules in protocols:
        found.setdefault(own if rules.accepts(own) else rules.ground_truth, []).append(rules)
    return found


def _conditions(data: EvaluationData, split: str) -> Callable[[str], str]:
    """Return how images are grouped: by the condition that their recording names, or else by recording."""
    dataset = data.datasets[split]
    named = {drive.name: drive.condition for drive in dataset.drives}
    by_image = {
        dataset.name(place): named[dataset.drives[position].name] for place, (position, _) in enumerate(dataset.windows)
    }
    return lambda image: by_image.get(image) or drive_of(image)
