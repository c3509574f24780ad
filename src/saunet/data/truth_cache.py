"""LiDAR ground truth kept on disk: projected once, read back from a small file, made anew when its sources change.

A cached map is named by a hash of all that it depends on: the scan (path, size, time of change), the calibration, the
image size, and which coordinate counts as depth. So there is nothing to invalidate: another scan is another name.
"""

from __future__ import annotations

import hashlib
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from saunet.data.kitti import KittiDrive
from saunet.errors import DataError
from saunet.io.atomic import replacing

FORMAT = 1
"""Part of every name; raised when the projection or the layout of the files changes."""


class CachedTruth:
    """A drive whose projected ground truth is kept in a folder; in everything else the drive itself.

    Args:
        drive: The recording.
        folder: Where maps are kept, shared by all recordings; made when the first is written.
    """

    def __init__(self, drive: KittiDrive, folder: Path) -> None:
        self._drive, self._folder = drive, folder

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "_drive":  # while unpickling there is no drive to ask yet
            raise AttributeError(name)
        return getattr(self._drive, name)

    def depth(self, index: int) -> NDArray[np.float32] | None:
        """Return ground truth as the drive does, from the folder where it is there already.

        Raises:
            DataError: if a scan is broken, or the folder cannot be written to.
        """
        if not self._drive.has_depth(index):
            return None
        path = self.path(index)
        depth = _read(path)
        if depth is None:
            depth = self._drive.depth(index)
            if depth is not None:
                _write(path, depth)
        return depth

    def path(self, index: int) -> Path:
        """Return the file of a frame's map."""
        drive = self._drive
        scan, calibration = drive.depth_file(index), drive.calibration
        state = scan.stat()
        digest = hashlib.sha256(
            repr((FORMAT, drive.depth_kind, str(scan.absolute()), state.st_size, state.st_mtime_ns)).encode()
        )
        digest.update(repr(drive.native_size).encode())
        for matrix in (calibration.projections[drive.number], calibration.rectification, calibration.T_cam_velo):
            digest.update(np.asarray(matrix, dtype=np.float64).tobytes())
        name = digest.hexdigest()
        return self._folder / name[:2] / f"{name[2:32]}.npz"


def cache_truths(drives: list[Any], folder: str | Path) -> int:
    """Replace, in a list of drives, those with projected ground truth by ones that keep it.

    Improved ground truth is a picture already, and rendered drives keep themselves.

    Returns:
        How many were replaced.
    """
    count = 0
    for place, drive in enumerate(drives):
        if isinstance(drive, KittiDrive) and drive.depth_kind != "improved":
            drives[place] = CachedTruth(drive, Path(folder).expanduser())
            count += 1
    return count


def _read(path: Path) -> NDArray[np.float32] | None:
    """Return a map; None where there is none, or one that a failing disk has damaged and that is made anew."""
    try:
        with np.load(path, allow_pickle=False) as stored:
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
