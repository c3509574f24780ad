"""Depth maps made beforehand, one file a frame: dense depth from LiDAR, or what another model predicts.

A recording's maps lie in ``depth_<kind>/<side>/<frame>.png``, beside its images or under the same name in a folder of
their own, as KITTI stores depth (16 bits, 256 steps a unit). ``maps.json`` beside them says how they were made.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from saunet.data.drive import Drive
from saunet.errors import DataError, one_of
from saunet.io.atomic import write_json
from saunet.io.images import read_depth
from saunet.io.plain import read_json

MapKind = Literal["linear", "colorization", "teacher"]
DENSE_KINDS = ("linear", "colorization")
MAP_KINDS = (*DENSE_KINDS, "teacher")
VERSION = 1
"""Of the layout of the files; others are refused."""
INFO = "maps.json"


def place(name: str) -> Path:
    """Return a recording's folder below any root: ``<date>/<drive> l`` becomes ``<date>/<drive>/l``."""
    stem, _, side = name.rpartition(" ")
    return Path(stem, side) if stem and side in ("l", "r") else Path(name)


class DepthMaps:
    """The maps of one kind."""

    def __init__(self, kind: MapKind, folder: str | Path | None = None) -> None:
        one_of("kind of depth maps", kind, MAP_KINDS)
        self.kind: MapKind = kind
        self.folder = None if folder is None else Path(folder).expanduser()
        self._factors: dict[str, float] = {}

    def home(self, drive: Drive) -> Path:
        """Return the folder of a recording's maps."""
        where = place(drive.name)
        if self.folder is not None:
            base = self.folder / (where.parent if where.name in ("l", "r") else where)
        else:
            if drive.folder is None:
                raise DataError(f"'{drive.name}' has no folder beside which depth maps could lie; set data.maps")
            base = drive.folder
        side = where.name if where.name in ("l", "r") else ""
        return base / f"depth_{self.kind}" / side

    def path(self, drive: Drive, frame: int) -> Path:
        """Return the file of a frame's map, whether or not it exists."""
        return self.home(drive) / f"{frame:010d}.png"

    def frames(self, drive: Drive) -> set[int]:
        """Return the numbers of the frames that have a map."""
        home = self.home(drive)
        names = (path.stem for path in home.glob("*.png")) if home.is_dir() else ()
        return {int(name) for name in names if name.isdecimal()}

    def read(self, drive: Drive, frame: int) -> NDArray[np.float32] | None:
        """Return a frame's map, h x w, 0 where unknown; None where there is none."""
        path = self.path(drive, frame)
        if not path.is_file():
            return None
        if drive.name not in self._factors:
            self._factors[drive.name] = float(self.info(drive)["factor"])
        return np.asarray(read_depth(path) / self._factors[drive.name], dtype=np.float32)

    def info(self, drive: Drive) -> dict[str, Any]:
        """Return how a recording's maps were made."""
        path = self.home(drive) / INFO
        try:
            info = read_json(path)
            version, factor = info["version"], float(info["factor"])
        except (OSError, ValueError, KeyError, TypeError) as reason:
            raise DataError(f"{path} is missing or damaged; delete {path.parent} and make its maps again") from reason
        if not (math.isfinite(factor) and factor > 0):
            raise DataError(
                f"{path}: factor is {factor:g}; stored depth is true depth times it, so it must be a positive number: "
                f"delete {path.parent} and make its maps again"
            )
        if version != VERSION:
            raise DataError(
                f"the depth maps in {path.parent} have version {version} and this is for {VERSION}; "
                "delete the folder and make its maps again"
            )
        return dict(info)

    def claim(self, drive: Drive, made_from: Mapping[str, Any], factor: float = 1.0) -> float:
        """Write down how a recording's maps are made, before the first; maps there must be made the same way."""
        path = self.home(drive) / INFO
        made = json.loads(json.dumps(dict(made_from)))
        if path.exists():
            info = self.info(drive)
            changed = [key for key in made if info.get("made_from", {}).get(key) != made[key]]
            if changed:
                raise DataError(
                    f"{path.parent} holds depth maps made with another {', '.join(changed)}; "
                    "delete it, or set folder to another one"
                )
            return float(info["factor"])
        info = {"version": VERSION, "kind": self.kind, "factor": factor, "made_from": made}
        write_json(path, info)
        return factor

    def check(self, wanted: Sequence[tuple[Drive, Sequence[int]]], command: str) -> None:
        """Check that frames have maps."""
        total, missing, first = 0, 0, None
        for drive, frames in wanted:
            there = self.frames(drive)
            lacking = [frame for frame in frames if frame not in there]
            total, missing = total + len(frames), missing + len(lacking)
            if lacking and first is None:
                first = self.path(drive, lacking[0])
            if there:
                self.info(drive)
        if first is not None:
            raise DataError(
                f"{missing} of {total} frames have no {self.kind} depth map, the first {first}; make them: {command}"
            )
