"""Dense depth maps from sparse LiDAR, for a whole KITTI raw tree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import QhullError

from saunet.data.kitti.raw import KittiDrive
from saunet.data.loading.stored import DepthMaps
from saunet.errors import DataError
from saunet.io.colormaps import depth_to_png16
from saunet.io.images import resize, write_image
from saunet.tools.prepare.colorization import colorize
from saunet.tools.prepare.pool import Done, OnError, Work, remove_partial
from saunet.tools.prepare.recordings import Recording

DenseKind = Literal["linear", "colorization"]


def interpolate(depth: Float32[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
    """Return depth interpolated linearly over the Delaunay triangles of the known pixels; 0 outside their hull.

    Where fewer than three pixels are known, or all lie on one line, nothing is added.
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
    """Makes the maps of one frame that are not there yet."""

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
            dense = densify_map(maps.kind, image, depth)
            write_image(maps.path(drive, frame), depth_to_png16(dense))


def densify(
    recordings: Sequence[Recording],
    kinds: Sequence[DenseKind] = ("linear",),
    folder: str | None = None,
    workers: int = 0,
    on_error: OnError = "raise",
) -> Done:
    """Write the dense maps of recordings (``folder`` None: beside each); what is there already is left alone."""
    maps = tuple(DepthMaps(kind, folder) for kind in dict.fromkeys(kinds))
    work: Work[tuple[int, int], None] = Work(_Densify(tuple(drive for drive, _ in recordings), maps), workers, on_error)
    items, total, before = [], 0, 0
    for position, (drive, frames) in enumerate(recordings):
        scanned = [frame for frame in frames if drive.has_depth(frame)]
        total += len(frames) - len(scanned)
        if not scanned:
            continue
        for each in maps:
            each.claim(drive, {"depth": drive.depth_kind})
            remove_partial(each.home(drive))
        there = set.intersection(*(each.frames(drive) for each in maps))
        before += len(there.intersection(scanned))
        items += [(position, frame) for frame in scanned if frame not in there]
    if not items and not before:
        raise DataError(
            f"none of the {total} frames has a scan, such as {recordings[0][0].depth_file(recordings[0][1][0])}; "
            "add the velodyne_points (or proj_depth, for depth=improved)"
        )
    made = sum(1 for _ in work.run(items, "densify"))
    return Done(made, before, total, tuple(work.failures))
