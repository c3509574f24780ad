"""Fig. 10: accuracy of the runs against the time that saunet-benchmark measured for networks of exactly their size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from saunet.checks import DataError
from saunet.published import published
from saunet.report.document import Column, Missing, Row, Table
from saunet.report.files import read_json
from saunet.report.runs import Run
from saunet.report.tables import best_score

Point = tuple[str, float, float]
"""Name, accuracy, seconds an image."""


def read_benchmark(folder: Path) -> list[dict[str, object]]:
    """Return the measurements of a ``benchmark.json``.

    Raises:
        DataError: if it is not one.
    """
    content = read_json(folder / "benchmark.json")
    rows = content.get("results") if isinstance(content, dict) else None
    keys = ("model", "size", "device", "precision", "mode", "batch_size", "depth_parameters", "median")
    if not isinstance(rows, list) or not all(isinstance(row, dict) and all(key in row for key in keys) for row in rows):
        raise DataError(f"{folder / 'benchmark.json'} is not a result of saunet-benchmark; measure again")
    return rows


def speed(
    benchmarks: Sequence[Path], runs: Mapping[str, Run], sizes: Mapping[str, tuple[int, int]]
) -> tuple[list[Point], Table | None, list[Missing]]:
    """Bring measured times and accuracies together.

    A measurement belongs to the runs whose depth network has exactly its number of parameters: only that one is timed.

    Args:
        benchmarks: Folders with a ``benchmark.json``.
        runs: Runs by their short names.
        sizes: Parameters of depth and pose network by run.

    Returns:
        The points of Fig. 10, the table behind it, and what was left out.
    """
    points: list[Point] = []
    rows = [
        Row((one.method, one.device, "", one.a1, one.seconds * 1e3), "published", "Published")
        for one in published().figure10
    ]
    missing: list[Missing] = []
    measured = [row for folder in benchmarks for row in read_benchmark(folder)]
    for row in measured:
        how = f"{row['device']}, {row['precision']}, {row['mode']}, batch {row['batch_size']}"
        seconds = float(str(row["median"])) / int(str(row["batch_size"]))
        owners = [
            name for name, counts in sizes.items() if counts[0] == row["depth_parameters"] and best_score(runs[name])
        ]
        if not owners:
            why = "no scored run has a depth network of exactly this size"
            missing.append(Missing(f"Fig. 10, accuracy of {row['model']} ({how})", why))
            rows.append(Row((str(row["model"]), how, str(row["size"]), None, seconds * 1e3), "measured", "Measured"))
        for name in owners:
            score = best_score(runs[name])
            assert score is not None, "owners have one, see above"
            points.append((name, score.errors[4], seconds))
            rows.append(Row((name, how, str(row["size"]), score.errors[4], seconds * 1e3), "measured", "Measured"))
    if not measured:
        missing.append(Missing("Fig. 10", "no benchmark given; name the folder that saunet-benchmark wrote"))
        return [], None, missing
    columns = (
        Column("Method"),
        Column("Device"),
        Column("Size"),
        Column("δ < 1.25", 3, 1),
        Column("ms an image", 1, -1),
    )
    notes = ("Times of different devices do not compare; the paper's were taken on an AGX Orin.",)
    return points, Table("figure10", "Accuracy and time", columns, tuple(rows), notes), missing
