"""The drawings: curves against epochs (Figs. 4 and 5), and errors against alpha/beta."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from saunet.reporting.groups import comparable
from saunet.runs.folder import Run
from saunet.runs.sweep import RATIO, ratio
from saunet.tables.drawing import COLORS, colors, new_figure, svg

Curve = tuple[list[float], list[float]]
"""Epochs and values."""


def draw_curves(runs: Mapping[str, Run], panels: Sequence[tuple[str, str]], *, ordered: bool = False) -> bytes | None:
    """Draw columns of the runs' logs against epochs, one panel a column, one line a run."""
    drawn = [(key, title) for key, title in panels if any(curve(run.history, key)[0] for run in runs.values())]
    if not drawn:
        return None
    figure, axes = new_figure(len(drawn), 11.7 if len(drawn) > 1 else 7.6, 3.8 if len(runs) > 1 else 3.3)
    tints = colors(len(runs), ordered=ordered)
    for axis, (key, title) in zip(axes, drawn, strict=True):
        few = max(len(curve(run.history, key)[0]) for run in runs.values()) <= 25
        for (name, run), color in zip(runs.items(), tints, strict=True):
            x, y = curve(run.history, key)
            if x:
                axis.plot(x, y, color=color, label=name, marker="o" if few else None, markersize=3.5)
        axis.set_title(title, loc="left", fontsize=10)
        axis.set_xlabel("epoch")
        axis.set_xlim(left=0)
        if axis.get_xlim()[1] > 2:
            axis.xaxis.get_major_locator().set_params(integer=True)
    if len(runs) > 1:
        _legend(figure, axes)
    return svg(figure)


def draw_ratio(runs: Mapping[str, Run]) -> bytes | None:
    """Draw Abs Rel and accuracy against the ratio alpha/beta of eq. (14); None if fewer than two runs compare."""
    points = sorted(
        (value, score.errors[0], score.errors[4])
        for name, score in comparable(runs).items()
        if (value := ratio(runs[name])) is not None
    )
    if len(points) < 2:
        return None
    figure, axes = new_figure(2, 11.7, 3.3)
    for axis, column, title in zip(
        axes, (1, 2), ("Abs Rel (smaller is better)", "δ < 1.25 (larger is better)"), strict=True
    ):
        axis.axvspan(95, 105, color="#fff1c9", zorder=0, label="the paper's best, 95 to 105")
        axis.plot([p[0] for p in points], [p[column] for p in points], "o-", color=COLORS[0], markersize=4.5)
        axis.set_xscale("log")
        axis.xaxis.set_major_formatter(lambda value, place: f"{value:g}")
        axis.set_title(title, loc="left", fontsize=10)
        axis.set_xlabel(RATIO)
    axes[0].legend(loc="best", frameon=False, fontsize=9)
    return svg(figure)


def _legend(figure: Any, axes: Sequence[Any]) -> None:
    """Put one legend below all panels, each run once."""
    handles: dict[str, Any] = {}
    for axis in axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    longest = max(map(len, handles))
    columns = max(1, min(len(handles), 120 // (longest + 8)))
    figure.legend(
        handles.values(), handles.keys(), loc="outside lower center", ncols=columns, frameon=False, fontsize=9
    )


def curve(history: Sequence[Mapping[str, float]], key: str, points: int = 150) -> Curve:
    """Return one column of a log against epochs; long ones as means of neighbors.

    What is logged during an epoch lies between its whole numbers, what is logged after it on the next one: epoch 1 is
    the end of the first.
    """
    rows = [row for row in history if key in row and "step" in row and "epoch" in row]
    if not rows:
        return [], []
    if key.startswith("val/"):
        return [row["epoch"] + 1 for row in rows], [row[key] for row in rows]
    steps = _steps_per_epoch(history)
    size = -(-len(rows) // points)
    groups = [rows[start : start + size] for start in range(0, len(rows), size)]
    return (
        [sum(row["step"] + 1 for row in group) / len(group) / steps for group in groups],
        [sum(row[key] for row in group) / len(group) for group in groups],
    )


def _steps_per_epoch(history: Sequence[Mapping[str, float]]) -> float:
    """Return the length of an epoch: exact after a validation, else from how far the log goes."""
    placed = [row for row in history if "step" in row and "epoch" in row]
    ends = [row for row in placed if any(key.startswith("val/") for key in row)] or placed
    last = max(ends, key=lambda row: row["step"])
    return (last["step"] + 1) / (last["epoch"] + 1)
