"""The inertial unit and the clocks of KITTI raw recordings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from saunet.errors import DataError


def oxts_speed(path: Path) -> float:
    """Return the speed in m/s of a record of KITTI's inertial unit: the length of (vf, vl, vu)."""
    try:
        words = path.read_text(encoding="utf-8", errors="replace").split()
        velocity = np.array([float(word) for word in words[8:11]])
    except OSError as reason:
        raise DataError(f"cannot read {path}: {reason.strerror or reason}") from reason
    except ValueError:
        velocity = np.empty(0)
    if velocity.size != 3 or not np.isfinite(velocity).all():
        raise DataError(f"{path}: expected the 30 numbers of an OXTS record; values 9 to 11 are the speeds vf, vl, vu")
    return float(np.linalg.norm(velocity))


def read_timestamps(path: Path) -> NDArray[np.float64] | None:
    """Read the ``timestamps.txt`` of a KITTI raw camera: seconds, one per frame from frame 0; None if there is none."""
    if not path.is_file():
        return None
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").split("\n")
    except OSError as reason:
        raise DataError(f"cannot read {path}: {reason.strerror or reason}") from reason
    while lines and not lines[-1].strip():
        lines.pop()
    times = np.empty(len(lines))
    for number, line in enumerate(lines):
        try:
            stamp = np.datetime64(line.strip() or "empty", "ns")
            times[number] = stamp.astype(np.int64) / 1e9
        except ValueError:
            raise DataError(
                f"{path}, line {number + 1}: expected a time such as '2011-09-26 13:02:25.964389445', "
                f"got '{line.strip()[:40]}'"
            ) from None
    return times
