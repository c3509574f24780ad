"""Files of an evaluation: writing them, and reading rows back for comparisons."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, astuple, fields
from pathlib import Path
from typing import Any, TypeVar

from saunet.errors import DataError
from saunet.evaluation.result import EvaluationResult
from saunet.evaluation.rows import BucketRow, Difference, ImageRow, ShapeRow, Spread, Summary, ViewRow, ViewSummary
from saunet.io.atomic import write_bytes, write_json
from saunet.metrics.functional import ERROR_NAMES
from saunet.tables import csv_text

T = TypeVar("T")


def markdown(result: EvaluationResult) -> str:
    """Return all tables as Markdown, intervals as ranges."""
    return "\n\n".join([*(table.markdown() for table in result.tables(ranges=True)), *result.warnings]) + "\n"


def write_results(result: EvaluationResult, folder: Path) -> dict[str, Path]:
    """Write ``metrics.json``, ``metrics.csv``, ``metrics.md`` and ``per_image.csv``, each whole or not at all.

    The rest of the result goes to ``buckets.csv``, ``shapes.csv`` and ``views.csv`` (one image per line) and
    ``comparison.csv``.
    """
    texts = {"per_image.csv": _csv(ImageRow, result.rows), "metrics.csv": _means(result)}
    if result.buckets:
        texts["buckets.csv"] = _csv(BucketRow, result.buckets)
    if result.shapes:
        texts["shapes.csv"] = _csv(ShapeRow, result.shapes)
    if result.views:
        texts["views.csv"] = _csv(ViewRow, result.views)
    if result.comparisons:
        lines = ((c.protocol, c.first, c.second, *astuple(d)) for c in result.comparisons for d in c.differences)
        names = ("protocol", "before", "now", "error", "mean_before", "mean_now", *_names(Difference)[3:])
        texts["comparison.csv"] = csv_text(names, lines)
    texts["metrics.md"] = markdown(result)
    for name, text in texts.items():
        write_bytes(folder / name, text.encode())
    for name in {"buckets.csv", "shapes.csv", "views.csv", "comparison.csv"} - texts.keys():
        (folder / name).unlink(missing_ok=True)  # from an earlier evaluation in this folder, replaced by these
    write_json(folder / "metrics.json", as_json(result))
    return {name: folder / name for name in (*texts, "metrics.json")}


def as_json(result: EvaluationResult) -> dict[str, object]:
    """Return the summaries and the exact rules they were computed under as plain data; NaN becomes None.

    ``images`` holds the `fingerprint` of each protocol's images, to check whether numbers are comparable.
    """
    content: dict[str, object] = {
        "settings": dict(result.settings),
        "protocols": [asdict(protocol) for protocol in result.protocols],
        "results": [_summary(summary, result.spreads) for summary in result.summaries()],
        "images": {protocol.name: result.fingerprint(protocol.name) for protocol in result.protocols},
    }
    if result.spreads:
        spread = result.spreads[0]
        content["intervals"] = {"level": spread.level, "by": spread.by, "groups": spread.groups}
    rest = {
        "buckets": [_plain(row) for row in result.buckets],
        "shapes": [_plain(shape) for shape in result.shape_summaries()],
        "views": [_plain(view) for view in result.view_summaries()],
        "comparisons": [asdict(comparison) for comparison in result.comparisons],
        "warnings": list(result.warnings),
    }
    plain: dict[str, object] = without_nan(content | {key: value for key, value in rest.items() if value})
    return plain


def image_size(settings: object) -> tuple[int, int] | None:
    """Return the height and width that an evaluation recorded in its settings; None if it did not."""
    size = settings.get("size") if isinstance(settings, Mapping) else None
    if isinstance(size, Sequence) and len(size) == 2 and all(isinstance(each, int) for each in size):
        return size[0], size[1]
    return None


def read_rows(path: Path) -> tuple[ImageRow | ViewRow, ...]:
    """Read the rows of an evaluation back, for comparisons, from its folder or its ``per_image.csv``."""
    path = path / "per_image.csv" if path.is_dir() else path
    views = path.with_name("views.csv")
    return (*_read(path, ImageRow, _image), *(_read(views, ViewRow, _view) if views.is_file() else ()))


def _image(row: Mapping[str, str]) -> ImageRow:
    start = (row["predictor"], row["protocol"], row["name"], int(row["pixels"]), float(row["scale"] or math.nan))
    return ImageRow(*start, tuple(float(row[name] or math.nan) for name in ERROR_NAMES))


def _view(row: Mapping[str, str]) -> ViewRow:
    numbers = (float(row[name] or math.nan) for name in ("warped", "unwarped", "explained", "visible"))
    return ViewRow(row["predictor"], row["protocol"], row["name"], row["condition"], *numbers)


def _read(path: Path, kind: type, made: Callable[[Mapping[str, str]], T]) -> list[T]:
    try:
        with path.open(encoding="utf-8", newline="") as file:
            table = csv.DictReader(file)
            missing = [name for name in _names(kind) if name not in (table.fieldnames or ())]
            if missing:
                raise DataError(f"'{path}' has no column '{missing[0]}'; give a {path.name} written by an evaluation")
            return list(map(made, table))
    except DataError:
        raise
    except OSError as error:
        raise DataError(f"cannot read '{path}': {error.strerror}; give a per_image.csv of an evaluation") from error
    except (ValueError, TypeError, csv.Error) as error:
        raise DataError(f"'{path}' has a line that is not a row of numbers ({error}); evaluate again") from error


def without_nan(value: Any) -> Any:
    """Return plain data with None instead of NaN, which JSON does not have."""
    if isinstance(value, dict):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(item) for item in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def _names(kind: type) -> list[str]:
    """Return the names of a row's values, each error under its own name."""
    names = (each.name for each in fields(kind))
    return [each for name in names for each in (ERROR_NAMES if name == "errors" else (name,))]


def _plain(row: Any) -> dict[str, Any]:
    values = (getattr(row, each.name) for each in fields(row))
    flat = [each for value in values for each in (value if isinstance(value, tuple) else (value,))]
    return dict(zip(_names(type(row)), flat, strict=True))


def _csv(kind: type, rows: Iterable[Any]) -> str:
    return csv_text(_names(kind), (tuple(_plain(row).values()) for row in rows))


def _means(result: EvaluationResult) -> str:
    """Return the means as CSV: with ground truth, without it, or both, each with the columns that it has."""
    summaries = [_summary(summary, result.spreads) for summary in result.summaries()]
    views = [_plain(view) for view in result.view_summaries()]
    header = ["predictor", "protocol"]
    if summaries:
        header += [*_names(Summary), *(f"{name}_{end}" for end in ("low", "high") for name in ERROR_NAMES)]
    header = list(dict.fromkeys([*header, *(_names(ViewSummary) if views else ())]))
    return csv_text(header, ([row.get(name) for name in header] for row in (*summaries, *views)))


def _summary(summary: Summary, spreads: Sequence[Spread]) -> dict[str, object]:
    row = _plain(summary)
    for spread in spreads:
        if (spread.predictor, spread.protocol) == (summary.predictor, summary.protocol):
            for end, values in (("low", spread.low), ("high", spread.high)):
                row |= {f"{name}_{end}": value for name, value in zip(ERROR_NAMES, values, strict=True)}
    return row
