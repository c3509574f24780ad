"""Comparable numbers, Tables 1 to 3 of the paper with our rows beside the printed ones, and the table of runs."""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Iterable, Mapping

from saunet.evaluation.rows import ERROR_COLUMNS
from saunet.metrics.functional import A1, ABS_REL, RMSE
from saunet.published import published
from saunet.registry import Spec, models
from saunet.reporting.page import Missing
from saunet.runs.run import Detail, Explained, Run, Score
from saunet.runs.sweep import RATIO, differing, ratio, values
from saunet.tables import Cell, Column, Row, Table, columns
from saunet.weights.locate import is_shipped

_SHOWN = (ABS_REL, RMSE, A1)
"""Errors in the table of runs."""
PRINTED = "Published: KITTI Eigen test split (697 images), 0–80 m, median-scaled"
_DIGITS = 8
"""Digits of a fingerprint in a heading."""


class Groups:
    """Headings that are equal exactly for comparable numbers.

    The fingerprint of the images is part of a heading only if nothing else distinguishes two groups.
    """

    def __init__(self, measured: Iterable[Score | Explained | Detail]) -> None:
        counts = Counter(words for words, _ in {(_words(one), one.fingerprint) for one in measured})
        self._ambiguous = {words for words, count in counts.items() if count > 1}

    def __call__(self, one: Score | Explained | Detail) -> str:
        words = _words(one)
        which = f"sha256 {one.fingerprint[:_DIGITS]}" if one.fingerprint else "the file does not say which"
        return f"{words} ({which})" if words in self._ambiguous else words


def chosen(runs: Mapping[str, Run]) -> dict[str, Score]:
    """Return one score of each run that has any, chosen so that as many as possible are comparable.

    Runs with comparable scores are grouped, the largest group first; in a tie, evaluations come before validations.
    """
    left = {name: [score for score in run.scores if not score.trivial] for name, run in runs.items()}
    found: dict[str, Score] = {}
    while any(left.values()):
        counts = Counter(key for scores in left.values() for key in dict.fromkeys(map(_key, scores)))
        best = max(counts, key=lambda key: (counts[key], not key[0]))
        for name, scores in left.items():
            if mine := [score for score in scores if _key(score) == best]:
                found[name], left[name] = mine[0], []
    return found


def comparable(runs: Mapping[str, Run]) -> dict[str, Score]:
    """Return the scores of the largest group of comparable runs, which may share a drawing."""
    scores = chosen(runs)
    first = next((_key(score) for score in scores.values()), None)
    return {name: score for name, score in scores.items() if _key(score) == first}


def _key(score: Score) -> tuple[bool, str, str, int, str, str]:
    return score.validation, score.data, score.protocol, score.images, score.fingerprint, score.how


def _words(one: Score | Explained | Detail) -> str:
    where = ", ".join(filter(None, (one.data, one.how, f"protocol {one.protocol}")))
    if not isinstance(one, Score):
        return f"Measured: {where}"
    kind = "Measured while training, best epoch" if one.validation else "Measured"
    return f"{kind}: {where}, {one.images} image{'' if one.images == 1 else 's'}"


def table1(runs: Mapping[str, Run]) -> tuple[Table | None, list[Missing]]:
    """Return every score of the runs, with the paper's Table 1 if comparable, and the runs without a score."""
    rows, ours = list[Row](), _scored(runs)
    group = Groups(score for _, score in ours)
    for name, score in ours:
        who = score.predictor if score.trivial else name
        rows.append(Row((who, _pattern(runs[name], score), *score.errors), "measured", group(score)))
    missing = [
        Missing(f"Errors and accuracy of {name}", _no_score(run))
        for name, run in runs.items()
        if not (run.scores or run.explained)
    ]
    notes = [
        "Numbers of different groups cannot be compared: the images, the ground truth or the training differ. The "
        "best of each group is bold.",
        "Pattern: D = depth as supervision, M = monocular video, S = stereo pairs.",
    ]
    if _compares(score for _, score in ours):
        rows += [Row((row.method, row.pattern, *row.errors), "published", PRINTED) for row in published().table1]
        notes.append("In the paper, Eigen's last two numbers are equal, and Klodt's RMSE log is a dash.")
    elif ours:
        why = "they are for KITTI's Eigen split, and no run was scored on it"
        missing.append(Missing("Published errors to compare with", why))
    headings = (*columns("Method", "Pattern"), *ERROR_COLUMNS)
    table = Table("table1", "Errors and accuracy (the paper’s Table 1)", headings, tuple(rows), tuple(notes))
    return table if rows else None, missing


def _compares(scores: Iterable[Score]) -> bool:
    """Return whether any score uses a protocol of KITTI's Eigen split, as the paper does."""
    return any(score.protocol.startswith("eigen") for score in scores)


def explained_table(runs: Mapping[str, Run]) -> Table | None:
    """Return how well runs explain data without ground truth, by condition; None if none was evaluated on such data."""
    ours = dict.fromkeys((name, one) for name, run in runs.items() for one in run.explained)
    group = Groups(one for _, one in ours)
    rows = [
        Row((name, one.condition, one.images, one.warped, one.unwarped, one.explained), "measured", group(one))
        for name, one in ours
    ]
    order = list(dict.fromkeys(row.group for row in rows))
    rows.sort(key=lambda row: order.index(row.group))
    headings = columns(
        *("Method", "Condition", "Images", "Photometric error|.4f", "without warping|.4f", "Pixels explained|.3f")
    )
    notes = ("Photometric error: eqs. (8) to (10) after warping the neighboring frames by predicted depth and motion.",)
    return (
        Table("conditions", "Data without ground truth, by condition", headings, tuple(rows), notes) if rows else None
    )


def health_tables(runs: Mapping[str, Run]) -> list[Table]:
    """Return the health warnings recorded in training, if any."""
    marks = {name: run.record.get("health") for name, run in runs.items()}
    rows = [
        Row((name, str(said))) for name, found in marks.items() if isinstance(found, Mapping) for said in found.values()
    ]
    return [Table("health", "Health warnings in training", columns("Run", "Finding"), tuple(rows))] if rows else []


def detail_tables(runs: Mapping[str, Run]) -> list[Table]:
    """Return the errors of runs by place, and their scores of edges and point clouds, as far as measured."""
    kinds = {
        "buckets": ("Errors by place", columns("Where", "Pixels", "Abs Rel ↓|.3f", "RMSE ↓|.3f", "δ1 ↑|.3f")),
        "shapes": (
            "Depth edges and point clouds",
            columns(
                "Edge accuracy px ↓|.2f", "completeness px ↓|.2f", "F-score ↑|.3f", "precision ↑|.3f", "recall ↑|.3f"
            ),
        ),
    }
    found = []
    for kind, (title, headings) in kinds.items():
        ours = list(dict.fromkeys((name, one) for name, run in runs.items() for one in run.details if one.kind == kind))
        group = Groups(one for _, one in ours)
        rows = [Row((name, *one.cells), "measured", group(one)) for name, one in ours]
        order = list(dict.fromkeys(row.group for row in rows))
        rows.sort(key=lambda row: order.index(row.group))
        if rows:
            found.append(Table(kind, title, (*columns("Method"), *headings), tuple(rows), bold_best=kind == "shapes"))
    return found


def table2(sizes: Mapping[str, tuple[int, int]]) -> tuple[Table | None, list[Missing]]:
    """Return the parameters of our networks, with the paper's Table 2; None without networks."""
    if not sizes:
        return None, [Missing("Parameters of the networks", "no run has a checkpoint")]
    rows = [
        Row((name, depth / 1e6, pose / 1e6 if pose else None, (depth + pose) / 1e6), "measured", "Counted here")
        for name, (depth, pose) in sizes.items()
    ]
    rows += [Row((row.method, None, None, row.megaparameters), "published", "Published") for row in published().table2]
    headings = columns("Method", "Depth network|.1f", "Pose network|.1f", "Together|.1f")
    notes = ("Millions of parameters; the paper's unit is “Mb”.",)
    return Table("table2", "Parameters (the paper’s Table 2)", headings, tuple(rows), notes), []


def table3(runs: Mapping[str, Run]) -> tuple[Table | None, list[Missing]]:
    """Return our runs of different encoders and decoders, with the paper's Table 3 if comparable; None without any."""
    ours = _scored({name: run for name, run in runs.items() if run.component("model/encoder")})
    models = [(runs[name], score) for name, score in ours if not score.trivial]
    group = Groups(score for _, score in models)
    headings = (*columns("Method", "STF-T", "Attention"), *ERROR_COLUMNS)
    if len({networks(run) for run, _ in models}) < 2:
        return None, [Missing("Encoders and decoders compared", "no two scored runs differ in encoder or decoder")]
    rows = [Row((networks(run), *_ticks(run), *score.errors), "measured", group(score)) for run, score in models]
    rest, notes = [key for key in differing([run for run, _ in models]) if not key.startswith("model.")], []
    if rest:
        notes.append(f"Our rows also differ in {', '.join(rest)}; see the table of runs.")
    if _compares(score for _, score in models):
        notes.append("The paper's first two rows equal Mono R18 and Mono R50 of its Table 1 digit for digit.")
        rows += [
            Row((row.method, _tick(row.stratified), _tick(row.attention), *row.errors), "published", PRINTED)
            for row in published().table3
        ]
    title = "Encoders and decoders compared (the paper’s Table 3)"
    return Table("table3", title, headings, tuple(rows), tuple(notes)), []


def runs_table(name: str, title: str, runs: Mapping[str, Run], *, swept: bool) -> Table:
    """Return runs with their differing settings, how they ended, and their scores."""
    members = list(runs.values())
    keys = differing(members, by_overrides=swept)
    ratios = [ratio(run) for run in members]
    show_ratio = len({value for value in ratios if value is not None}) > 1
    headings = (
        *columns("Run", "Status"),
        *map(Column, keys),
        *columns(*[RATIO] * show_ratio, "Epochs", "Loss|.4f"),
        *(ERROR_COLUMNS[index] for index in _SHOWN),
        *columns("Minutes|.1f"),
    )
    scores = chosen(runs)
    group = Groups(scores.values())
    groups = list(dict.fromkeys(map(group, scores.values())))
    rows = []
    for (label, run), number in zip(runs.items(), ratios, strict=True):
        score = scores.get(label)
        cells = (
            *(label, status(run), *values(run, keys), *[number] * show_ratio, *_progress(run)),
            *(score.errors[index] if score else None for index in _SHOWN),
            run.seconds / 60 if run.seconds is not None else None,
        )
        place = (group(score) if score else "Without a score") if len(groups) > 1 else ""
        rows.append(Row(cells, "failed" if run.error else "measured", place, run.error or ""))
    notes = ["Loss: mean over the last tenth of the logged steps; losses with different weights cannot be compared."]
    if len(groups) == 1:
        notes.append(f"Errors — {groups[0]}.")
    elif groups:
        rows.sort(key=lambda row: [*groups, "Without a score"].index(row.group))
        notes.append("Errors in different groups cannot be compared.")
    return Table(name, title, headings, tuple(rows), tuple(notes))


def networks(run: Run) -> str:
    """Return a run's networks in words: a whole model's name, such as ``street``, or ``resnet18 + unet``."""
    return _system(run) or f"{run.component('model/encoder')} + {run.component('model/decoder')}"


def status(run: Run) -> str:
    """Return how a run ended in one word, or ``shipped`` for a model that comes with saunet."""
    return "shipped" if is_shipped(run.path) else run.status


def with_pose(run: Run) -> str:
    """Return a run's networks in words, with the pose network if it is not the whole model's own."""
    pose, system = run.component("model/pose"), _system(run)
    own = _own_parts(system).get("pose") if system else None
    return networks(run) + (f", pose {pose}" if pose and pose != own else "")


@functools.cache
def _own_parts(system: str) -> Spec:
    """Return the parts of a whole model by kind; cached, because each row of each table needs them."""
    return Spec.of("model", system)


def _system(run: Run) -> str:
    """Return the name of the chosen whole model, if its encoder and decoder are unchanged."""
    name = run.choices.get("model", "")
    if name not in models.names():
        return ""
    own = _own_parts(name)
    alike = all(run.component(f"model/{part}") == own.get(part) for part in ("encoder", "decoder"))
    return name if alike else ""


def last_mean(run: Run, key: str) -> float | None:
    """Return the mean of a logged figure over the last tenth of the rows that have it."""
    found = [row[key] for row in run.history if key in row]
    last = found[-max(1, len(found) // 10) :]
    return sum(last) / len(last) if last else None


def _progress(run: Run) -> tuple[Cell, Cell]:
    """Return a run's number of epochs and its last mean training loss."""
    epochs = [row["epoch"] for row in run.history if "epoch" in row]
    return (int(max(epochs)) + 1 if epochs else None), last_mean(run, "train/loss")


def losses_table(runs: Mapping[str, Run]) -> Table | None:
    """Return the losses that runs have logged, and the fraction of pixels used; None if no run has any."""
    rows = []
    for name, run in runs.items():
        validated = [row["val/loss"] for row in run.history if "val/loss" in row]
        cells = (*_progress(run), min(validated, default=None), last_mean(run, "health/automask"))
        if any(cell is not None for cell in cells):
            rows.append(Row((name, *cells), "measured"))
    notes = [
        "Loss: mean over the last tenth of the logged steps; with an auto-mask, over the used pixels only, so it "
        "says little if these are few."
    ]
    if any(key.split(".")[0] in ("objective", "loss") for key in differing(list(runs.values()))):
        notes.append("The objectives differ, so these losses cannot be compared.")
    headings = columns("run", "epochs", "loss|.4f", "lowest val/loss|.4f", "pixels used|.3f")
    logged = any(cell is not None for row in rows for cell in row.cells[2:])
    return Table("losses", "Losses", headings, tuple(rows), tuple(notes)) if logged else None


def _scored(runs: Mapping[str, Run]) -> list[tuple[str, Score]]:
    """Return every score once, group by group; validation scores only if there are no others."""
    pairs = []
    for name, run in runs.items():
        evaluated = [score for score in run.scores if not score.validation]
        pairs += [(name, score) for score in evaluated or run.scores]
    group = Groups(score for _, score in pairs)
    found: dict[str, dict[tuple[object, ...], tuple[str, Score]]] = {}
    for name, score in pairs:
        # Constant depth beside every evaluation of the same images; or a model that was evaluated twice alike.
        who = score.predictor if score.trivial else name
        key = (score.trivial, who, *(round(value, 6) for value in score.errors))
        found.setdefault(group(score), {}).setdefault(key, (name, score))
    ordered = (sorted(members.values(), key=lambda pair: pair[1].trivial) for members in found.values())
    return [pair for members in ordered for pair in members]


def _no_score(run: Run) -> str:
    if run.error:
        return f"{run.status}: {run.error}"
    return "neither evaluated nor validated against depth; run saunet evaluate on its checkpoint"


def _pattern(run: Run, score: Score) -> str:
    if score.trivial or not run.config:
        return ""
    gradient = (run.config.get("objective") or {}).get("gradient") or {}
    data = run.config.get("data") or {}
    seen = "M" * bool(data.get("offsets")) + "S" * bool(data.get("stereo")) or "M"
    return "D+" * (gradient.get("target") == "lidar") + seen


def _ticks(run: Run) -> tuple[str, str]:
    node = (run.config.get("model") or {}).get("decoder") or {}
    attention = run.component("model/decoder").lower().startswith("aunet")
    attention = attention and node.get("attention") not in (None, "none")
    return _tick(run.component("model/encoder").lower().startswith("stratified")), _tick(attention)


def _tick(value: bool) -> str:
    return "✓" if value else ""
