"""Which frames a preparation is about: all below a root, those of a split, or all recordings of a data module."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from saunet.data.drive import Drive
from saunet.data.kitti import splits
from saunet.data.kitti.raw import CAMERAS, DepthKind, KittiDrive, KittiRaw
from saunet.data.loading.module import DepthDataModule
from saunet.data.loading.windows import other_view
from saunet.errors import ConfigError, DataError, suggest

Recording = tuple[KittiDrive, list[int]]
"""A recording and the frames of it that are wanted."""


def kitti_recordings(
    root: str | Path,
    cameras: Sequence[str] = ("left", "right"),
    drives: Sequence[str] = (),
    split: str = "all",
    depth: DepthKind = "camera_z",
) -> list[Recording]:
    """Find the recordings of a KITTI raw tree that have frames of a split (see `PrepareOptions`)."""
    raw = KittiRaw(root)
    for drive in drives:
        if not any(name.endswith(drive) for name in raw.drives):
            hint = suggest(drive, [name.rpartition("/")[2] for name in raw.drives])
            raise ConfigError(f"drives holds '{drive}', which is not below {raw.root}{hint}")
    wanted = _frames(split)
    found: list[Recording] = []
    for name in raw.drives:
        if drives and not any(name.endswith(drive) for drive in drives):
            continue
        for camera in cameras:
            recording = raw.drive(name, camera, depth)
            side = CAMERAS[camera][1]
            frames = [n for n in recording.indices if wanted is None or (name, n, side) in wanted]
            if frames:
                found.append((recording, frames))
    if not found:
        raise DataError(f"the drives below {raw.root} hold no frames of cameras {list(cameras)} and split '{split}'")
    return found


def module_recordings(data: DepthDataModule) -> list[tuple[Drive, Sequence[int]]]:
    """Return the recordings that a data module trains and validates on, with all frames of each.

    With ``stereo`` the other cameras come along.
    """
    if not data.cacheable:
        raise ConfigError(
            f"{type(data).__name__} reads no copies made by saunet prepare; use data=kitti, kitti_odometry or video"
        )
    data.prepare_data()
    drives: dict[str, Drive] = {}
    for split in ("train", "val"):
        for drive, *_ in data.select(split):
            drives.setdefault(drive.name, drive)
            if data.stereo:
                other, _ = other_view(drive)
                drives.setdefault(other.name, other)
    return [(drive, drive.indices) for drive in drives.values() if len(drive.indices)]


def _frames(split: str) -> set[tuple[str, int, str]] | None:
    if split == "all":
        return None
    if split in splits.TRAINING:
        train, val = splits.training_split(split, 0)
        frames = [*train, *val]
    elif split in splits.TEST:
        frames = splits.test_split(split)
    elif Path(split).is_file():
        frames = splits.read_split(Path(split))
    else:
        words = ("all", *splits.TRAINING, *splits.TEST)
        hint = suggest(split, words)
        raise ConfigError(
            f"split is '{split}'{hint or ','} allowed: {', '.join(words)}, or the path of an existing file"
        )
    return {(frame.drive, frame.number + step, frame.side) for frame in frames for step in (-1, 0, 1)}
