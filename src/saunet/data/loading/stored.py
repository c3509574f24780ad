"""Files made from recordings beforehand: depth maps, smaller copies of images, projected LiDAR.

- Depth maps of a recording lie in ``depth_<kind>/<side>/<frame>.png``, beside its images or under the same name in a
  folder of their own, as KITTI stores depth (16 bits, 256 steps per unit); ``maps.json`` says how they were made.
- ``cache.json`` of an image cache holds what all copies have in common; ``frames.json`` of each recording lists its
    frames and is written last, so a recording without it is incomplete.
- A LiDAR map is named by a hash of everything it depends on, so nothing ever needs invalidating.
"""

from __future__ import annotations

import math
import warnings
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from saunet.data.drive import Drive, DriveProxy
from saunet.errors import ConfigError, DataError, in_range, one_of, positive
from saunet.geometry.camera import scale_intrinsics
from saunet.io.atomic import replacing, write_json
from saunet.io.images import read_depth, read_image
from saunet.io.plain import different_settings, read_arrays, read_json

MapKind = Literal["linear", "colorization", "teacher"]
DENSE_KINDS = ("linear", "colorization")
VERSION = 1  # of the layout of depth maps and of copies; others are refused
MAPS, SETTINGS, FRAMES = "maps.json", "cache.json", "frames.json"


def _place(name: str) -> tuple[Path, str]:
    """Return a recording's folder below any root, and its side: ``<date>/<drive> l`` is ``<date>/<drive>`` and l."""
    stem, _, side = name.rpartition(" ")
    return (Path(stem), side) if stem and side in ("l", "r") else (Path(name), "")


class DepthMaps:
    """Depth maps of one kind: dense depth from LiDAR, or another model's predictions."""

    def __init__(self, kind: MapKind, folder: str | Path | None = None) -> None:
        one_of("kind of depth maps", kind, (*DENSE_KINDS, "teacher"))
        self.kind: MapKind = kind
        self.folder = None if folder is None else Path(folder).expanduser()
        self._factors: dict[str, float] = {}

    def home(self, drive: Drive) -> Path:
        below, side = _place(drive.name)
        base = drive.folder if self.folder is None else self.folder / below
        if base is None:
            raise DataError(f"'{drive.name}' has no folder to store depth maps beside; set data.maps")
        return base / f"depth_{self.kind}" / side

    def path(self, drive: Drive, frame: int) -> Path:
        return self.home(drive) / f"{frame:010d}.png"

    def frames(self, drive: Drive) -> set[int]:
        return {int(path.stem) for path in self.home(drive).glob("*.png") if path.stem.isdecimal()}

    def read(self, drive: Drive, frame: int) -> NDArray[np.float32] | None:
        """Return a frame's map, h x w, 0 where unknown; None if there is none."""
        path = self.path(drive, frame)
        if not path.is_file():
            return None
        if drive.name not in self._factors:
            self._factors[drive.name] = float(self.info(drive)["factor"])
        return np.asarray(read_depth(path) / self._factors[drive.name], dtype=np.float32)

    def info(self, drive: Drive) -> dict[str, Any]:
        """Return how a recording's maps were made."""
        path = self.home(drive) / MAPS
        try:
            info = read_json(path)
            version, factor = info["version"], float(info["factor"])
        except (OSError, ValueError, KeyError, TypeError) as reason:
            raise DataError(f"{path} is missing or damaged; delete {path.parent} and make its maps again") from reason
        if not (math.isfinite(factor) and factor > 0):
            raise DataError(
                f"{path}: factor is {factor:g}; stored depth is true depth times this factor, so it must be a "
                f"positive number: delete {path.parent} and make its maps again"
            )
        if version != VERSION:
            raise DataError(
                f"the depth maps in {path.parent} have version {version}, but version {VERSION} is required; delete "
                "the folder and make its maps again"
            )
        return dict(info)

    def claim(self, drive: Drive, made_from: Mapping[str, Any], factor: float = 1.0) -> float:
        """Record how a recording's maps are made, before the first one; existing maps must be made the same way."""
        path = self.home(drive) / MAPS
        if path.exists():
            info = self.info(drive)
            if different := different_settings(info.get("made_from"), made_from):
                raise DataError(
                    f"{path.parent} holds depth maps made with {different}; delete it, or set folder to another one"
                )
            return float(info["factor"])
        write_json(path, {"version": VERSION, "kind": self.kind, "factor": factor, "made_from": dict(made_from)})
        return factor

    def check(self, wanted: Sequence[tuple[Drive, Sequence[int]]], command: str) -> None:
        lacking: list[Path] = []
        for drive, frames in wanted:
            there = self.frames(drive)
            lacking += [self.path(drive, frame) for frame in frames if frame not in there]
            if there:
                self.info(drive)
        if lacking:
            raise DataError(
                f"{len(lacking)} of {sum(len(frames) for _, frames in wanted)} frames have no {self.kind} depth map, "
                f"such as {lacking[0]}; make them: {command}"
            )


@dataclass(frozen=True, slots=True)
class CacheSettings:
    """Settings that all copies of a cache have in common."""

    height: int
    width: int
    format: Literal["jpg", "webp"] = "jpg"
    quality: int = 95

    def __post_init__(self) -> None:
        positive("height", self.height)
        positive("width", self.width)
        one_of("format", self.format, ("jpg", "webp"))
        in_range("quality", self.quality, 1, 100)

    def plain(self) -> dict[str, Any]:
        return {"version": VERSION, **asdict(self)}


class ImageCache:
    """A folder of smaller copies made by ``saunet prepare cache``, which decode in a fraction of the time."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder).expanduser()
        path = self.folder / SETTINGS
        if not path.is_file():
            raise DataError(f"no cache at {self.folder.absolute()} ({SETTINGS} is missing); make it: {self._command()}")
        plain = self._json(path)
        if plain.get("version") != VERSION:
            raise DataError(
                f"the cache at {self.folder} has version {plain.get('version')}, but version {VERSION} is required; "
                "delete it and make it again with saunet prepare cache"
            )
        try:
            self.settings = CacheSettings(**{key: plain[key] for key in CacheSettings.__dataclass_fields__})
        except (KeyError, TypeError) as reason:
            raise DataError(f"{path} is damaged; delete the cache and make it again") from reason

    def home(self, drive: Drive) -> Path:
        return self.folder.joinpath(*_place(drive.name))

    def path(self, drive: Drive, frame: int) -> Path:
        return self.home(drive) / f"{frame:010d}.{self.settings.format}"

    def frames(self, drive: Drive) -> dict[str, Any]:
        path = self.home(drive) / FRAMES
        if not path.is_file():
            return {}
        plain = self._json(path)
        native, lists = plain.get("native"), (plain.get("frames"), plain.get("originals", {}))
        whole = isinstance(native, list) and len(native) == 2 and all(isinstance(n, int) and n > 0 for n in native)
        if not whole or not all(isinstance(each, dict) for each in lists):
            raise _damaged(path)
        return plain

    def check_origin(self, drive: Drive, frames: dict[str, Any]) -> None:
        """Check that copies were made from a recording's current images."""
        made_from, now = frames["native"], list(drive.frame_size or frames["native"])
        remedy = f"delete {self.home(drive)} and complete the cache: {self._command()}"
        if made_from != now:
            raise DataError(
                f"the copies of '{drive.name}' in the cache were made from images of {made_from[0]}x{made_from[1]} "
                f"(height x width), which are now {now[0]}x{now[1]}; {remedy}"
            )
        if frames.get("origin", "") != drive.origin:
            raise DataError(
                f"the copies of '{drive.name}' in the cache were made from other files, another camera or other "
                "settings (data.fps, parallax, static, crop, max_width), so they are other frames; use the same, or "
                f"{remedy}"
            )

    def drive(self, drive: Drive, needed: Iterable[int] = ()) -> CachedDrive:
        frames = self.frames(drive)
        if not frames:
            raise DataError(f"the cache at {self.folder} does not hold '{drive.name}'; complete it: {self._command()}")
        self.check_origin(drive, frames)
        missing = sorted({f"{frame:010d}" for frame in needed} - frames["frames"].keys())
        if missing:
            raise DataError(
                f"the cache at {self.folder} lacks {len(missing)} frames of '{drive.name}', the first {missing[0]}; "
                f"complete it: {self._command()}"
            )
        return CachedDrive(drive, self, frames)

    def _command(self) -> str:
        return f"saunet prepare cache root=... folder={self.folder} (data=... data.root=... if it is not KITTI raw)"

    @staticmethod
    def _json(path: Path) -> dict[str, Any]:
        try:
            return dict(read_json(path))
        except (OSError, ValueError, TypeError) as reason:
            raise _damaged(path) from reason


def _damaged(path: Path) -> DataError:
    return DataError(f"{path} is damaged; delete it and run saunet prepare cache again")


class CachedDrive(DriveProxy):
    """A recording with its images from the cache, and everything else from the recording itself."""

    def __init__(self, drive: Drive, cache: ImageCache, frames: dict[str, Any]) -> None:
        super().__init__(drive)
        self._cache = cache
        self.originals: tuple[int, int] = (frames["native"][0], frames["native"][1])
        """(height, width) of the images that the copies were made from."""

    @property
    def frame_size(self) -> tuple[int, int]:
        return self._cache.settings.height, self._cache.settings.width

    def stereo(self) -> CachedDrive | None:
        other = self._drive.stereo()
        return None if other is None else self._cache.drive(other)

    def path(self, index: int) -> Path:
        return self._cache.path(self._drive, index)

    def image(self, index: int) -> NDArray[np.uint8]:
        return read_image(self.path(index))

    def intrinsics(self, index: int) -> NDArray[np.float64]:
        settings, (height, width) = self._cache.settings, self.originals
        K = torch.from_numpy(np.asarray(self._drive.intrinsics(index), dtype=np.float64))
        return scale_intrinsics(K, settings.width / width, settings.height / height).numpy()


def check_enlarged(
    cache: ImageCache, drives: Iterable[CachedDrive], size: tuple[int, int], margin: tuple[int, int]
) -> None:
    """Check that training does not enlarge copies of larger originals: existing detail would be lost."""
    copies, loaded = (cache.settings.height, cache.settings.width), (size[0] + margin[0], size[1] + margin[1])
    room = [tuple(map(min, loaded, drive.originals)) for drive in drives]
    if not any(each[0] > copies[0] or each[1] > copies[1] for each in room):
        return
    told = (
        f"the cache at {cache.folder} holds images of {copies[0]}x{copies[1]} (height x width) but training loads "
        f"{loaded[0]}x{loaded[1]}, so they are enlarged although the originals are larger; make another with "
        f"height={loaded[0]} width={loaded[1]}, or set data.height, data.width or data.crop_margin"
    )
    if any(min(each[0], size[0]) > copies[0] or min(each[1], size[1]) > copies[1] for each in room):
        raise ConfigError(told)
    warnings.warn(told, stacklevel=2)


class CachedTruth(DriveProxy):
    """A drive that keeps its projected ground truth in a folder, and is otherwise the drive itself."""

    def __init__(self, drive: Drive, folder: Path) -> None:
        super().__init__(drive)
        self._folder = folder

    def depth(self, index: int) -> NDArray[np.float32] | None:
        path = self.truth_path(index)
        depth = None if path is None else _read_truth(path)
        if depth is None:
            depth = self._drive.depth(index)
            if path is not None and depth is not None:
                _write_truth(path, depth)
        return depth

    def truth_path(self, index: int) -> Path | None:
        """Return the file of a frame's map; None if the drive's ground truth is not computed."""
        key = self._drive.depth_key(index)
        return None if key is None else self._folder / key[:2] / f"{key[2:32]}.npz"


def cache_truths(drives: list[Drive], folder: str | Path) -> None:
    """Replace the drives of a list with ones that keep the ground truth they compute."""
    drives[:] = [CachedTruth(drive, Path(folder).expanduser()) for drive in drives]


def _read_truth(path: Path) -> NDArray[np.float32] | None:
    """Return a map; None if there is none, or if a failing disk damaged it, so that it is made again."""
    try:
        stored = read_arrays(path)
        depth = np.zeros(tuple(stored["size"]), np.float32)
        depth[stored["rows"], stored["columns"]] = stored["values"]
    except (OSError, ValueError, KeyError, IndexError, EOFError, zipfile.BadZipFile):
        return None
    return depth


def _write_truth(path: Path, depth: NDArray[np.float32]) -> None:
    rows, columns = np.nonzero(depth)
    arrays: dict[str, Any] = {
        "size": np.array(depth.shape, np.int64),
        "rows": rows.astype(np.uint16),
        "columns": columns.astype(np.uint16),
        "values": depth[rows, columns],
    }
    try:
        with replacing(path) as partial, partial.open("wb") as stream:
            np.savez(stream, **arrays)
    except DataError as error:
        raise DataError(f"{error}, or set truth_cache=null to keep no ground truth") from error
