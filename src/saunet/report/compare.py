"""Two or more runs against each other: differing settings, scores side by side, and a paired comparison."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich.box import HORIZONTALS
from rich.console import Console
from rich.markup import escape
from rich.table import Table as RichTable

from saunet.checks import ConfigError, DataError
from saunet.evaluation.result import Comparison, ImageRow
from saunet.evaluation.statistics import compare as paired
from saunet.evaluation.writers import read_rows
from saunet.report.document import Column, Row, Table
from saunet.report.inputs import Inputs
from saunet.report.runs import Run
from saunet.report.settings import differing, labels, values
from saunet.report.tables import ERRORS


def settings_table(runs: Mapping[str, Run]) -> Table:
    """Return the settings in which runs differ, a column a run."""
    members = list(runs.values())
    told = {name: values(run, differing(members)) for name, run in runs.items()}
    rows = [Row((key, *(told[name][index] for name in runs))) for index, key in enumerate(differing(members))]
    rows.append(Row(("status", *(f"{run.status}{f': {run.error}' if run.error else ''}" for run in members))))
    commits = [(run.record.get("git") or {}).get("commit") for run in members]
    if len(set(commits)) > 1:
        rows.append(Row(("code", *(str(commit or "unknown")[:12] for commit in commits))))
    return Table("settings", "Settings that differ", (Column("key"), *map(Column, runs)), tuple(rows))


def scores_table(runs: Mapping[str, Run]) -> Table:
    """Return the scores of runs side by side, grouped by what they were measured on."""
    scored = [(name, score) for name, run in runs.items() for score in run.scores if score.predictor == "model"]
    rows = [
        Row((name, *score.errors), "measured", f"{score.data}, protocol {score.protocol}, {score.images} images")
        for name, score in scored
    ]
    rows.sort(key=lambda row: row.group)
    return Table("scores", "Scores", (Column("run"), *ERRORS), tuple(rows))


def comparisons(runs: Mapping[str, Run]) -> tuple[list[Comparison], list[str]]:
    """Compare each run with the first one, image by image, under every protocol that both were evaluated with.

    Returns:
        The comparisons, and a sentence for each that could not be made.
    """
    names = list(runs)
    rows = {name: _rows(run) for name, run in runs.items()}
    found, left_out = [], []
    for other in names[1:]:
        common = [key for key in rows[names[0]] if key in rows[other]]
        if not common:
            left_out.append(
                f"{names[0]} and {other} were not both evaluated under one protocol, so nothing is paired; "
                "run saunet-evaluate on both checkpoints with the same data"
            )
        for key in common:
            try:
                found.append(paired(rows[names[0]][key], rows[other][key], names=(names[0], other)))
            except DataError as reason:
                left_out.append(f"{names[0]} and {other} under {key}: {reason}")
    return found, left_out


def comparison_table(comparison: Comparison) -> Table:
    """Return one paired comparison as a table."""
    columns = (
        Column("error"),
        Column(comparison.first, 4),
        Column(comparison.second, 4),
        Column("difference", 4),
        Column(f"{comparison.level:.0%} low", 4),
        Column(f"{comparison.level:.0%} high", 4),
        Column("second better", None),
        Column("p", 4),
    )
    rows = tuple(
        Row(
            (column.heading, one.first, one.second, one.difference, one.low, one.high, f"{one.better:.0%}", one.p_value)
        )
        for column, one in zip(ERRORS, comparison.differences, strict=True)
    )
    pair = f"{comparison.second} minus {comparison.first}"
    title = f"Paired on {comparison.images} images under {comparison.protocol}: {pair}"
    note = f"resampled: {comparison.groups} {comparison.by}s"
    return Table("paired", title, columns, rows, (note,))


def print_table(table: Table, console: Console) -> None:
    """Print a table of a report on the terminal."""
    shown = RichTable(
        title=f"[bold]{escape(table.title)}[/bold]", box=HORIZONTALS, show_edge=False, title_justify="left"
    )
    shown.title_style, shown.caption_justify = "", "left"
    for index, column in enumerate(table.columns):
        number = any(isinstance(row.cells[index], int | float) for row in table.rows)
        arrow = {-1: " ↓", 0: "", 1: " ↑"}[column.better]
        shown.add_column(escape(column.heading) + arrow, justify="right" if number else "left", overflow="fold")
    group = ""
    for row in table.rows:
        if row.group != group:
            group = row.group
            shown.add_row(f"[italic]{escape(group)}[/italic]")
        cells = [escape(table.text(row, index)) for index in range(len(row.cells))]
        shown.add_row(*(f"[bold]{cell}[/bold]" if table.best(row, index) else cell for index, cell in enumerate(cells)))
    if table.notes:
        shown.caption = escape(" ".join(table.notes))
    console.print(shown, "")


def _rows(run: Run) -> dict[str, Sequence[ImageRow]]:
    """Return the rows of a run's evaluations by protocol; of several under one protocol, the last."""
    found: dict[str, list[ImageRow]] = {}
    for folder in run.evaluations:
        if not (folder / "per_image.csv").is_file():
            continue
        table: dict[str, list[ImageRow]] = {}
        for row in read_rows(folder / "per_image.csv"):
            if row.predictor == "model":
                table.setdefault(row.protocol, []).append(row)
        found |= table
    return dict(found)


def print_comparison(inputs: Inputs, wanted: Sequence[str], console: Console) -> None:
    """Print everything that this file can say about the runs.

    Args:
        inputs: The runs.
        wanted: Their names; made from what sets them apart if empty.
        console: Where.

    Raises:
        ConfigError: if there are not as many names as runs.
        DataError: if there are fewer than two runs.
    """
    members = inputs.all_runs
    if len(members) < 2:
        raise DataError(f"{len(members)} run is not enough to compare; name two or more: saunet-report compare A B")
    if wanted and len(set(wanted)) != len(members):
        raise ConfigError(f"labels holds {len(set(wanted))} names for {len(members)} runs; give each its own")
    runs = dict(zip(wanted or labels([members])[0], members, strict=True))
    print_table(settings_table(runs), console)
    scores = scores_table(runs)
    if scores.rows:
        print_table(scores, console)
    found, left_out = comparisons(runs)
    for comparison in found:
        print_table(comparison_table(comparison), console)
    for sentence in left_out:
        console.print(f"left out: {escape(sentence)}")
