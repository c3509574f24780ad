"""The model card that goes with an exported model: what it is, was trained on, and means."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from saunet.infer.parity import Parity
from saunet.infer.prediction import unit_of
from saunet.record import ModelRecord


def model_card(record: ModelRecord, reports: Sequence[Parity] = ()) -> str:
    """Return the card as Markdown.

    Args:
        record: The model's record.
        reports: How the exported files compare with the original.
    """
    parts = {"encoder": record.encoder, "decoder": record.decoder, "pose": record.pose}
    lines = [
        "# Monocular depth model",
        "",
        f"Predicts depth from one RGB image; trained without depth labels by saunet {record.version}.",
        "",
        "| | |",
        "|---|---|",
        f"| input | RGB, {record.width} x {record.height} (width x height); other sizes are resized |",
        f"| output | disparity in [1/{record.max_depth:g}, 1/{record.min_depth:g}]; depth is 1 / disparity |",
        f"| unit of depth | {unit_of(record.scale)} |",
        *(f"| {slot} | {_describe(node)} |" for slot, node in parts.items() if node is not None),
        "",
        "## Trained on",
        "",
        "```json",
        json.dumps(record.to_plain()["data"], indent=2),
        "```",
        "",
    ]
    if record.scale:
        lines += [
            f"Network depth x {record.scale.factor:g} is metres; the factor comes from {record.scale.source}.",
            "",
        ]
    else:
        lines += ["Depth has no unit: training on one camera's video leaves one factor unknown.", ""]
    if reports:
        lines += [
            "## Files, against the original network on the CPU",
            "",
            "| file | largest difference (share of the disparity range) | images | original | this file |",
            "|---|---|---|---|---|",
            *(
                f"| `{r.file}` | {r.difference:.1e} | {r.images} | {r.eager_ms:.1f} ms | {r.exported_ms:.1f} ms |"
                for r in reports
            ),
            "",
        ]
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
        'prediction = saunet.load("last.ckpt").predict("road.png")  # the checkpoint, with torch',
        "",
        "from saunet.infer.onnx import OnnxPredictor",
        "",
        'prediction = OnnxPredictor("model.onnx").predict("road.png")  # the exported file, without torch',
        "prediction.depth, prediction.unit",
        "```",
        "",
    ]
    return "\n".join(lines)


def _describe(node: Mapping[str, Any]) -> str:
    """Return ``Name(key=value, ...)`` of a config node, nested components by name."""
    name = str(node["_target_"]).rpartition(".")[2]
    values = {key: value for key, value in node.items() if not key.startswith("_")}
    shown = (f"{key}={_describe(v) if isinstance(v, Mapping) and '_target_' in v else v}" for key, v in values.items())
    return f"{name}({', '.join(shown)})"
