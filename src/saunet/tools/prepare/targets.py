"""Depth maps to train on for a KITTI raw tree: dense ones from sparse LiDAR, or another model's."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import QhullError

from saunet.data.kitti.raw import KittiDrive
from saunet.data.loading.stored import DepthMaps
from saunet.data.loading.windows import sample_name
from saunet.errors import DataError
from saunet.io.atomic import remove_partial_files
from saunet.io.colormaps import depth_to_png16
from saunet.io.images import read_depth, resize, write_image
from saunet.io.plain import read_array
from saunet.tools.prepare.colorization import colorize
from saunet.tools.prepare.pool import HERE, Done, OnError, Work, Workers

Recording = tuple[KittiDrive, list[int]]
"""A recording and the frames of it that are wanted."""
DenseKind = Literal["linear", "colorization"]
Values = Literal["depth", "disparity"]
_ENDINGS = ("", "_depth", "_disp")
"""What may stand between the name of an image and the suffix of its file."""
_TYPICAL = 16.0
"""Depth of which 16-bit steps of 1/256 are fine enough, and which leaves room for what is farther."""


def interpolate(depth: Float32[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
    """Interpolate depth linearly over the Delaunay triangles of the known pixels; 0 outside their hull.

    If fewer than three pixels are known, or all lie on one line, nothing is added.
    """
    rows, columns = np.nonzero(depth)
    try:
        surface = LinearNDInterpolator(np.stack([columns, rows], -1), depth[rows, columns], fill_value=0.0)
    except (QhullError, ValueError):
        return depth.copy()
    grid_rows, grid_columns = np.indices(depth.shape)
    return np.asarray(surface(grid_columns, grid_rows), dtype=np.float32)


def densify_map(kind: str, image: UInt8[ndarray, "_ _ 3"], depth: Float32[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
    """Return a dense map of a kind at the size of ``depth`` (meters, 0 where unknown)."""
    return interpolate(depth) if kind == "linear" else colorize(resize(image, *depth.shape), depth)


@dataclass(frozen=True, slots=True)
class _Densify:
    """Makes the missing maps of one frame."""

    drives: tuple[KittiDrive, ...]
    maps: tuple[DepthMaps, ...]

    def __call__(self, item: tuple[int, int]) -> None:
        drive, frame = self.drives[item[0]], item[1]
        missing = [maps for maps in self.maps if not maps.path(drive, frame).is_file()]
        depth = drive.depth(frame)
        if depth is None or not depth.any():
            raise DataError(f"{drive.depth_file(frame)} has no point in the image of '{drive.name}'")
        image = drive.image(frame)
        for maps in missing:
            write_image(maps.path(drive, frame), depth_to_png16(densify_map(maps.kind, image, depth)))


def densify(
    recordings: Sequence[Recording],
    kinds: Sequence[DenseKind] = ("linear",),
    folder: str | None = None,
    workers: Workers = HERE,
    on_error: OnError = "raise",
) -> Done:
    """Write the dense maps of recordings (``folder`` None: beside each); existing ones are kept."""
    maps = tuple(DepthMaps(kind, folder) for kind in kinds)
    items, without, before = [], 0, 0
    for position, (drive, frames) in enumerate(recordings):
        scanned = [frame for frame in frames if drive.has_depth(frame)]
        without += len(frames) - len(scanned)
        if not scanned:
            continue
        for each in maps:
            each.claim(drive, {"depth": drive.depth_kind})
            remove_partial_files(each.home(drive), ".*.partial*")
        there = set.intersection(*(each.frames(drive) for each in maps))
        before += len(there.intersection(scanned))
        items += [(position, frame) for frame in scanned if frame not in there]
    if not items and not before:
        raise DataError(
            f"none of the {without} frames has a scan, such as {recordings[0][0].depth_file(recordings[0][1][0])}; "
            "add the velodyne_points (or proj_depth, for depth=improved)"
        )
    work: Work[tuple[int, int], None] = Work(_Densify(tuple(drive for drive, _ in recordings), maps), workers, on_error)
    return Done(sum(1 for _ in work.run(items, "densify")), before, without, tuple(work.failures))


class ModelTeacher:
    """Depth as a model predicts it."""

    def __init__(self, predictor: Any) -> None:
        self.predictor = predictor

    def made_from(self) -> dict[str, Any]:
        """Return the settings that decide the values, to record beside them."""
        return {"model": self.predictor.fingerprint}

    def depth(self, drive: KittiDrive, frame: int) -> Float32[ndarray, "_ _"]:
        """Return depth up to scale, 0 where unknown, at its own size."""
        return np.asarray(self.predictor.predict(drive.image(frame), str(drive.path(frame))).depth, dtype=np.float32)


class FileTeacher:
    """Depth from files of any system.

    A frame's file is named after the frame (``2011_09_26-2011_09_26_drive_0001_sync-0000000005-l``, any characters
    between the parts), or lies where the image lies (``.../2011_09_26_drive_0001_sync/image_02/data/0000000005``, with
    or without the date above it; without the drive, if all files lie in one folder); ``_depth`` or ``_disp`` may
    follow. ``.npy`` holds numbers, ``.png`` 16 bits of 1/256.

    With ``values="disparity"`` the numbers are inverse depth up to scale. 0 or less is unknown.
    """

    def __init__(self, folder: str | Path, values: Values = "depth") -> None:
        self.folder, self.values = Path(folder).expanduser(), values
        files = sorted(self.folder.rglob("*")) if self.folder.is_dir() else []
        self._files = {
            _plain(path.relative_to(self.folder).with_suffix("").as_posix()): path
            for path in files
            if path.suffix.lower() in (".npy", ".png")
        }
        if not self._files:
            raise DataError(f"no .npy or .png files below {self.folder.absolute()}; set input to a teacher's folder")

    def made_from(self) -> dict[str, Any]:
        return {"input": str(self.folder.resolve()), "values": self.values}

    def file(self, drive: KittiDrive, frame: int) -> Path:
        """Return the file of a frame."""
        tree = f"{drive.folder.name}/image_{drive.number:02d}/data/{frame:010d}"
        names = [sample_name(drive.name, frame), f"{drive.folder.parent.name}/{tree}", tree]
        if len({path.parent for path in self._files.values()}) == 1:  # the depth of one recording
            names += [tree.partition("/")[2], f"{frame:010d}"]
        for name in names:
            for ending in _ENDINGS:
                path = self._files.get(_plain(name + ending))
                if path is not None:
                    return path
        raise DataError(
            f"{self.folder} has no depth for {drive.path(frame)}; expected {names[1]}.npy or .png there, "
            f"or {_plain(names[0])}.npy"
        )

    def depth(self, drive: KittiDrive, frame: int) -> Float32[ndarray, "_ _"]:
        path = self.file(drive, frame)
        values = read_depth(path) if path.suffix.lower() == ".png" else _read_numbers(path)
        known = np.isfinite(values) & (values > 0)
        if self.values == "disparity":
            values = np.divide(1, values, where=known, out=np.zeros_like(values))
        return np.where(known, values, 0).astype(np.float32)


def _plain(name: str) -> str:
    """Return a name in which all but letters and digits is one kind of separator."""
    return "-".join("".join(c if c.isalnum() else " " for c in name).split())


def _read_numbers(path: Path) -> Float32[ndarray, "_ _"]:
    try:
        array = np.squeeze(read_array(path))
    except OSError as reason:
        raise DataError(f"cannot read {path}: {reason.strerror or reason}; check its rights") from reason
    if array.ndim != 2 or array.dtype.kind not in "fiu":
        raise DataError(f"{path} holds {array.dtype} of shape {array.shape}; depth is height x width numbers")
    return np.asarray(array, dtype=np.float32)


@dataclass(frozen=True, slots=True)
class _Teach:
    """Writes the teacher's depth of one frame; the first of a recording decides the factor of all."""

    drives: tuple[KittiDrive, ...]
    source: ModelTeacher | FileTeacher
    maps: DepthMaps
    factors: dict[int, float] = field(default_factory=dict)

    def __call__(self, item: tuple[int, int]) -> None:
        drive, frame = self.drives[item[0]], item[1]
        depth = self.source.depth(drive, frame)
        known = depth[depth > 0]
        if known.size == 0:
            raise DataError(f"the teacher knows no depth in {drive.path(frame)}")
        if item[0] not in self.factors:
            # Relative depth may be of any magnitude; a power of two brings it to where 16 bits resolve it.
            scale = 2.0 ** round(math.log2(_TYPICAL / float(np.median(known))))
            self.factors[item[0]] = self.maps.claim(drive, self.source.made_from(), scale)
        write_image(self.maps.path(drive, frame), depth_to_png16(depth * np.float32(self.factors[item[0]])))


def teach(
    recordings: Sequence[Recording],
    source: ModelTeacher | FileTeacher,
    folder: str | None = None,
    workers: Workers = HERE,
    on_error: OnError = "raise",
) -> Done:
    """Write a teacher's depth for recordings (``folder`` None: beside each); existing maps are kept.

    A single worker processes all frames of a recording.
    """
    maps = DepthMaps("teacher", folder)
    items, before = [], 0
    for position, (drive, frames) in enumerate(recordings):
        remove_partial_files(maps.home(drive), ".*.partial*")
        if (maps.home(drive) / "maps.json").exists():
            maps.claim(drive, source.made_from())
        there = maps.frames(drive)
        before += len(there.intersection(frames))
        items += [(position, frame) for frame in frames if frame not in there]
    teacher = _Teach(tuple(drive for drive, _ in recordings), source, maps)
    work: Work[tuple[int, int], None] = Work(teacher, workers, on_error)
    done = sum(1 for _ in work.run(items, "teacher", together=itemgetter(0)))
    return Done(done, before, None, tuple(work.failures))
