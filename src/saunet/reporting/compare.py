"""Two or more runs against each other: differing settings, losses, scores side by side, and paired comparisons."""

from __future__ import annotations

import itertools
import shlex
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from saunet.errors import ConfigError, DataError
from saunet.evaluation.files import image_size, read_rows
from saunet.evaluation.rows import COMPARED, ERROR_COLUMNS, ImageRow, ViewRow, sizes_told
from saunet.evaluation.statistics import compare as paired
from saunet.reporting.inputs import Evaluation, Inputs, read_evaluation
from saunet.reporting.tables import Groups, explained_table, health_tables, losses_table
from saunet.runs.run import SUBJECTS, Run
from saunet.runs.sweep import differing, settings, typed_names, values
from saunet.tables import Column, Row, Table, csv_text
from saunet.weights.locate import is_shipped

_EACH_PAIR = 4
"""Up to this many runs, all pairs are compared; of more, each with the first."""
_SIZE = ("height", "width")
_OF_TRAINING = (*_SIZE, "offsets", "batch_size", "workers", "crop_margin", "flip_prob", "color_jitter_prob")
"""Data settings that an evaluation takes from the checkpoint, or ignores."""


def settings_table(runs: Mapping[str, Run]) -> Table:
    """Return the settings in which runs differ, one column per run."""
    members = list(runs.values())
    keys = differing(members)
    rows = [Row(cells) for cells in zip(keys, *(values(run, keys) for run in members), strict=True)]
    trained = [bool(run.config or run.record) for run in members]  # not an evaluation or a checkpoint alone
    ended = [f"{run.status}{f': {run.error}' if run.error else ''}" for run in members]
    commits = [str((run.record.get("git") or {}).get("commit") or "unknown")[:12] for run in members]
    for key, cells in (("status", ended), ("code", commits)):
        if len(set(itertools.compress(cells, trained))) > 1:
            rows.append(Row((key, *(cell if known else "" for cell, known in zip(cells, trained, strict=True)))))
    alone = sum(map(bool, map(settings, members))) < 2
    notes = () if rows else ("only a training has settings to compare" if alone else "no setting differs",)
    return Table("settings", "Settings that differ", (Column("key"), *map(Column, runs)), tuple(rows), notes)


def scores_table(runs: Mapping[str, Run]) -> Table:
    """Return the scores of runs side by side, grouped by comparable measurements."""
    scored = dict.fromkeys((name, score) for name, run in runs.items() for score in run.scores if not score.trivial)
    group = Groups(score for _, score in scored)
    rows = [Row((name, *score.errors), "measured", group(score)) for name, score in scored]
    rows.sort(key=lambda row: row.group)
    return Table("scores", "Scores", (Column("run"), *ERROR_COLUMNS), tuple(rows))


@dataclass(frozen=True)
class Scored:
    """One run's scores for each image under one protocol, in one evaluation."""

    rows: tuple[ImageRow | ViewRow, ...]
    of: Evaluation

    @property
    def images(self) -> frozenset[str]:
        return frozenset(row.name for row in self.rows)

    def pairs(self, other: Scored) -> bool:
        """Return whether both have the same images, predicted with the same settings if known."""
        return self.images == other.images and (self.of.how == other.of.how or self.of.foreign or other.of.foreign)


Pairs = Mapping[tuple[str, str], Mapping[str, Scored]]
"""(protocol, what was evaluated and how) -> run -> its errors on each image."""


def comparisons(runs: Mapping[str, Run]) -> tuple[list[Table], list[str], Pairs]:
    """Compare runs in pairs, image by image, if both were evaluated alike; also return what was paired.

    Up to four runs, all pairs are compared; of more, each with the first. Evaluations of two runs under the same
    protocol are paired if they have the same images and settings.
    """
    names = list(runs)
    found = {name: _scored(run) for name, run in runs.items()}
    tables, left_out = [], []
    compared: dict[tuple[str, str], dict[str, Scored]] = defaultdict(dict)
    for first, other in itertools.combinations(names, 2):
        if first != names[0] and len(names) > _EACH_PAIR:
            break
        both = [protocol for protocol in found[first] if protocol in found[other]]
        if not both:
            without = [name for name in (first, other) if not found[name]]
            if without and first != names[0]:
                continue  # said with the first one already
            why = f"{' and '.join(without)} not evaluated" if without else "not evaluated under the same protocol"
            said = f"the scores of {first} and {other} are not compared ({why}); "
            left_out.append(said + _remedy(runs[first], runs[other]))
        for protocol in both:
            ours, theirs = found[first][protocol], found[other][protocol]
            pairs = [(one, two) for one, two in itertools.product(ours, theirs) if one.pairs(two)]
            alike = [(one, two) for one, two in pairs if one.of.motion == two.of.motion]
            try:
                for one, two in alike or pairs:
                    comparison = paired(one.rows, two.rows, names=(first, other))
                    sizes = _sizes({first: (runs[first], one), other: (runs[other], two)})
                    told = _told(one.of, two.of, first, other)
                    tables.append(comparison.table(told, *_motions(one.of, two.of, first, other), *sizes))
                    compared[protocol, told] |= {first: one, other: two}
                if not pairs:
                    why = f"{_apart(ours, theirs)}; {_remedy(runs[first], runs[other])}"
                    left_out.append(f"{first} and {other} under {protocol}: {why}")
            except DataError as reason:
                left_out.append(f"{first} and {other} under {protocol}: {reason}")
    return tables, left_out, compared


def images_csv(compared: Pairs) -> str:
    """Return what was paired as CSV: a line for each evaluation and image, a column for each error and run."""
    names = list(dict.fromkeys(name for runs in compared.values() for name in runs))
    found: dict[tuple[str, str, str], dict[str, float]] = defaultdict(dict)
    for evaluation, runs in compared.items():
        for name, scored in runs.items():
            for row in scored.rows:
                found[(*evaluation, row.name)] |= {f"{error} {name}": value for error, value in row.compared.items()}
    errors = [f"{error} {name}" for error in COMPARED for name in names]
    columns = [each for each in errors if any(each in values for values in found.values())]
    lines = ((*image, *map(values.get, columns)) for image, values in sorted(found.items()))
    return csv_text(("protocol", "evaluation", "image", *columns), lines)


def _scored(run: Run) -> dict[str, list[Scored]]:
    """Return a run's evaluations by protocol, and the last of several with the same images and settings."""
    found: dict[str, dict[tuple[frozenset[str], str, str], Scored]] = {}
    for folder in run.evaluations:
        if not (folder / "per_image.csv").is_file():
            continue
        evaluation = read_evaluation(folder)
        table: dict[str, list[ImageRow | ViewRow]] = {}
        for row in read_rows(folder):
            if row.predictor in SUBJECTS:
                table.setdefault(row.protocol, []).append(row)
        for protocol, rows in table.items():
            scored = Scored(tuple(rows), evaluation)
            found.setdefault(protocol, {})[scored.images, evaluation.how, evaluation.motion] = scored
    return {protocol: list(members.values()) for protocol, members in found.items()}


def _told(one: Evaluation, two: Evaluation, *names: str) -> str:
    """Describe two paired evaluations, with equal settings only once."""
    if one.how == two.how:
        return ", ".join(filter(None, (one.data, one.how, one.motion if one.motion == two.motion else "")))
    first, second = (each.how or ("as predicted elsewhere" if each.foreign else "plain") for each in (one, two))
    return f"{one.data}; {names[0]} {first}, {names[1]} {second}"


def _motions(one: Evaluation, two: Evaluation, *names: str) -> list[str]:
    """Return a note if the camera's motion was found in different ways: photometric errors depend on it."""
    if one.motion == two.motion:
        return []
    ways = [each.motion or "the pose network's motion" for each in (one, two)]
    return [f"{names[0]} with {ways[0]}, {names[1]} with {ways[1]}; use motion=tracked for both to compare depth alone"]


def _sizes(both: Mapping[str, tuple[Run, Scored]]) -> list[str]:
    """Return a note if two runs were scored on images of different sizes: photometric errors depend on them."""
    found = []
    for name, (run, scored) in both.items():
        size = scored.of.size or image_size({"size": [(run.config.get("data") or {}).get(k) for k in _SIZE]})
        if size is None or not isinstance(scored.rows[0], ViewRow):
            return []
        found.append((name, size, is_shipped(run.path)))
    found.sort(key=lambda each: not each[2])  # the size of a shipped model cannot be changed, so it is the one advised
    (first, one, _), (second, two, _) = found
    return [sizes_told(first, one, second, two)] if one != two else []


def _apart(ours: Sequence[Scored], theirs: Sequence[Scored]) -> str:
    """Return why no evaluation of one run can be paired with one of the other."""
    for one, two in itertools.product(ours, theirs):
        if one.images == two.images:
            first, second = (each.of.how or "no flip or scale" for each in (one, two))
            return f"the first was evaluated with {first} and the second with {second}"
    counts = [", ".join(f"{len(one.images)} of {one.of.data}" for one in each) for each in (ours, theirs)]
    return f"the images cannot be paired ({counts[0]} against {counts[1]}, with different names)"


def _remedy(first: Run, other: Run) -> str:
    """Return the commands that make two runs comparable: both on the first training's data, into our folders."""
    trained = [run for run in (first, other) if not is_shipped(run.path)]
    leading = next(iter(trained), first)
    data, choice = leading.config.get("data") or {}, leading.choices.get("data")
    if not choice or not all(run.path.is_dir() and run.checkpoint for run in (first, other)):
        return "run saunet evaluate on both with the same data and settings, and add the results to this command"
    given = {f"data.{key}": str(data[key]) for key in ("root",) if data.get(key)}
    given |= {key: value for key, value in leading.overrides.items() if key.startswith(("data.", "plugins"))}
    words = [f"{key}={value}" for key, value in given.items() if key.removeprefix("data.") not in _OF_TRAINING]
    if any((run.config.get("data") or {}).get("track_motion") for run in (first, other)):
        words.append("motion=tracked")  # as in training: an untrained pose network would hide the depth
    commands = []
    for run in (first, other):  # a shipped model's scores are kept with the other training
        known = is_shipped(run.path)
        place = run.name if known else _typed(run.path)
        folder = f"{_typed(leading.path)}/compared_{run.name}" if known else f"{place}/compared"
        commands.append(shlex.join(["saunet", "evaluate", place, f"data={choice}", *words, f"output_dir={folder}"]))
    splits = [(run.record.get("splits") or {}).get("val") for run in trained]
    seen = "" if len(set(splits)) < 2 else " (frames that the second may have been trained on)"
    return f"run `{commands[0]}` and `{commands[1]}`{seen}, then compare again"


def _typed(path: Path) -> str:
    return str(path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path)


def compared(inputs: Inputs, wanted: Sequence[str]) -> tuple[list[Table], list[str], str]:
    """Return the differences between runs: tables, sentences about what is left out, and images as CSV."""
    members = inputs.all_runs
    if len(members) == 1 and len(members[0].evaluations) > 1:
        raise DataError(
            f"all evaluations named are of one model, {members[0].name}; saunet report compare takes two models: to "
            f"compare two evaluations of one, run the second again with compare={_typed(members[0].evaluations[0])}"
        )
    if len(members) < 2:
        raise DataError(
            f"{len(members)} run is not enough to compare; name two or more: saunet report compare A B, or "
            "saunet report compare street A for the shipped model and a run"
        )
    if wanted and len(set(wanted)) != len(members):
        raise ConfigError(f"labels holds {len(set(wanted))} names for {len(members)} runs; give each its own")
    runs = dict(zip(wanted or typed_names(members), members, strict=True))
    scores = scores_table(runs)
    side_by_side = (losses_table(runs), scores if scores.rows else None, explained_table(runs))
    found, left_out, rows = comparisons(runs)
    tables = [settings_table(runs), *(table for table in side_by_side if table), *health_tables(runs), *found]
    return tables, left_out, images_csv(rows) if rows else ""
