"""Smaller copies of recordings, decoded in a fraction of the time; made once by ``saunet-prepare cache``.

``cache.json`` says what all copies have in common; ``frames.json`` of each recording lists its frames with their bytes
and hashes and is written last, so that a recording without it is not finished.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import torch
from numpy.typing import NDArray

from saunet.checks import DataError, in_range, one_of, positive
from saunet.data.depth_maps import place
from saunet.data.sequences import Drive, MeasuredDrive, StereoDrive
from saunet.geometry.camera import scale_intrinsics
from saunet.images import read_image

VERSION = 1
"""Of the layout of the files; others are refused."""
SETTINGS, FRAMES = "cache.json", "frames.json"


@dataclass(frozen=True, slots=True)
class CacheSettings:
    """What all copies of a cache have in common.

    Args:
        height: Rows of each copy.
        width: Columns of each copy.
        format: ``jpg`` or ``webp``.
        quality: 1 to 100.

    Raises:
        ConfigError: if one is out of range.
    """

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
    """A folder of smaller copies.

    Args:
        folder: The folder that ``saunet-prepare cache`` made.

    Raises:
        DataError: if it is not there, not whole, or of another version.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder).expanduser()
        path = self.folder / SETTINGS
        if not path.is_file():
            raise DataError(f"no cache at {self.folder.absolute()} ({SETTINGS} is missing); make it: {self._command()}")
        plain = self._json(path)
        if plain.get("version") != VERSION:
            raise DataError(
                f"the cache at {self.folder} has version {plain.get('version')} and this is for {VERSION}; "
                "delete it and make it again with saunet-prepare cache"
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
        """Return what ``frames.json`` of a recording says; empty where it is not finished.

        Raises:
            DataError: if the file is damaged.
        """
        path = self.home(drive) / FRAMES
        return self._json(path) if path.is_file() else {}

    def drive(self, drive: Drive, needed: Iterable[int] = ()) -> CachedDrive:
        """Return a recording that reads the copies.

        Args:
            drive: The recording.
            needed: Frames that the cache must hold.

        Raises:
            DataError: if the cache does not hold it.
        """
        frames = self.frames(drive)
        if not frames:
            raise DataError(f"the cache at {self.folder} does not hold '{drive.name}'; complete it: {self._command()}")
        # Not isinstance: that would ask the drive where its partner is, and a recording of one camera may not know.
        kind = CachedStereoDrive if hasattr(type(drive), "partner") else CachedDrive
        missing = sorted(f"{frame:010d}" for frame in needed if f"{frame:010d}" not in frames["frames"])
        if missing:
            raise DataError(
                f"the cache at {self.folder} lacks {len(missing)} frames of '{drive.name}', the first {missing[0]}; "
                f"complete it: {self._command()}"
            )
        return kind(drive, self, frames)

    def _command(self) -> str:
        return f"saunet-prepare cache root=... folder={self.folder}"

    @staticmethod
    def _json(path: Path) -> dict[str, Any]:
        try:
            return dict(json.loads(path.read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError) as reason:
            raise DataError(f"{path} is damaged; delete it and run saunet-prepare cache again") from reason


class CachedDrive:
    """A recording whose images are the cache's; in everything else the recording itself.

    Args:
        drive: The recording.
        cache: Where its copies are.
        frames: What ``frames.json`` says of it.
    """

    def __init__(self, drive: Drive, cache: ImageCache, frames: dict[str, Any]) -> None:
        self.name = drive.name
        self._drive, self._cache = drive, cache
        self._native: tuple[int, int] = (frames["native"][0], frames["native"][1])

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "_drive":  # while unpickling there is no drive to ask yet
            raise AttributeError(name)
        return getattr(self._drive, name)

    @property
    def indices(self) -> Sequence[int]:
        """Numbers of the frames that exist, ascending."""
        return self._drive.indices

    def depth(self, index: int) -> NDArray[np.float32] | None:
        """Return ground-truth depth as the recording does, at its size."""
        return self._drive.depth(index)

    def pose(self, index: int) -> NDArray[np.float64] | None:
        """Return T_world_cam as the recording does."""
        return self._drive.pose(index)

    def distance(self, first: int, second: int) -> float | None:
        """Return the metres travelled between two frames as the recording does; None where it does not know."""
        return self._drive.distance(first, second) if isinstance(self._drive, MeasuredDrive) else None

    def path(self, index: int) -> Path:
        """Return the file of a smaller frame."""
        return self._cache.path(self._drive, index)

    def image(self, index: int) -> NDArray[np.uint8]:
        """Return the smaller frame, h x w x 3, RGB.

        Raises:
            DataError: if it is missing or broken.
        """
        return read_image(self.path(index))

    def intrinsics(self, index: int) -> NDArray[np.float64]:
        """Return K in pixels of the smaller frame."""
        settings, (height, width) = self._cache.settings, self._native
        K = torch.from_numpy(np.asarray(self._drive.intrinsics(index), dtype=np.float64))
        return scale_intrinsics(K, settings.width / width, settings.height / height).numpy()


class CachedStereoDrive(CachedDrive):
    """A recording with a stereo partner, both read from the cache."""

    def partner(self) -> CachedDrive:
        """Return the other camera's recording."""
        return self._cache.drive(self._stereo.partner())

    @property
    def T_partner_cam(self) -> NDArray[np.float64]:  # noqa: N802 (frames in names)
        """Where the other camera is, 4 x 4, metres."""
        return self._stereo.T_partner_cam

    @property
    def _stereo(self) -> StereoDrive:
        return cast(StereoDrive, self._drive)  # ImageCache.drive chose this class for it
