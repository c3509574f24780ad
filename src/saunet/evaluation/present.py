"""One model on every data set present: one table, and a folder with the results of each data set."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from saunet.data.present import PresentDataModule
from saunet.errors import ConfigError, DataError
from saunet.evaluation.result import EvaluationResult
from saunet.evaluation.team import Team, joined
from saunet.evaluation.tool import STAGES, EvaluateOptions, evaluate, evaluate_with
from saunet.io.atomic import check_folder, write_bytes
from saunet.metrics.functional import A1, ABS_REL, RMSE
from saunet.registry import Spec
from saunet.tables import Row, Table, columns, show


@dataclass(frozen=True)
class PresentResult:
    """The results of one model on several data sets."""

    results: Mapping[str, EvaluationResult]
    """Results by data set."""
    left_out: Mapping[str, str]
    """Data sets that are present but could not be evaluated, and why."""
    absent: tuple[str, ...]
    """Data sets that were not found."""
    folder: Path | None = None
    """Where the files were written."""

    @property
    def table(self) -> Table:
        """One row per data set, under its own protocol (the first requested one)."""
        rows = []
        for name, result in self.results.items():
            first = result.summaries()[0]
            errors = (first.errors[ABS_REL], first.errors[RMSE], first.errors[A1])
            rows.append(Row((name, first.protocol, *errors, first.scale, first.images)))
        headings = columns("data set", "protocol", "Abs Rel ↓|.3f", "RMSE ↓|.3f", "δ1 ↑|.3f", "scale|.3g", "images")
        notes = [f"{name}: left out: {why}" for name, why in self.left_out.items()]
        notes += [f"not found: {', '.join(self.absent)}"] if self.absent else []
        return Table("datasets", "Every data set that is present", headings, tuple(rows), tuple(notes), bold_best=False)

    def show(self) -> None:
        """Print the table and where the files are."""
        show([self.table])
        if self.folder is not None:
            print(f"results: {self.folder}")


def run(options: EvaluateOptions) -> EvaluationResult | PresentResult:
    """Run ``saunet evaluate``: `evaluate`, or `evaluate_present` with ``data=all_present``."""
    return evaluate_present(options) if _present(options.data) else evaluate(options)


def evaluate_present(options: EvaluateOptions) -> PresentResult:
    """Evaluate a model on every data set that its `PresentDataModule` finds.

    Args:
        options: As for `evaluate`, with the data ``all_present``; each data set's results go to a folder with its name.

    Returns:
        The results by data set; `PresentResult.show` prints one table.

    Raises:
        ConfigError: if an option applies to a single data set.
        CheckpointError: if the checkpoint cannot be read.
        DataError: if no data set can be evaluated.
    """
    for key in ("predictions", "compare"):
        if getattr(options, key):
            raise ConfigError(
                f"{key} applies to a single data set; leave it out with data=all_present, or choose one data set"
            )
    if options.scale.store:
        raise ConfigError("scale.store=true stores a single scale; leave it out with data=all_present")
    folder = None if options.output_dir is None else check_folder(options.output_dir)
    data: PresentDataModule = options.data.build()
    with joined() as team:
        results, left_out, absent = dict[str, EvaluationResult](), dict[str, str](), list[str]()
        for name, spec, sure in data.candidates():
            why = _missing(spec, options.split)
            if why is None:
                try:
                    results[name] = _evaluated(options, name, spec, team)
                except DataError as error:
                    left_out[name] = str(error)
            elif sure:
                left_out[name] = why
            else:
                absent.append(name)
        if not results:
            reasons = "; ".join(f"{name}: {why}" for name, why in left_out.items())
            raise DataError(
                f"no data set to evaluate below {data.root or 'data.roots'} ({reasons or 'none found'}); "
                f"looked for {', '.join([*left_out, *absent])}"
            )
        result = PresentResult(results, left_out, tuple(absent), folder)
        if folder is not None and team.rank == 0:
            write_bytes(folder / "datasets.csv", result.table.csv().encode())
            write_bytes(folder / "datasets.md", (result.table.markdown() + "\n").encode())
        return result


def _present(data: Spec) -> bool:
    return data.name == "all_present" or str(data.get("_target_")).rpartition(".")[2] == PresentDataModule.__name__


def _missing(spec: Spec, split: str) -> str | None:
    """Return why a data set has no such split at its root; None if it has."""
    try:
        spec.build().setup(STAGES[split])
    except (ConfigError, DataError) as error:
        return str(error)
    return None


def _evaluated(options: EvaluateOptions, name: str, spec: Spec, team: Team) -> EvaluationResult:
    places: dict[str, Any] = {
        key: str(Path(place) / name) for key in ("output_dir", "export") if (place := getattr(options, key)) is not None
    }
    return evaluate_with(replace(options, data=spec, **places), team)
