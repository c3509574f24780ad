"""Frame windows as samples: a target frame, its neighbors in time, and whatever truth the recording has.

A window is usable when the frames at all offsets exist. What is left out is counted, never silently dropped.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Dataset

from saunet.data.checks import check_frame
from saunet.data.drive import Drive
from saunet.data.loading.depth_maps import DepthMaps
from saunet.data.loading.options import check_offsets
from saunet.data.loading.resize import resize_depth
from saunet.data.loading.stereo import Odometer, other_view, stereo_image
from saunet.errors import DataError
from saunet.fingerprint import fingerprint
from saunet.geometry.camera import scale_intrinsics
from saunet.io.images import resize
from saunet.types import FrameBatch

DRAWS = 8
"""Random numbers that come with each training sample; see `saunet.data.loading.transforms.Augment`."""


class Selection(NamedTuple):
    """The frames of one drive that a split asks for."""

    drive: Drive
    frames: Sequence[int]
    """Numbers of the target frames wanted."""
    left_out: Mapping[str, int] = {}
    """Frames already left out and why: ``{"static": 12}``."""


class Item(NamedTuple):
    """What a training sampler asks of `WindowDataset`: which sample, and the seed of its random numbers."""

    sample: int
    seed: int


@dataclass(frozen=True, slots=True)
class Usage:
    """How many frames of one drive are used, and why the others are not."""

    drive: str
    used: int
    left_out: Mapping[str, int] = field(default_factory=dict)

    def __str__(self) -> str:
        reasons = ", ".join(f"{count} {reason}" for reason, count in self.left_out.items() if count)
        if not self.used and not reasons:
            return f"{self.drive}: no frames"
        return f"{self.drive}: {self.used} frames used" + (f"; left out: {reasons}" if reasons else "")


def find_windows(
    selections: Sequence[Selection], offsets: Sequence[int], stereo: bool = False
) -> tuple[list[tuple[int, int]], list[Usage]]:
    """Find the frames whose neighbors at all offsets exist, with no gap in time between them.

    Args:
        selections: Drives with the frames wanted of each.
        offsets: Time offsets of the source frames; empty for single frames.
        stereo: Ask for the stereo view of each frame too.

    Returns:
        The windows as (position in ``selections``, frame number), and one `Usage` a drive.

    Raises:
        DataError: if a drive has no stereo view and one is asked for.
    """
    windows, usage = [], []
    for position, selection in enumerate(selections):
        drive = selection.drive
        existing = set(drive.indices)
        paired = set(other_view(drive)[0].indices) if stereo else existing
        gaps = sorted(drive.gaps) if offsets else []
        first, last = min((0, *offsets)), max((0, *offsets))
        left_out = dict(selection.left_out)
        used = 0
        for frame in selection.frames:
            if frame not in existing:
                left_out["missing"] = left_out.get("missing", 0) + 1
            elif any(frame + offset not in existing for offset in offsets):
                left_out["without neighbor"] = left_out.get("without neighbor", 0) + 1
            elif bisect_left(gaps, frame + first) != bisect_left(gaps, frame + last):
                left_out["across a gap in time"] = left_out.get("across a gap in time", 0) + 1
            elif frame not in paired:
                left_out["without stereo view"] = left_out.get("without stereo view", 0) + 1
            else:
                windows.append((position, frame))
                used += 1
        usage.append(Usage(drive.name, used, left_out))
    return windows, usage


class WindowDataset(Dataset[dict[str, Any]]):
    """Samples of `saunet.types.FrameBatch`, one a window.

    ``dataset[i]`` is a sample; ``dataset[Item(i, seed)]`` adds the random numbers that augmentation uses, drawn from
    the seed alone, so that they do not depend on workers or devices; a list of either is a list of samples, ready for
    `collate`.

    Args:
        drives: The recordings.
        windows: (position in ``drives``, target frame number); see `find_windows`.
        offsets: Time offsets of the source frames.
        height: Height of the frames yielded, before any margin.
        width: Width of the frames yielded, before any margin.
        margin: Rows and columns that the frames are larger than that, room for a random crop.
        with_depth: Yield ground truth at its native size where the drive has it.
        with_target_depth: Yield depth at the size of the frames (zeros where the drive has none).
        with_pose: Yield true motion; every drive must know it.
        stereo: Yield the stereo view as the last source, and where it is.
        odometer: Gives the distance traveled; None yields none.
        maps: Depth maps made beforehand, by the key under which they are yielded at the size of the frames.

    Raises:
        ConfigError: if an offset is 0 or given twice.
    """

    def __init__(
        self,
        drives: Sequence[Drive],
        windows: Sequence[tuple[int, int]],
        *,
        offsets: Sequence[int],
        height: int,
        width: int,
        margin: tuple[int, int] = (0, 0),
        with_depth: bool = False,
        with_target_depth: bool = False,
        with_pose: bool = False,
        stereo: bool = False,
        odometer: Odometer | None = None,
        maps: Mapping[str, DepthMaps] = MappingProxyType({}),
    ) -> None:
        check_offsets(offsets)
        self.drives = list(drives)
        self.windows = list(windows)
        self.offsets = tuple(offsets)
        self.size = (height + margin[0], width + margin[1])
        self.with_depth = with_depth
        self.with_target_depth = with_target_depth
        self.with_pose = with_pose
        self.stereo = stereo
        self.odometer = odometer
        self.maps = dict(maps)

    def __len__(self) -> int:
        return len(self.windows)

    def __getitem__(self, item: int | Item | list[int] | list[Item]) -> Any:
        """Return one sample, or a list of samples for a list."""
        if isinstance(item, list):
            return [self[one] for one in item]
        if isinstance(item, Item):
            return {**self._sample(item.sample), "draws": draw(item.seed)}
        return self._sample(item)

    def name(self, index: int) -> str:
        """Return the readable name of a sample, such as ``2011_09_26/2011_09_26_drive_0001_sync 0000000005 l``."""
        position, frame = self.windows[index]
        return sample_name(self.drives[position].name, frame)

    def fingerprint(self) -> str:
        """Return the SHA-256 of the sorted sample names, one a line: equal for equal sets of frames."""
        return fingerprint([self.name(index) for index in range(len(self))])

    def _sample(self, index: int) -> dict[str, Any]:
        position, frame = self.windows[index]
        drive = self.drives[position]
        named = {f"frame {frame + offset}": drive.image(frame + offset) for offset in (0, *self.offsets)}
        if self.stereo:
            named[f"the stereo view of frame {frame}"], T_stereo_tgt = stereo_image(drive, frame)
        check_frame(drive, frame, named[f"frame {frame}"])
        images = list(named.values())
        native = images[0].shape
        for what, image in named.items():
            if image.ndim != 3 or image.shape != native:
                raise DataError(
                    f"{what} of '{drive.name}' has shape {tuple(image.shape)} "
                    f"where its neighbor {frame} has {tuple(native)}; frames of a drive share one size"
                )
        height, width = self.size
        frames = np.stack([resize(image, height, width).transpose(2, 0, 1) for image in images])
        K = torch.from_numpy(np.asarray(drive.intrinsics(frame), dtype=np.float64))
        sample: dict[str, Any] = {
            "frames": torch.from_numpy(frames),
            "K": scale_intrinsics(K, width / native[1], height / native[0]).float(),
            "name": self.name(index),
        }
        if self.with_depth or self.with_target_depth:
            depth = drive.depth(frame)
            if self.with_target_depth:
                resized = np.zeros(self.size, np.float32) if depth is None else resize_depth(depth, height, width)
                sample["target_depth"] = torch.from_numpy(resized)[None]
            if self.with_depth and depth is not None:
                sample["depth"] = torch.from_numpy(np.ascontiguousarray(depth, dtype=np.float32))[None]
        for key, maps in self.maps.items():
            depth = maps.read(drive, frame)
            resized = np.zeros(self.size, np.float32) if depth is None else resize_depth(depth, height, width)
            sample[key] = torch.from_numpy(resized)[None]
        if self.stereo:
            sample["T_stereo_tgt"] = torch.from_numpy(np.asarray(T_stereo_tgt, np.float64)).float()
        if self.with_pose:
            known = self._motion(drive, frame)
            motion = np.concatenate([known, T_stereo_tgt[None]]) if self.stereo else known
            sample["T_src_tgt"] = torch.from_numpy(motion).float()
        if self.odometer is not None:
            ways = [self.odometer(drive, frame, frame + offset) for offset in self.offsets]
            sample["distance"] = torch.tensor([*ways, *[math.nan] * self.stereo], dtype=torch.float32)
        return sample

    def _motion(self, drive: Drive, frame: int) -> NDArray[np.float64]:
        T_world_tgt = drive.pose(frame)
        T_world_src = [drive.pose(frame + offset) for offset in self.offsets]
        if T_world_tgt is None or any(pose is None for pose in T_world_src):
            raise DataError(f"'{drive.name}' has no pose at frame {frame} or its neighbors; load it without poses")
        return np.array([np.linalg.inv(pose) @ T_world_tgt for pose in T_world_src if pose is not None]).reshape(
            -1, 4, 4
        )


def collate(samples: Sequence[Mapping[str, Any]] | Mapping[str, Any]) -> FrameBatch:
    """Stack samples to a batch; ground truth of different sizes is padded with 0 at the bottom and right."""
    rows = [samples] if isinstance(samples, Mapping) else list(samples)
    keys = dict.fromkeys(key for row in rows for key in row)
    batch: dict[str, Any] = {}
    for key in keys:
        if key == "name":
            batch[key] = [row[key] for row in rows]
        elif key == "depth":
            batch[key], batch["depth_size"] = _pad([row.get("depth") for row in rows])
        else:
            batch[key] = torch.stack([row[key] for row in rows])
    return batch  # type: ignore[return-value]


def _pad(maps: Sequence[torch.Tensor | None]) -> tuple[torch.Tensor, torch.Tensor]:
    sizes = [(1, 1) if each is None else (int(each.shape[-2]), int(each.shape[-1])) for each in maps]
    padded = torch.zeros(len(maps), 1, max(h for h, _ in sizes), max(w for _, w in sizes))
    for row, (each, (h, w)) in enumerate(zip(maps, sizes, strict=True)):
        if each is not None:
            padded[row, :, :h, :w] = each
    return padded, torch.tensor(sizes)


def reach(offsets: Sequence[int]) -> int:
    """Return how many frames the last frame of a window lies behind its first."""
    return max((0, *offsets)) - min((0, *offsets))


def draw(seed: int) -> torch.Tensor:
    """Return the random numbers that belong to a seed: one row of `DRAWS`, uniform in [0, 1)."""
    return torch.from_numpy(np.random.default_rng(seed).random(DRAWS, dtype=np.float32))


def sample_name(drive: str, frame: int) -> str:
    """Return drive and frame as one name; the camera side, if the drive's name ends with one, stays last."""
    folder, _, side = drive.rpartition(" ")
    return f"{folder} {frame:010d} {side}" if folder and side in ("l", "r") else f"{drive} {frame:010d}"
