"""Curves of trainings (Figs. 4 and 5), errors against alpha/beta, and accuracy against time (Fig. 10)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from saunet.errors import DataError
from saunet.io.images import read_image
from saunet.published import published
from saunet.reporting.page import Missing
from saunet.reporting.scenes import Seen
from saunet.reporting.tables import Groups, chosen, comparable
from saunet.runs.folder import read_mapping
from saunet.runs.run import Run
from saunet.runs.sweep import RATIO, ratio
from saunet.tables import Row, Table, columns
from saunet.tables.drawing import COLORS, Point, colors, new_figure, stacked_figure, svg


def draw_curves(runs: Mapping[str, Run], panels: Sequence[tuple[str, str]], *, ordered: bool = False) -> bytes | None:
    """Draw columns of the runs' logs over epochs, or steps of a first epoch; a panel per column, a line per run."""
    drawn = logged(runs, panels)
    if not drawn:
        return None
    figure, axes = new_figure(len(drawn), 11.7 if len(drawn) > 1 else 7.6, 3.8 if len(runs) > 1 else 3.3)
    plot_curves(axes, runs, drawn, ordered=ordered)
    if len(runs) > 1:
        _legend(figure, axes)
    return svg(figure)


def draw_results(run: Run, groups: Sequence[Sequence[tuple[str, str]]], picture: Path | None) -> Any:
    """Draw each group of columns of a run's log as a row of curves, above a picture; None if nothing is logged."""
    named = {run.called: run}
    drawn = [found for group in groups if (found := logged(named, group))]
    if not drawn:
        return None
    image = None if picture is None else read_image(picture)
    last = [] if image is None else [(1, 11.7 * image.shape[0] / image.shape[1])]
    figure, rows = stacked_figure(11.7, [(len(group), 2.9) for group in drawn] + last)
    for axes, group in zip(rows, drawn, strict=False):
        plot_curves(axes, named, group)
    if image is not None:
        rows[-1][0].imshow(image)
        rows[-1][0].set_axis_off()
    figure.suptitle(run.called, x=0.01, ha="left")
    return figure


def logged(runs: Mapping[str, Run], panels: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """Return the panels with a column that any run has logged."""
    return [(key, title) for key, title in panels if any(curve(run.history, key)[0] for run in runs.values())]


def plot_curves(
    axes: Sequence[Any], runs: Mapping[str, Run], panels: Sequence[tuple[str, str]], *, ordered: bool = False
) -> None:
    tints = colors(len(runs), ordered=ordered)
    first = all(row.get("epoch", 0) == 0 for run in runs.values() for row in run.history)
    for axis, (key, title) in zip(axes, panels, strict=True):
        drawn = [curve(run.history, key, by_step=first) for run in runs.values()]
        few = max(len(x) for x, _ in drawn) <= 25
        for name, (x, y), color in zip(runs, drawn, tints, strict=True):
            if x:
                axis.plot(x, y, color=color, label=name, marker="o" if few else None, markersize=3.5)
        axis.set_title(title, loc="left", fontsize=10)
        axis.set_xlabel("step" if first else "epoch")
        axis.set_xlim(left=0)
        if axis.get_ylim()[0] < 0 <= axis.dataLim.y0:  # no negative values below a curve that has none
            axis.set_ylim(bottom=0)
        if axis.get_xlim()[1] > 2:
            axis.xaxis.get_major_locator().set_params(integer=True)


def draw_ratio(runs: Mapping[str, Run]) -> bytes | None:
    """Draw Abs Rel and accuracy against the ratio alpha/beta of eq. (14); None with fewer than two comparable runs."""
    points = sorted(
        (value, score.errors[0], score.errors[4])
        for name, score in comparable(runs).items()
        if (value := ratio(runs[name])) is not None
    )
    if len(points) < 2:
        return None
    figure, axes = new_figure(2, 11.7, 3.3)
    titles = ("Abs Rel (smaller is better)", "δ < 1.25 (larger is better)")
    for axis, column, title in zip(axes, (1, 2), titles, strict=True):
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
    ncols = max(1, min(len(handles), 120 // (max(map(len, handles)) + 8)))
    figure.legend(handles.values(), handles, loc="outside lower center", ncols=ncols, frameon=False, fontsize=9)


def curve(
    history: Sequence[Mapping[str, float]], key: str, points: int = 150, *, by_step: bool = False
) -> tuple[list[float], list[float]]:
    """Return one column of a log against epochs, or steps; long ones as means of neighbors.

    Values logged during an epoch lie between whole numbers, those logged after it on the next whole number: epoch 1 is
    the end of the first.
    """
    rows = [row for row in history if key in row and "step" in row and "epoch" in row]
    if not rows:
        return [], []
    steps = 1 if by_step else _steps_per_epoch(history)
    size = 1 if key.startswith("val/") else -(-len(rows) // points)
    groups = [rows[start : start + size] for start in range(0, len(rows), size)]
    return (
        [sum(row["step"] + 1 for row in group) / len(group) / steps for group in groups],
        [sum(row[key] for row in group) / len(group) for group in groups],
    )


def _steps_per_epoch(history: Sequence[Mapping[str, float]]) -> float:
    """Return the length of an epoch: exact once something was logged at an epoch's end, else the logged part."""
    return max((row["step"] + 1) / (row["epoch"] + 1) for row in history if "step" in row and "epoch" in row)


def read_benchmark(folder: Path) -> list[dict[str, object]]:
    """Return the measurements of a ``benchmark.json``."""
    rows = read_mapping(folder / "benchmark.json").get("results")
    keys = ("model", "size", "device", "precision", "mode", "batch_size", "depth_parameters", "median")
    if not isinstance(rows, list) or not all(isinstance(row, dict) and all(key in row for key in keys) for row in rows):
        raise DataError(f"{folder / 'benchmark.json'} is not a result of saunet benchmark; measure again")
    return rows


def speed(
    benchmarks: Sequence[Path], runs: Mapping[str, Run], seen: Mapping[str, Seen]
) -> tuple[list[Point], Table | None, list[Missing]]:
    """Combine measured times and accuracies.

    A measurement belongs to the runs whose depth network (only that is timed) has exactly its number of parameters and
    its size, because the accuracy applies only there. The figure has one point for each such run, device, precision and
    mode, for single images; if measured twice, the benchmark named last counts.
    """
    scores = chosen(runs)
    group, shared = Groups(scores.values()), comparable(runs)
    networks = {name: (one.parameters[0], f"{one.size[0]}x{one.size[1]}") for name, one in seen.items()}
    points: dict[tuple[str, str], Point] = {}
    rows: dict[str, list[Row]] = {group(score): [] for score in scores.values()}
    alone: list[Row] = []
    missing: list[Missing] = []
    measured = [row for folder in benchmarks for row in read_benchmark(folder)]
    for row in measured:
        batch, size = int(str(row["batch_size"])), str(row["size"])
        kind = f"{row['device']}, {row['precision']}, {row['mode']}"
        how = f"{kind}, batch {batch}"
        seconds = float(str(row["median"])) / batch
        owners = [name for name in scores if networks.get(name) == (row["depth_parameters"], size.lower())]
        if not owners:
            why = f"no scored run has a depth network with exactly this many parameters at {size}"
            missing.append(Missing(f"Accuracy of {row['model']} ({size}, {how})", why))
            alone.append(Row((str(row["model"]), how, size, None, seconds * 1e3), "measured", "Measured: times only"))
        for name in owners:
            accuracy = scores[name].errors[4]
            cells = (name, how, size, accuracy, seconds * 1e3)
            rows[group(scores[name])].append(Row(cells, "measured", group(scores[name])))
            if batch == 1 and name in shared:
                points[name, kind] = Point(name, accuracy, seconds, kind)
            else:
                why = "its time is for several images at once" if batch > 1 else "its accuracy is from other images"
                missing.append(Missing(f"Accuracy against time of {name} ({how})", why))
    if not measured:
        missing.append(
            Missing("Accuracy against time", "no benchmark given; add the folder written by saunet benchmark")
        )
        return [], None, missing
    headings = columns("Method", "Device", "Size", "δ < 1.25 ↑|.3f", "ms per image|.1f")
    notes = ("Times on different devices cannot be compared; the paper's were taken on an AGX Orin.",)
    printed = [(one.method, one.device, "", one.a1, one.seconds * 1e3) for one in published().figure10]
    ours = [row for members in rows.values() for row in members]
    table = (*ours, *alone, *(Row(cells, "published", "Published") for cells in printed))
    return list(points.values()), Table("figure10", "Accuracy and time", headings, table, notes), missing
