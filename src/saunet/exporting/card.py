"""A model's card: what it is, its training, its accuracy, and how to use its output. The text is in templates."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from saunet.exporting.parity import Parity, parity_table
from saunet.metrics.functional import ERROR_HEADINGS, ERROR_NAMES
from saunet.runs.record import ModelRecord, scale_sentence, unit_of
from saunet.tables import Column, Row, Table


def model_card(
    record: ModelRecord,
    reports: Sequence[Parity],
    metrics: Mapping[str, Any] | None,
    splits: Mapping[str, str],
    source: str | None = None,
) -> str:
    """Return the card of an exported model as Markdown."""
    quality = "No evaluation was given when this was exported (`evaluation=` the folder of a saunet evaluate run)."
    return filled(
        "card.md",
        record,
        scale=scale_sentence(record.scale),
        source=source or "path/to/this/folder",
        fingerprint=fingerprint(record.to_plain()["data"]),
        splits="".join(f"Fingerprint of the frames of split '{key}': `{value}`.\n" for key, value in splits.items()),
        quality=quality if metrics is None else quality_table(metrics).markdown(),
        files=parity_table(reports).markdown(),
    )


def filled(template: str, record: ModelRecord, **texts: str) -> str:
    """Return a template beside this file, filled with a model's record and further texts."""
    parts = {"encoder": record.encoder, "decoder": record.decoder, "pose": record.pose}
    rows = "\n".join(f"| {slot} | {_described(node)} |" for slot, node in parts.items() if node is not None)
    data = json.dumps(record.to_plain()["data"], indent=2)
    text = Path(__file__).with_name(template).read_text(encoding="utf-8")
    return text.format(record=record, unit=unit_of(record.scale), parts=rows, data=data, **texts)


def fingerprint(value: Any) -> str:
    """Return a short hash of plain data that does not depend on the order of keys."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]


def quality_table(metrics: Mapping[str, Any]) -> Table:
    """Return the results of an evaluation."""
    columns = (Column("predictor"), Column("protocol"), *(Column(each, ".3f") for each in ERROR_HEADINGS))
    rows = [
        Row((row["predictor"], row.get("protocol", ""), *map(row.get, ERROR_NAMES), row.get("images", "")))
        for row in metrics["results"]
    ]
    return Table("quality", "Depth errors", (*columns, Column("images")), tuple(rows))


def _described(node: Mapping[str, Any]) -> str:
    """Return ``Name(key=value, ...)`` of a config node, nested components by name."""
    values = {key: value for key, value in node.items() if not key.startswith("_")}
    shown = (f"{key}={_described(v) if isinstance(v, Mapping) and '_target_' in v else v}" for key, v in values.items())
    return f"{str(node['_target_']).rpartition('.')[2]}({', '.join(shown)})"
