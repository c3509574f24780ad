"""The drawings: curves against epochs (Figs. 4 and 5), errors against alpha/beta, accuracy against time (Fig. 10).

Everything is drawn as SVG with its letters as outlines, so that pages are sharp at any size and need no font.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

from saunet.reporting.curves import curve
from saunet.reporting.groups import comparable
from saunet.runs.folder import Run
from saunet.runs.sweep import RATIO, ratio

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7b6fd0", "#444444")
"""Okabe and Ito's colors, which color-blind readers can tell apart, the yellow left out on white paper."""
_STYLE = {
    "font.size": 9.5,
    "axes.labelcolor": "#444444",
    "axes.edgecolor": "#b9bec5",
    "axes.linewidth": 0.8,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#e8eaed",
    "grid.linewidth": 0.8,
    "xtick.color": "#555555",
    "ytick.color": "#555555",
    "legend.frameon": False,
    "legend.fontsize": 9,
    "lines.linewidth": 1.7,
    "svg.fonttype": "path",
    "svg.hashsalt": "saunet",
}


def draw_curves(runs: Mapping[str, Run], panels: Sequence[tuple[str, str]], *, ordered: bool = False) -> bytes | None:
    """Draw columns of the runs' logs against epochs, one panel a column, one line a run.

    Args:
        runs: Runs by their short names.
        panels: Columns and their titles; those that no run has are left out.
        ordered: The runs are steps of one quantity: their colors run from dark to light.

    Returns:
        An SVG; None if there is nothing to draw.
    """
    drawn = [(key, title) for key, title in panels if any(curve(run.history, key)[0] for run in runs.values())]
    if not drawn:
        return None
    figure, axes = _figure(len(drawn), legend=len(runs) > 1)
    colors = _colors(len(runs), ordered)
    for axis, (key, title) in zip(axes, drawn, strict=True):
        few = max(len(curve(run.history, key)[0]) for run in runs.values()) <= 25
        for (name, run), color in zip(runs.items(), colors, strict=True):
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
    return _svg(figure)


def draw_ratio(runs: Mapping[str, Run]) -> bytes | None:
    """Draw Abs Rel and accuracy against the ratio alpha/beta of eq. (14); None if fewer than two runs compare."""
    points = sorted(
        (value, score.errors[0], score.errors[4])
        for name, score in comparable(runs).items()
        if (value := ratio(runs[name])) is not None
    )
    if len(points) < 2:
        return None
    figure, axes = _figure(2, legend=False)
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
    return _svg(figure)


def draw_speed(ours: Sequence[tuple[str, float, float]], printed: Sequence[tuple[str, float, float]]) -> bytes:
    """Draw seconds an image against accuracy, the paper's Fig. 10.

    Args:
        ours: Name, accuracy and seconds of what was measured.
        printed: The same of what the paper gives in numbers.
    """
    figure, (axis,) = _figure(1, legend=False, height=4.2)
    axis.plot(
        [p[1] for p in printed], [p[2] for p in printed], "D", color="#8a9099", markerfacecolor="white", markersize=7
    )
    for (name, accuracy, seconds), color in zip(ours, _colors(len(ours), ordered=False), strict=True):
        axis.plot([accuracy], [seconds], "o", color=color, markersize=8, label=name)
    points = (*printed, *ours)
    middle = (min(point[1] for point in points) + max(point[1] for point in points)) / 2
    for name, accuracy, seconds in points:  # names grow towards the middle, where there is room
        side, offset = ("right", -9) if accuracy > middle else ("left", 9)
        place = {"textcoords": "offset points", "xytext": (offset, 5), "ha": side}
        axis.annotate(name, (accuracy, seconds), fontsize=9, color="#333333", **place)
    axis.set_yscale("log")
    axis.margins(x=0.25, y=0.25)
    axis.set_xlabel("accuracy, δ < 1.25")
    axis.set_ylabel("seconds an image")
    return _svg(figure)


def _figure(panels: int, *, legend: bool, height: float = 3.3) -> tuple[Any, list[Any]]:
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(_STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(11.7 if panels > 1 else 7.6, height + 0.5 * legend), layout="constrained")
        axes = figure.subplots(1, panels, squeeze=False)[0]
    return figure, list(axes)


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


def _colors(count: int, ordered: bool) -> list[Any]:
    if not ordered and count <= len(COLORS):
        return list(COLORS[:count])
    from matplotlib import colormaps

    return [colormaps["viridis"](0.9 * index / max(1, count - 1)) for index in range(count)]


def _svg(figure: Any) -> bytes:
    from matplotlib import rc_context
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    stream = io.BytesIO()
    with rc_context(_STYLE):  # type: ignore[arg-type]
        FigureCanvasSVG(figure).print_svg(stream, metadata={"Date": None})  # type: ignore[no-untyped-call]
    return stream.getvalue()
