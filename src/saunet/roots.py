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
    BenchmarkConfig,
    ReportConfig,
    ModelConfig,
)
"""The typed roots, and what lies directly below them."""
