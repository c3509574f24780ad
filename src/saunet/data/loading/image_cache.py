"""Smaller copies of recordings, decoded in a fraction of the time; made once by ``saunet prepare cache``.

``cache.json`` says what all copies have in common; ``frames.json`` of each recording lists its frames with their bytes
and hashes, and bytes and time of the originals, and is written last, so that a recording without it is not finished.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from saunet.data.drive import Drive, DriveProxy
from saunet.data.loading.depth_maps import place
from saunet.errors import ConfigError, DataError, in_range, one_of, positive
from saunet.geometry.camera import scale_intrinsics
from saunet.io.images import read_image
from saunet.io.plain import read_json

VERSION = 1
"""Of the layout of the files; others are refused."""
SETTINGS, FRAMES = "cache.json", "frames.json"


@dataclass(frozen=True, slots=True)
class CacheSettings:
    """What all copies of a cache have in common."""

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
        """Return them as they are written into ``cache.json``."""
        return {"version": VERSION, **asdict(self)}


class ImageCache:
    """A folder of smaller copies."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder).expanduser()
        path = self.folder / SETTINGS
        if not path.is_file():
            raise DataError(f"no cache at {self.folder.absolute()} ({SETTINGS} is missing); make it: {self._command()}")
        plain = self._json(path)
        if plain.get("version") != VERSION:
            raise DataError(
                f"the cache at {self.folder} has version {plain.get('version')} and this is for {VERSION}; "
                "delete it and make it again with saunet prepare cache"
            )
        try:
            self.settings = CacheSettings(**{key: plain[key] for key in CacheSettings.__dataclass_fields__})
        except (KeyError, TypeError) as reason:
            raise DataError(f"{path} is damaged; delete the cache and make it again") from reason

    def home(self, drive: Drive) -> Path:
        """Return the folder of a recording's copies."""
        return self.folder / place(drive.name)

    def path(self, drive: Drive, frame: int) -> Path:
        """Return the file of a frame's copy, whether or not it exists."""
        return self.home(drive) / f"{frame:010d}.{self.settings.format}"

    def frames(self, drive: Drive) -> dict[str, Any]:
        """Return what ``frames.json`` of a recording says; empty where it is not finished."""
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
        """Check that copies were made from the images that a recording has now."""
        size = drive.frame_size
        made_from, now = frames["native"], list(size) if size else frames["native"]
        remedy = f"delete {self.home(drive)} and complete the cache: {self._command()}"
        if made_from != now:
            raise DataError(
                f"the copies of '{drive.name}' in the cache come from images of {made_from[0]}x{made_from[1]} and they "
                f"are {now[0]}x{now[1]} (height x width) now; {remedy}"
            )
        if frames.get("origin", "") != drive.origin:
            raise DataError(
                f"the copies of '{drive.name}' in the cache were made from other files, with another camera or with "
                f"other settings (data.fps, parallax, static, crop, max_width), which changes what its frames are; use "
                f"the same, or {remedy}"
            )

    def drive(self, drive: Drive, needed: Iterable[int] = ()) -> CachedDrive:
        """Return a recording that reads the copies."""
        frames = self.frames(drive)
        if not frames:
            raise DataError(f"the cache at {self.folder} does not hold '{drive.name}'; complete it: {self._command()}")
        self.check_origin(drive, frames)
        missing = sorted(f"{frame:010d}" for frame in needed if f"{frame:010d}" not in frames["frames"])
        if missing:
            raise DataError(
                f"the cache at {self.folder} lacks {len(missing)} frames of '{drive.name}', the first {missing[0]}; "
                f"complete it: {self._command()}"
            )
        return CachedDrive(drive, self, frames)

    def _command(self) -> str:
        return f"saunet prepare cache root=... folder={self.folder} (data=... data.root=... where it is not KITTI raw)"

    @staticmethod
    def _json(path: Path) -> dict[str, Any]:
        try:
            return dict(read_json(path))
        except (OSError, ValueError, TypeError) as reason:
            raise _damaged(path) from reason


def _damaged(path: Path) -> DataError:
    return DataError(f"{path} is damaged; delete it and run saunet prepare cache again")


class CachedDrive(DriveProxy):
    """A recording whose images are the cache's; in everything else the recording itself."""

    def __init__(self, drive: Drive, cache: ImageCache, frames: dict[str, Any]) -> None:
        super().__init__(drive)
        self._cache = cache
        self.originals: tuple[int, int] = (frames["native"][0], frames["native"][1])
        """(height, width) of the images that the copies were made from."""

    @property
    def frame_size(self) -> tuple[int, int]:
        """(height, width) of the copies."""
        return self._cache.settings.height, self._cache.settings.width

    def stereo(self) -> CachedDrive | None:
        """Return the other camera's recording, read from the cache too."""
        other = self._drive.stereo()
        return None if other is None else self._cache.drive(other)

    def path(self, index: int) -> Path:
        """Return the file of a smaller frame."""
        return self._cache.path(self._drive, index)

    def image(self, index: int) -> NDArray[np.uint8]:
        """Return the smaller frame, h x w x 3, RGB."""
        return read_image(self.path(index))

    def intrinsics(self, index: int) -> NDArray[np.float64]:
        """Return K in pixels of the smaller frame."""
        settings, (height, width) = self._cache.settings, self.originals
        K = torch.from_numpy(np.asarray(self._drive.intrinsics(index), dtype=np.float64))
        return scale_intrinsics(K, settings.width / width, settings.height / height).numpy()


def check_enlarged(
    cache: ImageCache, drives: Iterable[CachedDrive], size: tuple[int, int], margin: tuple[int, int]
) -> None:
    """Check that training does not enlarge copies of originals that are larger: detail that is there would be lost."""
    copies, loaded = (cache.settings.height, cache.settings.width), (size[0] + margin[0], size[1] + margin[1])
    room = [tuple(map(min, loaded, drive.originals)) for drive in drives]
    if not any(each[0] > copies[0] or each[1] > copies[1] for each in room):
        return
    told = (
        f"the cache at {cache.folder} holds images of {copies[0]}x{copies[1]} (height x width) and training loads "
        f"{loaded[0]}x{loaded[1]}, so that they are enlarged though the originals are larger"
    )
    fix = f"make another with height={loaded[0]} width={loaded[1]}, or set data.height, data.width or data.crop_margin"
    if any(min(each[0], size[0]) > copies[0] or min(each[1], size[1]) > copies[1] for each in room):
        raise ConfigError(f"{told}; {fix}")
    warnings.warn(f"{told}; {fix}", stacklevel=2)
