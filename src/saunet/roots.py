"""The typed root of each command-line tool: every key at the top of its configuration, with its type and default."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from omegaconf import MISSING


@dataclass
class ModelConfig:
    """Networks: depth (encoder + decoder) and pose."""

    encoder: Any = MISSING
    decoder: Any = MISSING
    pose: Any = MISSING
    min_depth: float = 0.1
    max_depth: float = 100.0


SCALE_METHODS = ("auto", "none", "stored", "camera_height", "speed", "stereo")
"""``auto``: the factor stored in the checkpoint, where there is one; the last three measure it."""


@dataclass
class ScaleConfig:
    """How depth becomes meters without ground truth; see docs/scale.md."""

    method: str = "auto"
    camera_height: float | None = None
    speeds: str | None = None
    fps: float | None = None
    partner: str | None = None
    baseline: float | None = None
    frames: int = 100
    store: bool = False


@dataclass
class PredictConfig:
    """Root of ``saunet predict``."""

    checkpoint: str = "street"
    input: str = MISSING
    output: str = MISSING
    outputs: list[str] | None = None
    colormap: str = "magma"
    camera: list[float] | None = None
    rectify: str | None = None
    max_depth: float | None = None
    max_frames: int | None = None
    fps: float | None = None
    layout: str = "auto"
    memory: float = 0.95
    codec: str = "h264"
    flip: bool = False
    keep_aspect: bool = False
    scale: ScaleConfig = field(default_factory=ScaleConfig)
    overwrite: bool = False
    batch_size: int = 1
    device: str = "auto"


@dataclass
class ExportConfig:
    """Root of ``saunet export``."""

    checkpoint: str = MISSING
    output: str = MISSING
    formats: list[str] = field(default_factory=lambda: ["onnx", "program", "safetensors"])
    images: str | None = None
    batch: str = "auto"
    evaluation: str | None = None
    overwrite: bool = False


@dataclass
class BenchmarkConfig:
    """Root of ``saunet benchmark``: ``model`` alone, or each of ``models`` (names of choices of ``model``)."""

    model: ModelConfig = field(default_factory=ModelConfig)
    models: list[str] = field(default_factory=list)
    sizes: list[str] = field(default_factory=lambda: ["192x640"])
    devices: list[str] = field(default_factory=lambda: ["auto"])
    precisions: list[str] = field(default_factory=lambda: ["fp32"])
    modes: list[str] = field(default_factory=lambda: ["eager"])
    batch_sizes: list[int] = field(default_factory=lambda: [1])
    runs: int = 20
    warmup: int = 3
    threads: int | None = None
    figure: bool = False
    abs_rel: dict[str, float] = field(default_factory=dict)
    output_dir: str = MISSING


@dataclass
class ReportConfig:
    """Root of ``saunet report``; ``scenes`` maps a condition to images, folders or patterns."""

    runs: list[str] = MISSING
    compare: bool = False
    checkpoint: str = "best"
    title: str = "saunet report"
    labels: list[str] = field(default_factory=list)
    scenes: Any = None
    scenes_limit: int = 3
    zooms: int = 2
    figures: bool = True
    device: str = "auto"
    flip: bool = False
    output_dir: str = MISSING


ROOTS = (
    PredictConfig,
    ExportConfig,
    BenchmarkConfig,
    ReportConfig,
    ModelConfig,
    ScaleConfig,
)
"""The typed roots, and what lies directly below them."""
