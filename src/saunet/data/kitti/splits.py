"""Which KITTI frames belong to which split: the published tables, a user's files, or a held-out fraction.

The published division of the Eigen-Zhou frames into training and validation was drawn frame by frame and follows no
rule, so most of its validation frames have a training neighbor. The built-in default therefore holds out whole drives
(`eigen_zhou_by_drive`); `eigen_zhou_random` draws a seeded tenth of the frames; and the published lists themselves are
read from files in Monodepth2's ``folder index side`` format.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

from saunet.data.loading.selecting import Frame, Parts, hold_out_drives, hold_out_random, parse_ranges
from saunet.errors import DataError, one_of

VAL_DRIVES = (
    "2011_09_26/2011_09_26_drive_0005_sync",
    "2011_09_26/2011_09_26_drive_0014_sync",
    "2011_09_26/2011_09_26_drive_0019_sync",
    "2011_09_26/2011_09_26_drive_0032_sync",
    "2011_09_26/2011_09_26_drive_0061_sync",
    "2011_09_29/2011_09_29_drive_0004_sync",
)
"""Eigen training drives held out by drive: city, residential and road, about a tenth of the frames."""


class Row(NamedTuple):
    """One drive of the Eigen table."""

    drive: str
    frames: int  # number of frames in the drive
    listed: list[int]  # test frames of a test drive, static frames of a training drive


@functools.cache
def eigen_table() -> Mapping[str, list[Row]]:
    """Return the rows of the Eigen split by kind: ``eigen_test`` and ``eigen_train_drive``."""
    text = files("saunet.data").joinpath("tables", "kitti_eigen.tsv").read_text(encoding="utf-8")
    rows: dict[str, list[Row]] = {}
    for line in text.splitlines():
        if line and not line.startswith("#"):
            kind, drive, count, ranges = [*line.split("\t"), ""][:4]
            rows.setdefault(kind, []).append(Row(f"{drive[:10]}/{drive}", int(count), parse_ranges(ranges)))
    return rows


def eigen_test() -> list[Frame]:
    """Return the 697 test frames of Eigen, left camera."""
    return [Frame(row.drive, number, "l") for row in eigen_table()["eigen_test"] for number in row.listed]


def eigen_benchmark_test() -> list[Frame]:
    """Return Eigen's 652 test frames with improved ground truth: those at least five frames from a drive's ends."""
    length = {row.drive: row.frames for row in eigen_table()["eigen_test"]}
    return [frame for frame in eigen_test() if 5 <= frame.number <= length[frame.drive] - 6]


def eigen_full() -> list[Frame]:
    """Return all 46 976 frames of the 33 training drives, both cameras."""
    rows = eigen_table()["eigen_train_drive"]
    return [Frame(row.drive, number, side) for row in rows for number in range(row.frames) for side in "lr"]


def eigen_zhou() -> list[Frame]:
    """Return the 44 234 frames of the training drives that have both neighbors and are not static, both cameras."""
    rows = {row.drive: (row.frames - 1, set(row.listed)) for row in eigen_table()["eigen_train_drive"]}
    return [
        frame
        for frame in eigen_full()
        if 0 < frame.number < rows[frame.drive][0] and frame.number not in rows[frame.drive][1]
    ]


TRAINING: Mapping[str, Callable[[int], Parts]] = {
    "eigen_full": lambda seed: hold_out_drives(eigen_full(), VAL_DRIVES),
    "eigen_zhou_by_drive": lambda seed: hold_out_drives(eigen_zhou(), VAL_DRIVES),
    "eigen_zhou_random": lambda seed: hold_out_random(eigen_zhou(), 0.1, seed),
}
"""Name of a training split -> a function of the seed that gives its training and validation frames."""
TEST: Mapping[str, Callable[[], list[Frame]]] = {"eigen_test": eigen_test, "eigen_benchmark_test": eigen_benchmark_test}
"""Name of a test split -> its frames."""


def training_split(name: str, seed: int = 0) -> Parts:
    return TRAINING[one_of("split", name, TRAINING)](seed)


def test_split(name: str) -> list[Frame]:
    return TEST[one_of("test_split", name, TEST)]()


_LINE = "'<date>/<drive> <frame number> <l or r>'"


def read_split(path: Path) -> list[Frame]:
    """Read a list in Monodepth2's format: lines ``<date>/<drive> <frame> <l or r>``."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as reason:
        raise DataError(f"cannot read split file {path}: {reason}") from reason
    frames = []
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        words = line.split()
        number_ok = len(words) == 3 and words[1].isdecimal() and len(words[1]) <= 18
        if not number_ok or words[2] not in ("l", "r") or words[0].count("/") != 1:
            raise DataError(f"{path}, line {number}: expected {_LINE}, got '{line.strip()[:80]}'")
        frames.append(Frame(words[0], int(words[1]), words[2]))
    if not frames:
        raise DataError(f"{path} lists no frames; expected lines {_LINE}")
    return frames
