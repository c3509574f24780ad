"""An evaluation as Markdown, JSON and CSV."""

from __future__ import annotations

import csv
import dataclasses
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

from saunet.errors import DataError
from saunet.evaluation.result import Comparison, EvaluationResult, ImageRow, Spread, Summary
from saunet.evaluation.tables import VIEW_HEADINGS, images_note, spread_note
from saunet.evaluation.views import summarize_views
from saunet.io.atomic import replacing, write_json
from saunet.metrics.functional import ERROR_HEADINGS, ERROR_NAMES

_ROW_FIELDS = ("predictor", "protocol", "name", "pixels", "scale", *ERROR_NAMES)
_SUMMARY_FIELDS = (
    "predictor",
    "protocol",
    *ERROR_NAMES,
    "scale",
    "scale_std",
    "images",
    "images_without_truth",
    *(f"{name}_{end}" for end in ("low", "high") for name in ERROR_NAMES),
)
_VIEW_FIELDS = ("predictor", "protocol", "name", "condition", "warped", "unwarped", "explained", "visible")
_COMPARISON_FIELDS = ("protocol", "before", "now", "error", "mean_before", "mean_now", "difference", "low", "high")


def markdown(result: EvaluationResult) -> str:
    """Return the tables as Markdown: means, with their intervals below where they were asked for, and comparisons."""
    parts = []
    summaries, spreads = result.summaries(), {(s.predictor, s.protocol): s for s in result.spreads}
    for protocol in result.protocols:
        mine = [s for s in summaries if s.protocol == protocol.name]
        if mine:
            found = [spreads[s.predictor, s.protocol] for s in mine if (s.predictor, s.protocol) in spreads]
            note = "; ".join([images_note(mine[0]), *(spread_note(spread) for spread in found[:1])])
            table = [f"**{protocol.name}**: {protocol.summary} ({note})", "", *_header("predictor", *ERROR_HEADINGS)]
            for summary in mine:
                table.append(_line(summary.predictor, *(f"{value:.3f}" for value in summary.errors)))
                spread = spreads.get((summary.predictor, summary.protocol))
                if spread is not None:
                    ends = zip(spread.low, spread.high, strict=True)
                    table.append(_line("", *(f"{low:.3f} to {high:.3f}" for low, high in ends)))
            parts.append("\n".join(table))
        views = summarize_views([row for row in result.views if row.protocol == protocol.name])
        if views:
            table = [f"**{protocol.name}**: {protocol.summary}", "", *_header("predictor", "condition", *VIEW_HEADINGS)]
            table += [_line(who, group, *(f"{value:.4f}" for value in values)) for _, who, group, _, values in views]
            parts.append("\n".join(table))
    for comparison in result.comparisons:
        columns = ("error", "before", "now", "difference", "interval", "better on", "p")
        title = f"**{comparison.protocol}**: '{comparison.second}' against '{comparison.first}'"
        table = [f"{title} ({comparison.images} images, paired)", "", *_header(*columns)]
        for heading, row in zip(ERROR_HEADINGS, comparison.differences, strict=True):
            numbers = (f"{row.first:.4f}", f"{row.second:.4f}", f"{row.difference:+.4f}")
            interval = f"{row.low:+.4f} to {row.high:+.4f}"
            table.append(_line(heading, *numbers, interval, f"{row.better:.0%}", f"{row.p_value:.2g}"))
        parts.append("\n".join(table))
    return "\n\n".join(parts) + "\n"


def write_results(result: EvaluationResult, folder: Path) -> dict[str, Path]:
    """Write ``metrics.json``, ``metrics.csv``, ``metrics.md`` and ``per_image.csv``, each whole or not at all.

    What else the result holds goes to ``buckets.csv``, ``views.csv`` (an image a line) and ``comparison.csv``.

    Returns:
        The files by those names.

    Raises:
        DataError: if the folder cannot be written to.
    """
    spreads = {(s.predictor, s.protocol): s for s in result.spreads}
    summaries = [_summary_dict(summary, spreads) for summary in result.summaries()]
    tables: dict[str, tuple[Sequence[str], Iterable[Sequence[object]]]] = {
        "per_image.csv": (
            _ROW_FIELDS,
            ((r.predictor, r.protocol, r.name, r.pixels, r.scale, *r.errors) for r in result.rows),
        ),
        "metrics.csv": (_SUMMARY_FIELDS, ([row.get(field, "") for field in _SUMMARY_FIELDS] for row in summaries)),
    }
    if result.buckets:
        places = ((r.predictor, r.protocol, r.group, r.bucket, r.pixels, *r.errors) for r in result.buckets)
        tables["buckets.csv"] = (("predictor", "protocol", "group", "bucket", "pixels", *ERROR_NAMES), places)
    if result.views:
        tables["views.csv"] = (_VIEW_FIELDS, map(dataclasses.astuple, result.views))
    if result.comparisons:
        lines = [_comparison_lines(comparison) for comparison in result.comparisons]
        tables["comparison.csv"] = (
            (*_COMPARISON_FIELDS, "better", "p_value"),
            [line for part in lines for line in part],
        )
    paths = {name: folder / name for name in (*tables, "metrics.md", "metrics.json")}
    for name, (header, content) in tables.items():
        with _whole(paths[name]) as file:
            _write_csv(file, header, content)
    with _whole(paths["metrics.md"]) as file:
        file.write(markdown(result))
    write_json(paths["metrics.json"], as_json(result))
    return paths


def as_json(result: EvaluationResult) -> dict[str, object]:
    """Return the summaries and the exact rules they were computed under as plain data; NaN becomes None.

    ``images`` holds the `fingerprint` of each protocol's images, by which others tell whether numbers compare.
    """
    spreads = {(s.predictor, s.protocol): s for s in result.spreads}
    content: dict[str, object] = {
        "settings": dict(result.settings),
        "protocols": [dataclasses.asdict(protocol) for protocol in result.protocols],
        "results": [_summary_dict(summary, spreads) for summary in result.summaries()],
        "images": {protocol.name: result.fingerprint(protocol.name) for protocol in result.protocols},
    }
    if result.spreads:
        spread = result.spreads[0]
        content["intervals"] = {"level": spread.level, "by": spread.by, "groups": spread.groups}
    if result.buckets:
        content["buckets"] = [
            {**_without_errors(row), **dict(zip(ERROR_NAMES, row.errors, strict=True))} for row in result.buckets
        ]
    if result.views:
        content["views"] = [
            {"protocol": rules, "predictor": who, "condition": group, "images": images}
            | dict(zip(_VIEW_FIELDS[4:], values, strict=True))
            for rules, who, group, images, values in summarize_views(result.views)
        ]
    if result.comparisons:
        content["comparisons"] = [dataclasses.asdict(comparison) for comparison in result.comparisons]
    plain: dict[str, object] = without_nan(content)
    return plain


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


def _summary_dict(summary: Summary, spreads: Mapping[tuple[str, str], Spread]) -> dict[str, object]:
    row = dataclasses.asdict(summary)
    errors = dict(zip(ERROR_NAMES, row.pop("errors"), strict=True))
    plain = {"predictor": row.pop("predictor"), "protocol": row.pop("protocol"), **errors, **row}
    spread = spreads.get((summary.predictor, summary.protocol))
    if spread is not None:
        for end, values in (("low", spread.low), ("high", spread.high)):
            plain |= {f"{name}_{end}": value for name, value in zip(ERROR_NAMES, values, strict=True)}
    return plain


def _comparison_lines(comparison: Comparison) -> list[Sequence[object]]:
    who = (comparison.protocol, comparison.first, comparison.second)
    return [(*who, *dataclasses.astuple(difference)) for difference in comparison.differences]


def _without_errors(row: object) -> dict[str, object]:
    plain = dataclasses.asdict(row)  # type: ignore[call-overload]
    return {key: value for key, value in plain.items() if key != "errors"}


def without_nan(value: Any) -> Any:
    """Return plain data with None in place of NaN, which JSON cannot hold."""
    if isinstance(value, dict):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(item) for item in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def _header(*columns: str) -> list[str]:
    return [_line(*columns), f"|---|{'---:|' * (len(columns) - 1)}"]


def _line(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def _write_csv(file: TextIO, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    writer = csv.writer(file)
    writer.writerow(header)
    for row in rows:
        writer.writerow(["" if isinstance(cell, float) and math.isnan(cell) else cell for cell in row])
