"""Fig. 10: accuracy of the runs against the time that saunet benchmark measured for exactly their networks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from saunet.errors import DataError
from saunet.published import published
from saunet.reporting.groups import Groups, chosen, comparable
from saunet.reporting.page import Missing
from saunet.reporting.scenes import Seen
from saunet.runs.folder import Run, read_mapping
from saunet.tables import Column, Row, Table
from saunet.tables.drawing import Point


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
    """Bring measured times and accuracies together.

    A measurement belongs to the runs whose depth network has exactly its number of parameters (only that one is timed)
    and its size: the accuracy was reached there and nowhere else. The figure has one point for each such run, device,
    precision and mode, of one image at a time; of times measured twice, the one in the benchmark that is named last.
    """
    scores = chosen(runs)
    group, shared = Groups(scores.values()), comparable(runs)
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
        owners = [name for name in scores if name in seen and _timed(row, seen[name])]
        if not owners:
            why = f"no scored run has a depth network of exactly this many parameters that runs at {size}"
            missing.append(Missing(f"Fig. 10, accuracy of {row['model']} ({size}, {how})", why))
            alone.append(Row((str(row["model"]), how, size, None, seconds * 1e3), "measured", "Measured: times alone"))
        for name in owners:
            accuracy = scores[name].errors[4]
            cells = (name, how, size, accuracy, seconds * 1e3)
            rows[group(scores[name])].append(Row(cells, "measured", group(scores[name])))
            if batch == 1 and name in shared:
                points[name, kind] = Point(name, accuracy, seconds, kind)
            else:
                why = "its time is of several images at once" if batch > 1 else "its accuracy is of other images"
                missing.append(Missing(f"Fig. 10, point of {name} ({how})", why))
    if not measured:
        missing.append(Missing("Fig. 10", "no benchmark given; name the folder that saunet benchmark wrote"))
        return [], None, missing
    columns = (
        Column("Method"),
        Column("Device"),
        Column("Size"),
        Column("δ < 1.25", ".3f", 1),
        Column("ms per image", ".1f"),
    )
    notes = ("Times of different devices do not compare; the paper's were taken on an AGX Orin.",)
    printed = [
        Row((one.method, one.device, "", one.a1, one.seconds * 1e3), "published", "Published")
        for one in published().figure10
    ]
    table = (*printed, *(row for members in rows.values() for row in members), *alone)
    return list(points.values()), Table("figure10", "Accuracy and time", columns, table, notes), missing


def _timed(row: Mapping[str, object], network: Seen) -> bool:
    """Return whether a measurement is of a network at its own size."""
    size = "{}x{}".format(*network.size)
    return network.parameters[0] == row["depth_parameters"] and str(row["size"]).lower() == size
