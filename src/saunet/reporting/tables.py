"""Tables 1 to 3 of the paper with our own rows beside the printed ones, and the table of a sweep's runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from saunet.evaluation.result import ERROR_COLUMNS
from saunet.published import published
from saunet.reporting.groups import Groups, chosen
from saunet.reporting.page import Missing
from saunet.runs.folder import Run, Score
from saunet.runs.sweep import RATIO, differing, ratio, values
from saunet.tables import Cell, Column, Row, Table

PRINTED = "Published: KITTI Eigen test split (697 images), 0–80 m, median-scaled"


def table1(runs: Mapping[str, Run]) -> tuple[Table, list[Missing]]:
    """Return the paper's Table 1 with every score of the runs, and which runs have none."""
    rows = [Row((row.method, row.pattern, *row.errors), "published", PRINTED) for row in published().table1]
    ours, without = _scored(runs)
    group = Groups(score for _, score in ours)
    rows += [
        Row(
            (score.predictor if score.trivial else name, _pattern(runs[name], score), *score.errors),
            "measured",
            group(score),
        )
        for name, score in ours
    ]
    notes = (
        "Numbers of different groups do not compare: other images, other ground truth, other training. "
        "Bold is the best of its group.",
        "Pattern: D = depth as supervision, M = monocular video, S = stereo pairs.",
        "Eigen's last two numbers are equal in the paper; Klodt's RMSE log is a dash there.",
    )
    columns = (Column("Method"), Column("Pattern"), *ERROR_COLUMNS)
    missing = [Missing(f"Table 1, row of {name}", _no_score(runs[name])) for name in without]
    return Table("table1", "Table 1. Errors and accuracy", columns, tuple(rows), notes), missing


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
    columns = (
        Column("Method"),
        Column("Condition"),
        Column("Images"),
        Column("Photometric error", ".4f"),
        Column("without warping", ".4f"),
        Column("Pixels explained", ".3f"),
    )
    notes = ("Photometric error: eqs. (8) to (10) after warping the neighboring frames by predicted depth and motion.",)
    return Table("conditions", "Data without ground truth, by condition", columns, tuple(rows), notes) if rows else None


def table2(sizes: Mapping[str, tuple[int, int]]) -> tuple[Table, list[Missing]]:
    """Return the paper's Table 2 with the parameters of our networks."""
    rows = [Row((row.method, None, None, row.megaparameters), "published", "Published") for row in published().table2]
    rows += [
        Row((name, depth / 1e6, pose / 1e6 if pose else None, (depth + pose) / 1e6), "measured", "Counted here")
        for name, (depth, pose) in sizes.items()
    ]
    columns = (
        Column("Method"),
        Column("Depth network", ".1f"),
        Column("Pose network", ".1f"),
        Column("Together", ".1f"),
    )
    notes = ("Millions of parameters; the paper's unit is “Mb”.",)
    missing = [] if sizes else [Missing("Table 2, our rows", "no run has a checkpoint")]
    return Table("table2", "Table 2. Parameters", columns, tuple(rows), notes), missing


def table3(runs: Mapping[str, Run]) -> tuple[Table, list[Missing]]:
    """Return the paper's Table 3 with our runs of different encoders and decoders."""
    rows = [
        Row((row.method, _tick(row.stratified), _tick(row.attention), *row.errors), "published", PRINTED)
        for row in published().table3
    ]
    ours, _ = _scored({name: run for name, run in runs.items() if run.component("model/encoder")})
    models = [(name, score) for name, score in ours if not score.trivial]
    group = Groups(score for _, score in models)
    kinds = {_networks(runs[name]) for name, _ in models}
    columns = (Column("Method"), Column("STF-T"), Column("Attention"), *ERROR_COLUMNS)
    notes = ["The paper's first two rows are digit for digit Mono R18 and Mono R50 of its Table 1."]
    missing = []
    if len(kinds) > 1:
        rows += [
            Row((" + ".join(_networks(runs[name])), *_ticks(runs[name]), *score.errors), "measured", group(score))
            for name, score in models
        ]
        rest = [key for key in differing([runs[name] for name, _ in models]) if not key.startswith("model.")]
        if rest:
            notes.append(f"Our rows also differ in {', '.join(rest)}; the table of runs says how.")
    else:
        missing.append(Missing("Table 3, our rows", "no two scored runs differ in encoder or decoder"))
    return Table("table3", "Table 3. Ablation of the networks", columns, tuple(rows), tuple(notes)), missing


def runs_table(name: str, title: str, runs: Mapping[str, Run], *, swept: bool) -> Table:
    """Return runs with what sets them apart as columns, how they ended, and what they reached."""
    members = list(runs.values())
    keys = differing(members, by_overrides=swept)
    ratios = [ratio(run) for run in members]
    show_ratio = len({value for value in ratios if value is not None}) > 1
    columns = (
        Column("Run"),
        Column("Status"),
        *(Column(key) for key in keys),
        *((Column(RATIO),) if show_ratio else ()),
        Column("Epochs"),
        Column("Loss", ".4f"),
        ERROR_COLUMNS[0],
        ERROR_COLUMNS[2],
        ERROR_COLUMNS[4],
        Column("Minutes", ".1f"),
    )
    scores = chosen(runs)
    group = Groups(scores.values())
    several = len({group(score) for score in scores.values()}) > 1
    rows = []
    for (label, run), number in zip(runs.items(), ratios, strict=True):
        score = scores.get(label)
        rows.append(
            Row(
                (
                    label,
                    run.status,
                    *values(run, keys),
                    *((number,) if show_ratio else ()),
                    *_progress(run),
                    *((score.errors[0], score.errors[2], score.errors[4]) if score else (None, None, None)),
                    run.seconds / 60 if run.seconds is not None else None,
                ),
                "failed" if run.error else "measured",
                (group(score) if score else "Without a score") if several else "",
                note=run.error or "",
            )
        )
    if several:
        order = [*dict.fromkeys(map(group, scores.values())), "Without a score"]
        rows.sort(key=lambda row: order.index(row.group))
    return Table(name, title, columns, tuple(rows), _score_notes([group(score) for score in scores.values()]))


def networks(run: Run) -> str:
    """Return a run's networks in words, such as ``resnet18 + unet``."""
    return " + ".join(_networks(run))


def _progress(run: Run) -> tuple[Cell, Cell]:
    """Return how many epochs a run went and its last mean training loss."""
    losses = [row["train/loss"] for row in run.history if "train/loss" in row]
    epochs = [row["epoch"] for row in run.history if "epoch" in row]
    last = losses[-max(1, len(losses) // 10) :]
    return (int(max(epochs)) + 1 if epochs else None), (sum(last) / len(last) if last else None)


def _score_notes(groups: Sequence[str]) -> tuple[str, ...]:
    sources = list(dict.fromkeys(groups))
    notes = ["Loss: mean over the last tenth of the logged steps; losses of different weights do not compare."]
    if len(sources) == 1:
        notes.append(f"Errors — {sources[0]}.")
    elif sources:
        notes.append("Errors of different groups do not compare.")
    return tuple(notes)


def _scored(runs: Mapping[str, Run]) -> tuple[list[tuple[str, Score]], list[str]]:
    """Return every score once, group by group, and the runs without any; validation counts where nothing else is."""
    without = [name for name, run in runs.items() if not run.scores]
    pairs = []
    for name, run in runs.items():
        evaluated = [score for score in run.scores if not score.validation]
        pairs += [(name, score) for score in evaluated or run.scores]
    group = Groups(score for _, score in pairs)
    found: dict[str, list[tuple[str, Score]]] = {}
    told = set()
    for name, score in pairs:
        # Constant depth beside every evaluation of the same images; or a model that was evaluated twice alike.
        who = score.predictor if score.trivial else name
        key = (score.trivial, who, group(score), tuple(round(value, 6) for value in score.errors))
        if key not in told:
            told.add(key)
            found.setdefault(group(score), []).append((name, score))
    for members in found.values():
        members.sort(key=lambda pair: pair[1].trivial)  # trivial predictors last
    return [pair for members in found.values() for pair in members], without


def _no_score(run: Run) -> str:
    if run.error:
        return f"{run.status}: {run.error}"
    return "neither evaluated nor validated against depth; run saunet evaluate on its checkpoint"


def _pattern(run: Run, score: Score) -> str:
    if score.trivial or not run.config:
        return ""
    gradient = (run.config.get("objective") or {}).get("gradient") or {}
    data = run.config.get("data") or {}
    stereo = bool(data.get("stereo"))
    video = bool(data.get("offsets"))
    return "+".join((*(("D",) if gradient.get("target") == "lidar" else ()), "M" * video + "S" * stereo or "M"))


def _networks(run: Run) -> tuple[str, str]:
    return run.component("model/encoder"), run.component("model/decoder")


def _ticks(run: Run) -> tuple[str, str]:
    encoder, decoder = _networks(run)
    node = (run.config.get("model") or {}).get("decoder") or {}
    attention = decoder.lower().startswith("aunet") and node.get("attention") not in (None, "none")
    return _tick(encoder.lower().startswith("stratified")), _tick(attention)


def _tick(value: bool) -> str:
    return "✓" if value else ""
