"""An evaluation as a table on the terminal, as Markdown, JSON and CSV."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from rich.box import HORIZONTALS
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from saunet.atomic import replacing
from saunet.checks import DataError
from saunet.evaluation.breakdown import BucketRow
from saunet.evaluation.result import EvaluationResult, ImageRow, Summary
from saunet.metrics.functional import ERROR_NAMES, HIGHER_IS_BETTER
from saunet.metrics.protocols import Protocol

HEADINGS: tuple[str, ...] = ("Abs Rel ↓", "Sq Rel ↓", "RMSE ↓", "RMSE log ↓", "δ1 ↑", "δ2 ↑", "δ3 ↑")
"""Column headings in the order of `ERROR_NAMES`; the arrow points to better."""

_ROW_FIELDS = ("predictor", "protocol", "name", "pixels", "scale", *ERROR_NAMES)
_SUMMARY_FIELDS = ("predictor", "protocol", *ERROR_NAMES, "scale", "scale_std", "images", "images_without_truth")


def print_table(result: EvaluationResult, console: Console | None = None) -> None:
    """Print one table a protocol, the best of each column in bold, then where the errors are, if that was asked for."""
    console = console or Console()
    for protocol in result.protocols:
        console.print(protocol_table(protocol, [s for s in result.summaries() if s.protocol == protocol.name]), "")
    for protocol in result.protocols:
        for predictor in result.predictors:
            rows = [r for r in result.buckets if (r.protocol, r.predictor) == (protocol.name, predictor)]
            if rows:
                console.print(bucket_table(rows), "")


def protocol_table(protocol: Protocol, summaries: Sequence[Summary]) -> Table:
    """Return the table of one protocol: errors to three decimals, the images behind them and the scale found."""
    table = _error_table(f"[bold]{protocol.name}[/bold]: {protocol.summary}", "predictor", "scale")
    best = _best(summaries)
    for summary in summaries:
        cells = [
            f"[bold]{value:.3f}[/bold]" if len(summaries) > 1 and value == top else f"{value:.3f}"
            for value, top in zip(summary.errors, best, strict=True)
        ]
        table.add_row(escape(summary.predictor), *cells, f"{summary.scale:.3g} ± {summary.scale_std:.2g}")
    if summaries:
        table.caption = images_note(summaries[0])
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


def _error_table(title: str, first: str, last: str) -> Table:
    """An empty table that fits a terminal of 80 columns: headings on two lines, no vertical rules."""
    table = Table(title=title, box=HORIZONTALS, padding=0, show_edge=False, title_justify="left", title_style="")
    table.caption_justify = "left"
    table.add_column(first, min_width=9)
    for heading in HEADINGS:
        name, arrow = heading.rsplit(" ", 1)
        table.add_column(f"{name.replace(' ', chr(10))} {arrow}", justify="right", no_wrap=True, min_width=6)
    table.add_column(last, justify="right", no_wrap=True)
    return table


def images_note(summary: Summary) -> str:
    """Return how many images a summary stands for, such as ``697 images``, and how many had no ground truth."""
    note = f"{summary.images} image{'' if summary.images == 1 else 's'}"
    if summary.images_without_truth:
        note += f"; {summary.images_without_truth} more without a ground-truth pixel to compare, left out"
    return note


def markdown(result: EvaluationResult) -> str:
    """Return the tables as Markdown."""
    parts = []
    for protocol in result.protocols:
        summaries = [s for s in result.summaries() if s.protocol == protocol.name]
        lines = [
            f"**{protocol.name}**: {protocol.summary} ({images_note(summaries[0])})",
            "",
            f"| predictor | {' | '.join(HEADINGS)} |",
            f"|---|{'---:|' * len(HEADINGS)}",
            *(f"| {s.predictor} | {' | '.join(f'{value:.3f}' for value in s.errors)} |" for s in summaries),
        ]
        parts.append("\n".join(lines))
    return "\n\n".join(parts) + "\n"


def write_results(result: EvaluationResult, folder: Path) -> dict[str, Path]:
    """Write ``metrics.json``, ``metrics.csv``, ``metrics.md`` and ``per_image.csv``, each whole or not at all.

    Errors by bucket go to ``buckets.csv``, if there are any.

    Returns:
        The files by those names.

    Raises:
        DataError: if the folder cannot be written to.
    """
    paths = {name: folder / name for name in ("metrics.json", "metrics.csv", "metrics.md", "per_image.csv")}
    with _whole(paths["per_image.csv"]) as file:
        _write_csv(file, _ROW_FIELDS, ((*_key(row), row.pixels, row.scale, *row.errors) for row in result.rows))
    with _whole(paths["metrics.csv"]) as file:
        table = ([_summary_dict(s)[field] for field in _SUMMARY_FIELDS] for s in result.summaries())
        _write_csv(file, _SUMMARY_FIELDS, table)
    if result.buckets:
        paths["buckets.csv"] = folder / "buckets.csv"
        with _whole(paths["buckets.csv"]) as file:
            places = ((r.predictor, r.protocol, r.group, r.bucket, r.pixels, *r.errors) for r in result.buckets)
            _write_csv(file, ("predictor", "protocol", "group", "bucket", "pixels", *ERROR_NAMES), places)
    with _whole(paths["metrics.md"]) as file:
        file.write(markdown(result))
    with _whole(paths["metrics.json"]) as file:
        json.dump(as_json(result), file, indent=2, ensure_ascii=False, allow_nan=False)
        file.write("\n")
    return paths


def as_json(result: EvaluationResult) -> dict[str, object]:
    """Return the summaries and the exact rules they were computed under as plain data; NaN becomes None."""
    summaries = [
        {key: None if isinstance(value, float) and math.isnan(value) else value for key, value in row.items()}
        for row in map(_summary_dict, result.summaries())
    ]
    return {"protocols": [dataclasses.asdict(protocol) for protocol in result.protocols], "results": summaries}


def read_rows(path: Path) -> tuple[ImageRow, ...]:
    """Read a ``per_image.csv`` back, for comparisons with another run.

    Raises:
        DataError: if the file is missing or is not such a table.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            table = csv.DictReader(file)
            missing = [field for field in _ROW_FIELDS if field not in (table.fieldnames or ())]
            if missing:
                raise DataError(f"'{path}' has no column '{missing[0]}'; give a per_image.csv written by an evaluation")
            return tuple(
                ImageRow(
                    row["predictor"],
                    row["protocol"],
                    row["name"],
                    int(row["pixels"]),
                    float(row["scale"] or math.nan),
                    tuple(float(row[name] or math.nan) for name in ERROR_NAMES),
                )
                for row in table
            )
    except OSError as error:
        raise DataError(f"cannot read '{path}': {error.strerror}; give a per_image.csv of an evaluation") from error
    except (ValueError, TypeError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(f"'{path}' holds a line that is not a row of numbers ({error}); evaluate again") from error


@contextmanager
def _whole(path: Path) -> Iterator[TextIO]:
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        yield file


def _best(summaries: Sequence[Summary]) -> list[float]:
    columns = zip(*(summary.errors for summary in summaries), strict=True)
    return [max(column) if up else min(column) for column, up in zip(columns, HIGHER_IS_BETTER, strict=True)]


def _key(row: ImageRow) -> tuple[str, str, str]:
    return row.predictor, row.protocol, row.name


def _summary_dict(summary: Summary) -> dict[str, object]:
    row = dataclasses.asdict(summary)
    errors = dict(zip(ERROR_NAMES, row.pop("errors"), strict=True))
    return {"predictor": row.pop("predictor"), "protocol": row.pop("protocol"), **errors, **row}


def _write_csv(file: TextIO, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    writer = csv.writer(file)
    writer.writerow(header)
    for row in rows:
        writer.writerow(["" if isinstance(cell, float) and math.isnan(cell) else cell for cell in row])
