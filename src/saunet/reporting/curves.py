"""Curves against epochs out of a run's log, at whatever intervals it was written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

Curve = tuple[list[float], list[float]]
"""Epochs and values."""


def curve(history: Sequence[Mapping[str, float]], key: str, points: int = 150) -> Curve:
    """Return one column of a log against epochs; long ones as means of neighbors.

    What is logged during an epoch lies between its whole numbers, what is logged after it on the next one: epoch 1 is
    the end of the first.

    Args:
        history: Rows with ``epoch`` and ``step``, both counted from 0.
        key: The column.
        points: How many points a training curve has at most.
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
