"""An evaluation as files (Markdown, JSON, CSV), and read back from them."""

from __future__ import annotations

import csv
import dataclasses
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from saunet.errors import DataError
from saunet.evaluation.result import EvaluationResult, ImageRow, Spread, Summary
from saunet.io.atomic import write_bytes, write_json
from saunet.metrics.functional import ERROR_NAMES
from saunet.tables import csv_text

_ROW_FIELDS = ("predictor", "protocol", "name", "pixels", "scale", *ERROR_NAMES)
_SUMMARY_FIELDS = (
    *("predictor", "protocol", *ERROR_NAMES, "scale", "scale_std", "images", "images_without_truth"),
    *(f"{name}_{end}" for end in ("low", "high") for name in ERROR_NAMES),
)
_BUCKET_FIELDS = ("predictor", "protocol", "group", "bucket", "pixels", *ERROR_NAMES)
_VIEW_FIELDS = ("predictor", "protocol", "name", "condition", "warped", "unwarped", "explained", "visible")
_COMPARISON_FIELDS = (
    *("protocol", "before", "now", "error", "mean_before", "mean_now", "difference", "low", "high"),
    *("better", "p_value"),
)


def markdown(result: EvaluationResult) -> str:
    """Return all tables as Markdown, intervals as ranges."""
    return "\n\n".join([*(table.markdown() for table in result.tables(ranges=True)), *result.warnings]) + "\n"


def write_results(result: EvaluationResult, folder: Path) -> dict[str, Path]:
    """Write ``metrics.json``, ``metrics.csv``, ``metrics.md`` and ``per_image.csv``, each whole or not at all.

    What else the result holds goes to ``buckets.csv``, ``views.csv`` (an image a line) and ``comparison.csv``.
    """
    summaries = [_summary_dict(summary, result.spreads) for summary in result.summaries()]
    rows = ((row.predictor, row.protocol, row.name, row.pixels, row.scale, *row.errors) for row in result.rows)
    tables: dict[str, tuple[Sequence[str], Iterable[Sequence[object]]]] = {
        "per_image.csv": (_ROW_FIELDS, rows),
        "metrics.csv": (_SUMMARY_FIELDS, ([row.get(name) for name in _SUMMARY_FIELDS] for row in summaries)),
    }
    if result.buckets:
        places = ((r.predictor, r.protocol, r.group, r.bucket, r.pixels, *r.errors) for r in result.buckets)
        tables["buckets.csv"] = (_BUCKET_FIELDS, places)
    if result.views:
        tables["views.csv"] = (_VIEW_FIELDS, map(dataclasses.astuple, result.views))
    if result.comparisons:
        lines = [
            (c.protocol, c.first, c.second, *dataclasses.astuple(d)) for c in result.comparisons for d in c.differences
        ]
        tables["comparison.csv"] = (_COMPARISON_FIELDS, lines)
    paths = {name: folder / name for name in (*tables, "metrics.md", "metrics.json")}
    for name, (header, content) in tables.items():
        write_bytes(paths[name], csv_text(header, content).encode())
    write_bytes(paths["metrics.md"], markdown(result).encode())
    write_json(paths["metrics.json"], as_json(result))
    return paths


def as_json(result: EvaluationResult) -> dict[str, object]:
    """Return the summaries and the exact rules they were computed under as plain data; NaN becomes None.

    ``images`` holds the `fingerprint` of each protocol's images, by which others tell whether numbers compare.
    """
    content: dict[str, object] = {
        "settings": dict(result.settings),
        "protocols": [dataclasses.asdict(protocol) for protocol in result.protocols],
        "results": [_summary_dict(summary, result.spreads) for summary in result.summaries()],
        "images": {protocol.name: result.fingerprint(protocol.name) for protocol in result.protocols},
    }
    if result.spreads:
        spread = result.spreads[0]
        content["intervals"] = {"level": spread.level, "by": spread.by, "groups": spread.groups}
    if result.buckets:
        content["buckets"] = [_named_errors(dataclasses.asdict(row)) for row in result.buckets]
    if result.views:
        content["views"] = [dataclasses.asdict(view) for view in result.view_summaries()]
    if result.comparisons:
        content["comparisons"] = [dataclasses.asdict(comparison) for comparison in result.comparisons]
    if result.warnings:
        content["warnings"] = list(result.warnings)
    plain: dict[str, object] = without_nan(content)
    return plain


def read_rows(path: Path) -> tuple[ImageRow, ...]:
    """Read the rows of an evaluation back, for comparisons."""
    path = path / "per_image.csv" if path.is_dir() else path
    try:
        with path.open(encoding="utf-8", newline="") as file:
            table = csv.DictReader(file)
            missing = [name for name in _ROW_FIELDS if name not in (table.fieldnames or ())]
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
    except DataError:
        raise
    except OSError as error:
        raise DataError(f"cannot read '{path}': {error.strerror}; give a per_image.csv of an evaluation") from error
    except (ValueError, TypeError, csv.Error) as error:
        raise DataError(f"'{path}' holds a line that is not a row of numbers ({error}); evaluate again") from error


def without_nan(value: Any) -> Any:
    """Return plain data with None in place of NaN, which JSON cannot hold."""
    if isinstance(value, dict):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(item) for item in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def _named_errors(row: dict[str, Any]) -> dict[str, Any]:
    errors = row.pop("errors")
    return {**row, **dict(zip(ERROR_NAMES, errors, strict=True))}


def _summary_dict(summary: Summary, spreads: Sequence[Spread]) -> dict[str, object]:
    row = _named_errors(dataclasses.asdict(summary))
    for spread in spreads:
        if (spread.predictor, spread.protocol) == (summary.predictor, summary.protocol):
            for end, values in (("low", spread.low), ("high", spread.high)):
                row |= {f"{name}_{end}": value for name, value in zip(ERROR_NAMES, values, strict=True)}
    return row
