"""A depth network in OpenVINO's format, converted from torch, and run at an explicit precision."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.nn.attention import SDPBackend, sdpa_kernel

from saunet.errors import CheckpointError, ConfigError
from saunet.exporting.exporters import Batch, depth_program
from saunet.exporting.onnx import INPUT, OUTPUT
from saunet.exporting.parity import Run
from saunet.models.depth import DepthNet
from saunet.runs.record import ModelRecord


def export_openvino(
    network: DepthNet, record: ModelRecord, path: str | Path, weights: str | Path, batch: str = "auto"
) -> Batch:
    """Write a depth network as OpenVINO's graph (xml) and its weights (bin), in float32.

    It is converted from torch, not from ONNX, because there OpenVINO 2026.4 ignores ``antialias`` when resizing.

    Raises:
        ConfigError: if OpenVINO is missing, or the network cannot be exported.
        CheckpointError: if a weight is not finite; OpenVINO's ReLU would hide that, because it turns NaN into 0.
    """
    openvino = _openvino()
    if not all(value.isfinite().all() for value in network.state_dict().values() if value.is_floating_point()):
        raise CheckpointError(
            "a weight of the network is not finite; the checkpoint is damaged, or the training diverged"
        )
    with sdpa_kernel(SDPBackend.MATH):
        program, takes = depth_program(network, record, batch)
    model = openvino.convert_model(program)
    model.input(0).set_names({INPUT})
    model.output(0).set_names({OUTPUT})
    model.reshape([-1 if takes == "any" else 1, 3, record.height, record.width])
    openvino.serialize(model, str(path), str(weights))
    return takes


def run_openvino(path: Path, weights: Path, precision: str = "f32") -> Run:
    """Return a converted network as a function of arrays, on the CPU with as many threads as torch uses.

    Args:
        path: The graph.
        weights: Its weights.
        precision: ``f32`` or ``bf16``; without this setting, OpenVINO uses bf16 on processors that have it.
    """
    core = _openvino().Core()
    settings = {"INFERENCE_PRECISION_HINT": precision, "INFERENCE_NUM_THREADS": torch.get_num_threads()}
    try:
        model = core.read_model(str(path), str(weights))
        compiled = core.compile_model(model, "CPU", {"PERFORMANCE_HINT": "LATENCY", **settings})
    except RuntimeError as reason:
        raise CheckpointError(f"{path} is damaged, or not a model that OpenVINO can read") from reason
    return lambda images: np.array(compiled(images)[0])


def has_bf16() -> bool:
    """Return whether this processor computes in bfloat16."""
    return "BF16" in _openvino().Core().get_property("CPU", "OPTIMIZATION_CAPABILITIES")


def _openvino() -> Any:
    try:
        import openvino
    except ImportError as missing:
        raise ConfigError("OpenVINO is not installed; run: pip install 'saunet[openvino]'") from missing
    return openvino
