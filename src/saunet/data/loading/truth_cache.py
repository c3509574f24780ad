"""LiDAR ground truth kept on disk: projected once, read back from a small file, made anew when its sources change.

A cached map is named by a hash of all that it depends on: the scan (path, size, time of change), the calibration, the
image size, and which coordinate counts as depth. So there is nothing to invalidate: another scan is another name.
"""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from saunet.data.drive import Drive, DriveProxy
from saunet.errors import DataError
from saunet.io.atomic import replacing
from saunet.io.plain import read_arrays


class CachedTruth(DriveProxy):
    """A drive whose projected ground truth is kept in a folder; in everything else the drive itself."""

    def __init__(self, drive: Drive, folder: Path) -> None:
        super().__init__(drive)
        self._folder = folder

    def depth(self, index: int) -> NDArray[np.float32] | None:
        """Return ground truth as the drive does, from the folder where it is there already."""
        path = self.truth_path(index)
        if path is None:
            return self._drive.depth(index)
        depth = _read(path)
        if depth is None:
            depth = self._drive.depth(index)
            if depth is not None:
                _write(path, depth)
        return depth

    def truth_path(self, index: int) -> Path | None:
        """Return the file of a frame's map; None where the drive's ground truth is not computed."""
        key = self._drive.depth_key(index)
        return None if key is None else self._folder / key[:2] / f"{key[2:32]}.npz"


def cache_truths(drives: list[Drive], folder: str | Path) -> None:
    """Replace the drives of a list by ones that keep what ground truth they compute."""
    drives[:] = [CachedTruth(drive, Path(folder).expanduser()) for drive in drives]


def _read(path: Path) -> NDArray[np.float32] | None:
    """Return a map; None where there is none, or one that a failing disk has damaged and that is made anew."""
    try:
        stored = read_arrays(path)
        depth = np.zeros(tuple(stored["size"]), np.float32)
        depth[stored["rows"], stored["columns"]] = stored["values"]
    except (OSError, ValueError, KeyError, IndexError, EOFError, zipfile.BadZipFile):
        return None
    return depth


def _write(path: Path, depth: NDArray[np.float32]) -> None:
    rows, columns = np.nonzero(depth)
    arrays = {
        "size": np.array(depth.shape, np.int64),
        "rows": rows.astype(np.uint16),
        "columns": columns.astype(np.uint16),
        "values": depth[rows, columns],
    }
    try:
        with replacing(path) as partial, partial.open("wb") as stream:
            np.savez(stream, **arrays)  # type: ignore[arg-type]
    except DataError as error:
        raise DataError(f"{error}, or set truth_cache=null to keep no ground truth") from error
