"""The model card that goes with an exported model: what it is, was trained on, how good it is, and means."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import Any

from saunet.exporting.parity import Parity
from saunet.metrics.functional import ERROR_HEADINGS, ERROR_NAMES
from saunet.prediction.prediction import unit_of
from saunet.runs.record import ModelRecord


def model_card(
    record: ModelRecord,
    reports: Sequence[Parity] = (),
    metrics: Mapping[str, Any] | None = None,
    splits: Mapping[str, str] | None = None,
) -> str:
    """Return the card as Markdown."""
    parts = {"encoder": record.encoder, "decoder": record.decoder, "pose": record.pose}
    data = record.to_plain()["data"]
    lines = [
        "---",
        "library_name: saunet",
        "pipeline_tag: depth-estimation",
        "tags: [depth-estimation, monocular-depth, self-supervised]",
        "---",
        "",
        "# Monocular depth model",
        "",
        f"Predicts depth from one RGB image; trained by saunet {record.version} on video, by synthesizing views.",
        "",
        "| | |",
        "|---|---|",
        f"| input | RGB, {record.width} x {record.height} (width x height); other sizes are resized |",
        f"| output | disparity in [1/{record.max_depth:g}, 1/{record.min_depth:g}]; depth is 1 / disparity |",
        f"| unit of depth | {unit_of(record.scale)} |",
        *(f"| {slot} | {describe_node(node)} |" for slot, node in parts.items() if node is not None),
        "",
        "The whole configuration is in `config.json`.",
        "",
        "## Scale",
        "",
        f"Network depth x {record.scale.factor:g} is meters; the factor comes from {record.scale.source}."
        if record.scale
        else "Depth has no unit: training on one camera's video leaves one factor unknown.",
        "",
        "## Trained on",
        "",
        f"Fingerprint of this description: `{fingerprint(data)}` (sha256).",
        *(f"Fingerprint of the frames of split '{name}': `{value}`." for name, value in (splits or {}).items()),
        "",
        "```json",
        json.dumps(data, indent=2),
        "```",
        "",
        "## Quality",
        "",
        *quality_lines(metrics),
        "",
    ]
    if reports:
        lines += ["## Files, against the original network on the CPU", "", *parity_table(reports), ""]
    lines += [
        "## Limits",
        "",
        "Learned from motion: what moves along with the camera, mirrors, glass and the sky can come out too far or too "
        "near. Quality drops with other cameras, mounting heights and weather than in training. Not for safety.",
        "",
        "## Use",
        "",
        "```python",
        "import saunet",
        "",
        'model = saunet.load("path/to/this/folder")  # or its model.onnx, which runs without torch',
        'prediction = model.predict("road.png")',
        "prediction.depth, prediction.unit",
        "```",
        "",
    ]
    return "\n".join(lines)


def parity_table(reports: Sequence[Parity]) -> list[str]:
    """Return the comparisons as lines of a Markdown table."""
    return [
        "| file | MB | batch | disparity differs by (share of its range) | depth differs by | images: random + real "
        "| original | this file |",
        "|---|---:|---|---:|---:|---:|---:|---:|",
        *(
            f"| `{r.file}` | {r.megabytes:.1f} | {r.batch} | {r.difference:.1e} | {100 * r.depth_difference:.1g} % "
            f"| {r.random} + {r.real} | {r.eager_ms:.1f} ms | {r.exported_ms:.1f} ms |"
            for r in reports
        ),
    ]


def fingerprint(value: Any) -> str:
    """Return a short hash of plain data that does not depend on the order of keys."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]


def quality_lines(metrics: Mapping[str, Any] | None) -> list[str]:
    """Return the results of an evaluation as lines of a Markdown table."""
    if metrics is None:
        return ["No evaluation was given when this was exported (`evaluation=` the folder of a saunet evaluate run)."]
    return [
        f"| predictor | protocol | {' | '.join(ERROR_HEADINGS)} | images |",
        f"|---|---|{'---:|' * (len(ERROR_HEADINGS) + 1)}",
        *(
            f"| {row['predictor']} | {row.get('protocol', '')} "
            f"| {' | '.join(_number(row.get(key)) for key in ERROR_NAMES)} | {row.get('images', '')} |"
            for row in metrics["results"]
        ),
    ]


def _number(value: Any) -> str:
    return f"{value:.3f}" if isinstance(value, int | float) else "-"


def describe_node(node: Mapping[str, Any]) -> str:
    """Return ``Name(key=value, ...)`` of a config node, nested components by name."""
    name = str(node["_target_"]).rpartition(".")[2]
    values = {key: value for key, value in node.items() if not key.startswith("_")}
    shown = (
        f"{key}={describe_node(v) if isinstance(v, Mapping) and '_target_' in v else v}" for key, v in values.items()
    )
    return f"{name}({', '.join(shown)})"
