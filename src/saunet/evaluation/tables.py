"""An evaluation as tables on the terminal."""

from __future__ import annotations

from collections.abc import Sequence

from rich.box import HORIZONTALS
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from saunet.evaluation.breakdown import BucketRow
from saunet.evaluation.result import Comparison, EvaluationResult, Spread, Summary, ViewRow
from saunet.evaluation.views import summarize_views
from saunet.metrics.functional import ERROR_HEADINGS, HIGHER_IS_BETTER
from saunet.metrics.protocols import Protocol

VIEW_HEADINGS: tuple[str, ...] = ("warped ↓", "unwarped", "explained ↑", "visible")
"""Column headings of what is measured without ground truth."""


def print_table(result: EvaluationResult, console: Console | None = None) -> None:
    """Print one table a protocol, the best of each column in bold, then what else the result holds.

    Where the errors are is shown for the first predictor alone.
    """
    console = console or Console()
    summaries = result.summaries()
    for protocol in result.protocols:
        mine = [s for s in summaries if s.protocol == protocol.name]
        if mine:
            console.print(protocol_table(protocol, mine, result.spreads), "")
        views = [row for row in result.views if row.protocol == protocol.name]
        if views:
            console.print(view_table(protocol, views), "")
    for protocol in result.protocols:  # of the others, the places of their errors are in the files
        rows = [r for r in result.buckets if (r.protocol, r.predictor) == (protocol.name, result.predictors[0])]
        if rows:
            console.print(bucket_table(rows), "")
    for comparison in result.comparisons:
        console.print(comparison_table(comparison), "")


def protocol_table(protocol: Protocol, summaries: Sequence[Summary], spreads: Sequence[Spread] = ()) -> Table:
    """Return the table of one protocol: errors to three decimals, how sure they are, and the scale found."""
    table = _error_table(f"[bold]{protocol.name}[/bold]: {protocol.summary}", "predictor", "scale")
    best = _best(summaries)
    known = {(spread.predictor, spread.protocol): spread for spread in spreads}
    note = images_note(summaries[0])
    for summary in summaries:
        cells = [
            f"[bold]{value:.3f}[/bold]" if len(summaries) > 1 and value == top else f"{value:.3f}"
            for value, top in zip(summary.errors, best, strict=True)
        ]
        table.add_row(escape(summary.predictor), *cells, f"{summary.scale:.3g} ± {summary.scale_std:.2g}")
        spread = known.get((summary.predictor, summary.protocol))
        if spread is not None:
            halves = (f"±{(high - low) / 2:.3f}" for low, high in zip(spread.low, spread.high, strict=True))
            table.add_row("", *halves, "", style="dim")
            note = f"{images_note(summaries[0])}; {spread_note(spread)}"
    if summaries:
        table.caption = note
    return table


def spread_note(spread: Spread | Comparison) -> str:
    """Return what intervals mean, such as ``± 95 % bootstrap over 28 drives``."""
    note = f"± {spread.level:.0%} bootstrap over {spread.groups} {spread.by}s".replace("%", " %")
    return note if spread.by == "drive" else f"{note}, which are alike: too narrow"


def view_table(protocol: Protocol, rows: Sequence[ViewRow]) -> Table:
    """Return the table of what is measured without ground truth, by predictor and condition."""
    table = plain_table(f"[bold]{protocol.name}[/bold]: {protocol.summary}")
    table.add_column("predictor", min_width=9)
    table.add_column("condition", min_width=9)
    for heading in VIEW_HEADINGS:
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("images", justify="right", no_wrap=True)
    for _, predictor, group, images, values in summarize_views(rows):
        table.add_row(escape(predictor), escape(group), *(f"{value:.4f}" for value in values), f"{images:,}")
    table.caption = "photometric errors of neighbors, warped and as they are; shares of pixels"
    return table


def bucket_table(rows: Sequence[BucketRow]) -> Table:
    """Return the table of one predictor's errors by distance, region and edges under one protocol."""
    title = f"[bold]{rows[0].protocol}[/bold]: where the errors of '{escape(rows[0].predictor)}' are"
    table = _error_table(title, "where", "pixels")
    for row, following in zip(rows, (*rows[1:], None), strict=True):
        ends = following is not None and following.group != row.group
        table.add_row(row.bucket, *(f"{value:.3f}" for value in row.errors), f"{row.pixels:,}", end_section=ends)
    table.caption = "over pixels, not images"
    return table


def comparison_table(comparison: Comparison) -> Table:
    """Return the table of two predictors' differences; bold where the interval leaves out zero."""
    first, second = escape(comparison.first), escape(comparison.second)
    table = plain_table(f"[bold]{comparison.protocol}[/bold]: '{second}' against '{first}'")
    table.add_column("error", min_width=10)
    for heading in ("before", "now", "difference", f"{comparison.level:.0%} interval", "better on", "p"):
        table.add_column(heading, justify="right", no_wrap=True)
    for heading, row, up in zip(ERROR_HEADINGS, comparison.differences, HIGHER_IS_BETTER, strict=True):
        sure = row.low > 0 or row.high < 0
        difference = f"{row.difference:+.4f}"
        if sure:
            color = "green" if (row.difference > 0) == up else "red"
            difference = f"[bold {color}]{difference}[/]"
        table.add_row(
            heading,
            f"{row.first:.4f}",
            f"{row.second:.4f}",
            difference,
            f"{row.low:+.4f} {row.high:+.4f}",
            f"{row.better:.0%}",
            f"{row.p_value:.2g}",
        )
    table.caption = f"{comparison.images} images, paired; {spread_note(comparison)}".replace("± ", "")
    return table


def images_note(summary: Summary) -> str:
    """Return how many images a summary stands for, such as ``697 images``, and how many had no ground truth."""
    note = f"{summary.images} image{'' if summary.images == 1 else 's'}"
    if summary.images_without_truth:
        note += f"; {summary.images_without_truth} more without a ground-truth pixel to compare, left out"
    return note


def _error_table(title: str, first: str, last: str) -> Table:
    """An empty table that fits a terminal of 80 columns: headings on two lines, no vertical rules."""
    table = plain_table(title)
    table.add_column(first, min_width=9)
    for heading in ERROR_HEADINGS:
        name, arrow = heading.rsplit(" ", 1)
        table.add_column(f"{name.replace(' ', chr(10))} {arrow}", justify="right", no_wrap=True, min_width=6)
    table.add_column(last, justify="right", no_wrap=True)
    return table


def plain_table(title: str) -> Table:
    """Return an empty table without vertical rules, title and caption on the left."""
    table = Table(title=title, box=HORIZONTALS, padding=0, show_edge=False, title_justify="left", title_style="")
    table.caption_justify = "left"
    return table


def _best(summaries: Sequence[Summary]) -> list[float]:
    columns = zip(*(summary.errors for summary in summaries), strict=True)
    return [max(column) if up else min(column) for column, up in zip(columns, HIGHER_IS_BETTER, strict=True)]
