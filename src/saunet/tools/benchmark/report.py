"""Measurements as a table beside the paper's Table 2, as JSON, and as a picture in the manner of its Fig. 10."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table

from saunet.errors import require_matplotlib
from saunet.io.atomic import replacing, write_json
from saunet.published import published
from saunet.tools.benchmark.suite import Measurement

PAPER_METHODS: dict[str, str] = {
    "mono_r18": "Mono R18",
    "mono_r50": "Mono R50",
    "packnet": "PackNet",
    "sau_net": "SAU-Net",
}
"""What the paper calls our models."""
_MARKERS = "os^Dv<>Pp*hX"


def size_table(results: Sequence[Measurement]) -> Table:
    """Return parameters and FLOPs by model and image size, with the paper's Table 2 where it has the system."""
    table = Table(title="Size (M = 10^6 parameters; GFLOP of the depth network for one image)")
    table.add_column("model")
    table.add_column("size", no_wrap=True)
    for heading in ("depth M", "pose M", "total M"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("paper M", justify="right")
    table.add_column("GFLOP", justify="right", no_wrap=True)
    printed = {row.method: row.megaparameters for row in published().table2}
    for row in {(row.model, row.size): row for row in results}.values():
        method = PAPER_METHODS.get(row.model)
        counts = (row.depth_parameters, row.pose_parameters, row.total_parameters)
        table.add_row(
            row.model,
            row.size,
            *(f"{count / 1e6:.1f}" for count in counts),
            f"{printed[method]} ({method})" if method else "-",
            f"{row.flops / 1e9:.1f}",
        )
    return table


def speed_table(results: Sequence[Measurement], width: int = 160) -> Table:
    """Return time and memory of every measurement; times in milliseconds.

    Settings that all measurements share are said in the title. Where the rest does not fit, they stand in one column
    that wraps, so that no number is cut.

    Args:
        results: Measurements.
        width: Characters a line may have.
    """
    settings: dict[str, list[str]] = {
        "model": [row.model for row in results],
        "size": [row.size for row in results],
        "device": [row.device for row in results],
        "precision": [row.precision for row in results],
        "mode": [row.mode for row in results],
        "batch": [str(row.batch_size) for row in results],
    }
    shared = [name for name, values in settings.items() if len(set(values)) == 1 and name != "model"]
    said = "".join(f", {'batch ' * (name == 'batch')}{settings.pop(name)[0]}" for name in shared)
    title = f"Speed (ms a call{said}; share of the speed of one large matrix product)"
    labels = list(zip(*settings.values(), strict=True))
    table = _speed_table(Table(title=title), list(settings), labels, results)
    if Console(width=1000).measure(table).maximum <= width:
        return table
    folded = Table(title=title, show_lines=True)
    return _speed_table(folded, [" ".join(settings)], [(" ".join(label),) for label in labels], results)


def _speed_table(
    table: Table, headings: Sequence[str], labels: Sequence[tuple[str, ...]], results: Sequence[Measurement]
) -> Table:
    """Fill a table with measurements behind their labels; a label of one column may wrap."""
    for heading in headings:
        table.add_column(heading, no_wrap=len(headings) > 1)
    for heading in ("median", "p90", "warm-up", "images/s", "peak MB", "share"):
        table.add_column(heading, justify="right", no_wrap=True)
    for label, row in zip(labels, results, strict=True):
        table.add_row(
            *label,
            f"{row.median * 1e3:.1f}",
            f"{row.p90 * 1e3:.1f}",
            f"{row.warmup * 1e3:.0f}",
            f"{row.throughput:.1f}",
            "-" if row.memory is None else f"{row.memory / 1e6:.0f}",
            f"{row.ceiling_share:.0%}",
        )
    return table


def write_measurements(results: Sequence[Measurement], path: Path) -> None:
    """Write the measurements with the machine they were made on."""
    machine = {
        "torch": torch.__version__,
        "python": platform.python_version(),
        "system": platform.platform(),
        "threads": torch.get_num_threads(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
    }
    write_json(path, {"machine": machine, "results": [asdict(row) for row in results]})


def draw_figure(results: Sequence[Measurement], path: Path, abs_rel: Mapping[str, float] | None = None) -> None:
    """Draw accuracy (x) against time per image (y), as the paper's Fig. 10; models of unknown accuracy stand beside.

    Args:
        results: Measurements. A color is a model, a marker a setting (size, device, precision, mode, batch).
        path: Picture file to write.
        abs_rel: Accuracy by model; the paper's Table 1 where a model is not named.

    Raises:
        ConfigError: if matplotlib is not installed.
    """
    require_matplotlib("figure=true needs", "figure=false")
    from matplotlib.figure import Figure

    printed = {row.method: row.errors[0] for row in published().table1}
    accuracy = {model: value for model, method in PAPER_METHODS.items() if (value := printed[method]) is not None}
    accuracy |= abs_rel or {}
    models = list(dict.fromkeys(row.model for row in results))
    settings = list(dict.fromkeys(_setting(row) for row in results))
    known, unknown = ([name for name in models if (name in accuracy) is wanted] for wanted in (True, False))
    panels = [names for names in (known, unknown) if names]
    figure = Figure(figsize=(8, 5), layout="constrained")
    widths = [max(3, len(names)) if names is known else len(names) for names in panels]
    axes = figure.subplots(1, len(panels), sharey=True, squeeze=False, width_ratios=widths)[0]
    for names, panel in zip(panels, axes, strict=True):
        places = accuracy if names is known else {name: float(index) for index, name in enumerate(names)}
        for name in names:
            color = f"C{models.index(name) % 10}"
            rows = [row for row in results if row.model == name]
            seconds = [row.median / row.batch_size for row in rows]
            panel.plot([places[name]] * len(rows), seconds, "-", color=color, linewidth=1, alpha=0.5)
            for row, value in zip(rows, seconds, strict=True):
                marker = _MARKERS[settings.index(_setting(row)) % len(_MARKERS)]
                panel.plot([places[name]], [value], marker, color=color, markersize=8)
            if names is known:
                panel.annotate(
                    name, (places[name], max(seconds)), textcoords="offset points", xytext=(0, 9), ha="center"
                )
        panel.set_yscale("log")
        panel.margins(x=0.2, y=0.12)
        panel.grid(alpha=0.3)
        if names is known:
            panel.set_xlabel("Abs Rel, KITTI Eigen (as published unless given)")
        else:
            panel.set_xticks(range(len(names)), names, rotation=30, ha="right")
            panel.set_xlim(-0.6, len(names) - 0.4)
            panel.set_xlabel("accuracy unknown")
    axes[0].set_ylabel("seconds per image")
    for index, setting in enumerate(settings):
        axes[0].plot([], [], _MARKERS[index % len(_MARKERS)], color="0.3", label=setting)
    figure.legend(loc="outside lower center", ncols=2, fontsize=8)
    with replacing(path) as partial:
        figure.savefig(partial, dpi=150)


def _setting(row: Measurement) -> str:
    return f"{row.size}, {row.device} {row.precision} {row.mode}, batch {row.batch_size}"
