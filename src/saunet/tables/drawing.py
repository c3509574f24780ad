"""What all drawings share: colors, the style of ``saunet.mplstyle``, and the drawing of time against accuracy."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from saunet.errors import ConfigError
from saunet.io.atomic import replacing, write_bytes

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7b6fd0", "#444444")
"""Okabe and Ito's colors, which color-blind readers can tell apart, the yellow left out on white paper."""
_STYLE = Path(__file__).with_name("saunet.mplstyle")
_MARKERS = "os^Dv<>Pp*hX"
_GRAY = "#8a9099"


@dataclass(frozen=True, slots=True)
class Point:
    """One model in the drawing of time against accuracy, timed in one way."""

    name: str
    accuracy: float | None
    """None where it is not known; such models stand beside the others."""
    seconds: float
    setting: str = ""
    """How it was timed."""
    published: bool = False


@dataclass(frozen=True, slots=True)
class Drawing:
    """A drawing that a notebook shows."""

    svg: bytes

    def save(self, path: str | Path) -> None:
        """Write it to a file that ends in ``.svg``."""
        if Path(path).suffix.lower() != ".svg":
            raise ConfigError(f"the drawing {path} must end in .svg")
        write_bytes(path, self.svg)

    def __repr__(self) -> str:
        return f"Drawing({len(self.svg) / 1024:.0f} kB of SVG; a notebook shows it, .save('drawing.svg') writes it)"

    def _repr_svg_(self) -> str:
        return self.svg.decode()


def new_figure(panels: int, width: float, height: float, **options: Any) -> tuple[Any, list[Any]]:
    """Return a figure and its panels side by side."""
    from matplotlib import style
    from matplotlib.figure import Figure

    with style.context(_STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        axes = figure.subplots(1, panels, squeeze=False, **options)[0]
    return figure, list(axes)


def stacked_figure(width: float, rows: Sequence[tuple[int, float]]) -> tuple[Any, list[list[Any]]]:
    """Return a figure with a row of so many panels, and so high, below the other, and the panels of each row."""
    from matplotlib import style
    from matplotlib.figure import Figure

    heights = [height for _, height in rows]
    with style.context(_STYLE):
        figure = Figure(figsize=(width, sum(heights)), layout="constrained")
        parts = figure.subfigures(len(rows), 1, squeeze=False, height_ratios=heights)[:, 0]
        panels = [list(part.subplots(1, n, squeeze=False)[0]) for part, (n, _) in zip(parts, rows, strict=True)]
    return figure, panels


def svg(figure: Any) -> bytes:
    """Return a figure as SVG, the same bytes each time."""
    from matplotlib import style
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    stream = io.BytesIO()
    with style.context(_STYLE):
        FigureCanvasSVG(figure).print_svg(stream, metadata={"Date": None})  # type: ignore[no-untyped-call]
    return stream.getvalue()


def save(figure: Any, path: Path) -> None:
    """Write a figure to a file, whole or not at all; the suffix chooses the format."""
    with replacing(path) as partial:
        figure.savefig(partial, dpi=150)


def colors(count: int, *, ordered: bool = False) -> list[Any]:
    """Return colors that can be told apart, or, for steps of one quantity, from dark to light."""
    if not ordered and count <= len(COLORS):
        return list(COLORS[:count])
    from matplotlib import colormaps

    return [colormaps["viridis"](0.9 * index / max(1, count - 1)) for index in range(count)]


def draw_speed(points: Sequence[Point], accuracy: str) -> Any:
    """Draw seconds per image against accuracy (with its label), the paper's Fig. 10.

    A color is a model, a marker is a way of timing, hollow is published.
    """
    known = [point for point in points if point.accuracy is not None]
    unknown = list(dict.fromkeys(point.name for point in points if point.accuracy is None))
    names = list(dict.fromkeys(point.name for point in points if not point.published))
    settings = list(dict.fromkeys(point.setting for point in points if not point.published))
    tints = dict(zip(names, colors(len(names)), strict=True))
    widths = [max(3, len({point.name for point in known}))] * bool(known) + [len(unknown)] * bool(unknown)
    legend = len(settings) > 1
    figure, axes = new_figure(len(widths), 7.6, 4.2 + 0.25 * len(settings) * legend, sharey=True, width_ratios=widths)
    values = [point.accuracy for point in known if point.accuracy is not None]
    middle = (min(values) + max(values)) / 2 if values else 0.0
    told = set()
    for point in sorted(points, key=lambda one: -one.seconds):
        panel = axes[0] if point.accuracy is not None else axes[-1]
        place = float(unknown.index(point.name)) if point.accuracy is None else point.accuracy
        marker = "D" if point.published else _MARKERS[settings.index(point.setting) % len(_MARKERS)]
        tint = _GRAY if point.published else tints[point.name]
        fill = "white" if point.published else tint
        panel.plot([place], [point.seconds], marker, color=tint, markersize=7.5, mfc=fill)
        if point.accuracy is not None and point.name not in told:
            told.add(point.name)  # once, above its marker and towards the middle, where there is room
            side, offset = ("right", -9) if place > middle else ("left", 9)
            where = {"textcoords": "offset points", "xytext": (offset, 5), "ha": side}
            panel.annotate(point.name, (place, point.seconds), fontsize=9, color="#333333", **where)
    for panel in axes:
        panel.set_yscale("log")
        panel.margins(x=0.25, y=0.25)
    if known:
        axes[0].set_xlabel(accuracy)
    if unknown:
        axes[-1].set_xticks(range(len(unknown)), unknown, rotation=30, ha="right")
        axes[-1].set(xlim=(-0.6, len(unknown) - 0.4), xlabel="accuracy unknown")
    axes[0].set_ylabel("seconds per image")
    if legend:
        for index, setting in enumerate(settings):
            axes[0].plot([], [], _MARKERS[index % len(_MARKERS)], color="0.3", label=setting)
        figure.legend(loc="outside lower center", ncols=2, fontsize=8, frameon=False)
    return figure
