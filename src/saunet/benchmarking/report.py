"""Measurements as a table beside the paper's Table 2, as JSON, and as a picture in the manner of its Fig. 10."""

from __future__ import annotations

import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import torch
from rich.table import Table

from saunet.atomic import replacing
from saunet.benchmarking.suite import Measurement
from saunet.checks import ConfigError


class Published(NamedTuple):
    """What the SAU-Net paper prints about a system."""

    system: str
    megaparameters: float
    """Table 2, there in "Mb"."""
    abs_rel: float
    """Table 1, KITTI Eigen, 0-80 m."""


PUBLISHED: dict[str, Published] = {
    "mono_r18": Published("Mono R18", 52.7, 0.115),
    "mono_r50": Published("Mono R50", 68.7, 0.111),
    "packnet": Published("PackNet", 118.5, 0.111),
    "sau_net": Published("SAU-Net", 58.8, 0.108),
}
"""The paper's rows by the names of our models."""


def size_table(results: Sequence[Measurement]) -> Table:
    """Return parameters and FLOPs by model and image size, with the paper's Table 2 where it has the system."""
    table = Table(title="Size (M = 10^6 parameters; GFLOP of the depth network for one image)")
    for heading in ("model", "size"):
        table.add_column(heading, no_wrap=True)
    for heading in ("depth M", "pose M", "total M", "paper M", "GFLOP"):
        table.add_column(heading, justify="right", no_wrap=True)
    for row in {(row.model, row.size): row for row in results}.values():
        published = PUBLISHED.get(row.model)
        counts = (row.depth_parameters, row.pose_parameters, row.total_parameters)
        table.add_row(
            row.model,
            row.size,
            *(f"{count / 1e6:.1f}" for count in counts),
            f"{published.megaparameters} ({published.system})" if published else "-",
            f"{row.flops / 1e9:.1f}",
        )
    return table


def speed_table(results: Sequence[Measurement]) -> Table:
    """Return time and memory of every measurement; times in milliseconds."""
    table = Table(title="Speed (ms a call; share of the speed of one large matrix product)")
    for heading in ("model", "size", "device", "precision", "mode", "batch"):
        table.add_column(heading, no_wrap=True)
    for heading in ("median", "p90", "warm-up", "images/s", "peak MB", "share"):
        table.add_column(heading, justify="right", no_wrap=True)
    for row in results:
        table.add_row(
            row.model,
            row.size,
            row.device,
            row.precision,
            row.mode,
            str(row.batch_size),
            f"{row.median * 1e3:.1f}",
            f"{row.p90 * 1e3:.1f}",
            f"{row.warmup * 1e3:.0f}",
            f"{row.throughput:.1f}",
            "-" if row.memory is None else f"{row.memory / 1e6:.0f}",
            f"{row.ceiling_share:.0%}",
        )
    return table


def write_json(results: Sequence[Measurement], path: Path) -> None:
    """Write the measurements with the machine they were made on."""
    machine = {
        "torch": torch.__version__,
        "python": platform.python_version(),
        "system": platform.platform(),
        "threads": torch.get_num_threads(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
    }
    content = {"machine": machine, "results": [asdict(row) for row in results]}
    with replacing(path) as partial:
        partial.write_text(json.dumps(content, indent=2) + "\n")


def draw_figure(results: Sequence[Measurement], path: Path, abs_rel: Mapping[str, float] | None = None) -> None:
    """Draw accuracy (x) against time per image (y), as the paper's Fig. 10; a model of unknown accuracy is a line.

    Args:
        results: Measurements; a model that was measured more than once gets one point each.
        path: Picture file to write.
        abs_rel: Accuracy by model; the paper's Table 1 where a model is not named.

    Raises:
        ConfigError: if matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as reason:
        raise ConfigError(
            "figure=true needs matplotlib; run `pip install 'saunet[plot]'` or set figure=false"
        ) from reason
    known = {name: row.abs_rel for name, row in PUBLISHED.items()} | dict(abs_rel or {})
    figure = Figure(figsize=(7, 5), layout="constrained")
    axes = figure.add_subplot()
    for row in results:
        label = f"{row.model} ({row.device} {row.precision} {row.mode} x{row.batch_size}, {row.size})"
        seconds = row.median / row.batch_size
        if row.model in known:
            points = axes.plot([known[row.model]], [seconds], "o", label=label)
            axes.annotate(row.model, (known[row.model], seconds), textcoords="offset points", xytext=(6, 4))
            points[0].set_markersize(8)
        else:
            axes.axhline(seconds, linestyle="--", linewidth=1, label=label)
    axes.set_xlabel("Abs Rel, KITTI Eigen (as published unless given)")
    axes.set_ylabel("seconds per image")
    axes.set_yscale("log")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7)
    with replacing(path) as partial:
        figure.savefig(partial, dpi=150)
