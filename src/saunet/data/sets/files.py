"""Files as the public data sets write them: numbered images, tables of numbers, depth maps beside images."""

from __future__ import annotations

import functools
import os
import re
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from saunet.data.drive import Drive
from saunet.data.loading.selecting import BETWEEN, Division, divide
from saunet.data.loading.windows import Selection, reach
from saunet.data.sets.base import FilesDataModule, FilesDrive
from saunet.errors import DataError, in_range
from saunet.io.plain import read_text

Array = NDArray[np.float64]


class DepthFilesDrive(FilesDrive):
    """A recording whose images have depth maps in files; it may be one side of a rectified pair.

    Attributes:
        depths: Frame number -> file of its depth map.
        other: The other camera, if there is one.
        T_other_cam: This camera's pose in the other's frame, 4 x 4, meters.
    """

    depths: Mapping[int, Path] = {}
    other: DepthFilesDrive | None = None
    T_other_cam: Array | None = None

    @staticmethod
    @abstractmethod
    def read(path: Path) -> NDArray[np.float32]:
        """Return the depth map in a file, h x w, meters, 0 where unknown."""

    def has_depth(self, index: int) -> bool:
        return index in self.depths

    def depth(self, index: int) -> NDArray[np.float32] | None:
        return self.read(self.depths[index]) if index in self.depths else None

    def stereo(self) -> DepthFilesDrive | None:
        return self.other

    @property
    def T_stereo_cam(self) -> Array | None:  # noqa: N802 (frames in names)
        return self.T_other_cam


def pair_up(left: DepthFilesDrive, right: DepthFilesDrive, T_right_left: Array) -> None:
    """Make two recordings the two sides of a pair."""
    left.other, right.other = right, left
    T_left_right: Array = np.asarray(np.linalg.inv(T_right_left), np.float64)
    left.T_other_cam, right.T_other_cam = T_right_left, T_left_right


class RecordingsDataModule(FilesDataModule):
    """A data set without a published split: recordings are held out by name, or a fraction of all frames.

    A subclass implements `find` and sets the three attributes by `hold_out`.
    """

    val_drives: tuple[str, ...] = ()
    test_drives: tuple[str, ...] = ()
    val_share: float = 0.1

    def hold_out(self, val_drives: Sequence[str], test_drives: Sequence[str], val_share: float) -> None:
        self.val_drives, self.test_drives = tuple(val_drives), tuple(test_drives)
        self.val_share = in_range("val_share", val_share, 0.0, 0.9)

    def find(self) -> Sequence[Drive]:
        """Return all recordings below the root."""
        raise NotImplementedError(f"{type(self).__name__} does not implement finding its recordings")

    @functools.cached_property
    def recordings(self) -> Mapping[str, Drive]:
        """All recordings by name."""
        return {drive.name: drive for drive in self.find()}

    @functools.cached_property
    def _division(self) -> Division:
        frames = {name: drive.indices for name, drive in self.recordings.items()}
        settings = {"val_drives": self.val_drives, "test_drives": self.test_drives}
        return divide(frames, settings, self.val_share, reach(self.offsets), self.seed)

    def overlap(self) -> str | None:
        return self._division.overlap()

    def drives(self, split: str) -> Sequence[Drive]:
        return [self.recordings[name] for name in self._division.of(split)]

    def targets(self, split: str, drive: Drive) -> Sequence[int]:
        return self._division.of(split)[drive.name]

    def select(self, split: str) -> Sequence[Selection]:
        """Return the frames of a split, and for training also the number in no split."""
        unused = self._division.unused if split == "train" else {}
        return [
            Selection(drive, frames, {**left_out, BETWEEN: unused.get(drive.name, 0)})
            for drive, frames, left_out in super().select(split)
        ]


def numbered(folder: Path, pattern: str) -> dict[int, Path]:
    """Return number -> file for the names in a folder that fit a pattern whose first group is the number."""
    try:
        names = sorted(os.listdir(folder))
    except (FileNotFoundError, NotADirectoryError):
        return {}
    matches = (re.fullmatch(pattern, name) for name in names)
    return {int(match[1]): folder / match[0] for match in matches if match}


def read_rows(path: Path, columns: Sequence[str], *, skip: int = 0, fix: str = "copy it again") -> Array:
    """Read a table of numbers separated by spaces or commas, one row per line.

    Args:
        path: The file.
        columns: The names of its columns.
        skip: Number of header lines; lines that start with ``#`` are comments.
        fix: What to do if it is missing or damaged.

    Raises:
        DataError: if it is missing, or a line does not have one finite number per column.
    """
    table = []
    for number, words in read_words(path, fix)[skip:]:
        try:
            values = [float(word) for word in words]
        except ValueError:
            values = []
        if len(values) != len(columns) or not np.isfinite(values).all():
            got = " ".join(words)[:60]
            raise DataError(f"{path}, line {number}: expected the numbers {' '.join(columns)}, got '{got}'; {fix}")
        table.append(values)
    return np.array(table, np.float64).reshape(-1, len(columns))


def read_words(path: Path, fix: str = "copy it again") -> list[tuple[int, list[str]]]:
    """Return (line number, words between spaces or commas) of a file's lines, without comments."""
    try:
        lines = read_text(path, error=DataError).splitlines()
    except OSError as reason:
        raise DataError(f"cannot read {path} ({reason.strerror or reason}); {fix}") from reason
    return [
        (number, line.replace(",", " ").split())
        for number, line in enumerate(lines, 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
