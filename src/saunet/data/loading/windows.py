"""Frame windows as samples: a target frame, its neighbors in time, its stereo view, and any ground truth.

A window is usable if the frames at all offsets exist. Frames left out are counted, never silently dropped.
"""

from __future__ import annotations

import math
import re
import warnings
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch.utils.data import Dataset

from saunet.data.checks import check_frame
from saunet.data.drive import Drive
from saunet.data.loading.options import check_offsets
from saunet.data.loading.stored import DepthMaps
from saunet.errors import DataError
from saunet.fingerprint import fingerprint
from saunet.geometry.camera import scale_intrinsics
from saunet.geometry.pose import scaled_motion
from saunet.geometry.tracks import tracked_motion
from saunet.io.images import resize
from saunet.types import FrameBatch

DRAWS = 8  # random numbers that come with each training sample; see `saunet.data.loading.transforms.Augment`
Odometer = Callable[[Drive, int, int], float]
"""Gives the meters traveled between two frames of a drive, NaN where unknown."""
_SAME_K = 0.5  # pixels by which the intrinsics of two cameras may differ and still count as equal
_PATIENCE = 100  # broken samples in a row after which the data set, not a single file, is considered broken


POINTS = 128
"""Most tracked points of a window that come with a sample."""


class Selection(NamedTuple):
    """The frames of one drive that a split uses."""

    drive: Drive
    frames: Sequence[int]  # numbers of the target frames wanted
    left_out: Mapping[str, int] = {}
    """Number of frames already left out, by reason: ``{"static": 12}``."""


class Item(NamedTuple):
    """A training sampler's request to `WindowDataset`: which sample, and the seed of its random numbers."""

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

    Windows are (position in ``selections``, frame number); there is one `Usage` per drive.
    """
    windows, usage = [], []
    first, last = min((0, *offsets)), max((0, *offsets))
    for position, (drive, frames, before) in enumerate(selections):
        existing = set(drive.indices)
        paired = set(other_view(drive)[0].indices) if stereo else existing
        gaps = sorted(drive.gaps) if offsets else []
        left_out = Counter(before)
        used = []
        for frame in frames:
            if frame not in existing:
                left_out["missing"] += 1
            elif any(frame + offset not in existing for offset in offsets):
                left_out["without neighbor"] += 1
            elif bisect_left(gaps, frame + first) != bisect_left(gaps, frame + last):
                left_out["across a gap in time"] += 1
            elif frame not in paired:
                left_out["without stereo view"] += 1
            else:
                used.append((position, frame))
        windows += used
        usage.append(Usage(drive.name, len(used), left_out))
    return windows, usage


class WindowDataset(Dataset[dict[str, Any]]):
    """Samples of `saunet.types.FrameBatch`, one per window.

    ``dataset[i]`` is a sample; ``dataset[Item(i, seed)]`` adds the random numbers for augmentation, drawn from the seed
    alone and thus independent of workers and devices; a list of either is a list of samples, ready for `collate`.

    ``windows`` come from `find_windows`. Frames have the requested size plus ``margin`` (rows, columns), room for a
    random crop. Ground truth (``with_depth``) comes at its native size; target depth and ``maps``, by key, at the size
    of the frames, 0 where unknown. The stereo view is the last source.
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
        track_motion: bool = False,
        stereo: bool = False,
        odometer: Odometer | None = None,
        maps: Mapping[str, DepthMaps] = MappingProxyType({}),
    ) -> None:
        check_offsets(offsets)
        self.drives, self.windows, self.offsets = list(drives), list(windows), tuple(offsets)
        self.size = (height + margin[0], width + margin[1])
        self.with_depth, self.with_target_depth, self.with_pose = with_depth, with_target_depth, with_pose
        self.stereo, self.odometer, self.maps = stereo, odometer, dict(maps)
        self.track_motion = track_motion
        self._tracked: dict[int, tuple[torch.Tensor, torch.Tensor]] = {}
        self.with_mask = any(drive.has_scene_mask for drive in drives)

    def __len__(self) -> int:
        return len(self.windows)

    def __getitem__(self, item: int | Item | list[int] | list[Item]) -> Any:
        if isinstance(item, list):
            return [self[one] for one in item]
        if isinstance(item, Item):
            draws = np.random.default_rng(item.seed).random(DRAWS, dtype=np.float32)
            return {**self._sample(item.sample), "draws": torch.from_numpy(draws)}
        return self._sample(item)

    def selections(self) -> list[Selection]:
        """Return the target frames of each drive that has some."""
        wanted: dict[int, list[int]] = {}
        for position, frame in self.windows:
            wanted.setdefault(position, []).append(frame)
        return [Selection(self.drives[position], frames) for position, frames in wanted.items()]

    def name(self, index: int) -> str:
        """Return the readable name of a sample, such as ``2011_09_26/2011_09_26_drive_0001_sync 0000000005 l``."""
        position, frame = self.windows[index]
        return sample_name(self.drives[position].name, frame)

    def fingerprint(self) -> str:
        """Return the SHA-256 of the sorted sample names, one per line: equal for equal sets of frames."""
        return fingerprint([self.name(index) for index in range(len(self))])

    def _sample(self, index: int) -> dict[str, Any]:
        position, frame = self.windows[index]
        drive = self.drives[position]
        images = {f"frame {frame + offset}": drive.image(frame + offset) for offset in (0, *self.offsets)}
        if self.stereo:
            images[f"the stereo view of frame {frame}"], T_stereo_tgt = stereo_image(drive, frame)
        target = images[f"frame {frame}"]
        check_frame(drive, frame, target)
        for what, image in images.items():
            if image.ndim != 3 or image.shape != target.shape:
                raise DataError(
                    f"{what} of '{drive.name}' has shape {tuple(image.shape)} but its neighbor {frame} has "
                    f"{tuple(target.shape)}; all frames of a drive must have one size"
                )
        height, width = self.size
        frames = np.stack([resize(image, height, width).transpose(2, 0, 1) for image in images.values()])
        K = torch.from_numpy(np.asarray(drive.intrinsics(frame), dtype=np.float64))
        sample: dict[str, Any] = {
            "frames": torch.from_numpy(frames),
            "K": scale_intrinsics(K, width / target.shape[1], height / target.shape[0]).float(),
            "name": self.name(index),
        }
        depth = drive.depth(frame) if self.with_depth or self.with_target_depth else None
        if self.with_target_depth:
            sample["target_depth"] = self._sized(depth)
        if self.with_depth and depth is not None:
            sample["depth"] = torch.from_numpy(np.ascontiguousarray(depth, dtype=np.float32))[None]
        for key, maps in self.maps.items():
            sample[key] = self._sized(maps.read(drive, frame))
        if self.stereo:
            sample["T_stereo_tgt"] = torch.from_numpy(np.asarray(T_stereo_tgt, np.float64)).float()
        if self.with_mask:
            mask = np.ones(self.size, np.bool_) if drive.scene_mask is None else drive.scene_mask
            shown = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
            sample["target_mask"] = torch.from_numpy(shown)[None]
        if self.with_pose:
            motion = self._motion(drive, frame)
            motion = np.concatenate([motion, T_stereo_tgt[None]]) if self.stereo else motion
            sample["T_src_tgt"] = torch.from_numpy(motion).float()
        if self.track_motion:
            if index not in self._tracked:
                near = frames.transpose(0, 2, 3, 1)[: 1 + len(self.offsets)]
                self._tracked[index] = tracked_motions(near, sample["K"].double().numpy())
            sample["T_tracked"], sample["track_points"] = self._tracked[index]
        if self.odometer is not None:
            ways = [self.odometer(drive, frame, frame + offset) for offset in self.offsets]
            sample["distance"] = torch.tensor([*ways, *[math.nan] * self.stereo], dtype=torch.float32)
        return sample

    def _sized(self, depth: NDArray[np.float32] | None) -> torch.Tensor:
        sized = np.zeros(self.size, np.float32) if depth is None else resize_depth(depth, *self.size)
        return torch.from_numpy(sized)[None]

    def _motion(self, drive: Drive, frame: int) -> NDArray[np.float64]:
        T_world_tgt, *T_world_src = (drive.pose(frame + offset) for offset in (0, *self.offsets))
        known = [pose for pose in T_world_src if pose is not None]
        if T_world_tgt is None or len(known) < len(T_world_src):
            raise DataError(f"'{drive.name}' has no pose for frame {frame} or its neighbors; load it without poses")
        return np.array([np.linalg.inv(pose) @ T_world_tgt for pose in known]).reshape(-1, 4, 4)


def tracked_motions(frames: NDArray[np.uint8], K: NDArray[np.float64]) -> tuple[torch.Tensor, torch.Tensor]:
    """Return `tracked_motion` from the first frame (n h w 3) to each other one, and some of its points.

    Returns:
        T_src_tgt (n-1 4 4), and column, row and depth of `POINTS` points (n-1 points 3); NaN where unknown.
    """
    target, *sources = np.ascontiguousarray(frames)
    motions = np.full((len(sources), 4, 4), math.nan, np.float32)
    points = np.full((len(sources), POINTS, 3), math.nan, np.float32)
    for place, source in enumerate(sources):
        found = tracked_motion(target, source, K)
        if found is not None:
            motions[place] = found.T_src_tgt
            count = min(len(found.points), POINTS)
            chosen = np.linspace(0, len(found.points) - 1, count).round().astype(int)
            points[place, :count] = np.c_[found.points, found.depth][chosen]
    return torch.from_numpy(motions), torch.from_numpy(points)


def tracked_poses(
    target: Float[torch.Tensor, "b 3 h w"],
    sources: Float[torch.Tensor, "b s 3 h w"],
    K: Float[torch.Tensor, "b 3 3"],
    depth: Float[torch.Tensor, "b 1 h w"],
) -> Float[torch.Tensor, "b s 4 4"]:
    """Return T_src_tgt from tracked points, as a pose network would, in the unit of ``depth``; NaN if unknown."""
    frames = (torch.cat([target[:, None], sources], 1) * 255).round().byte().permute(0, 1, 3, 4, 2).cpu().numpy()
    found = [tracked_motions(*each) for each in zip(frames, K.double().cpu().numpy(), strict=True)]
    motions, points = (torch.stack(each).to(depth.device) for each in zip(*found, strict=True))
    return scaled_motion(motions, points, depth.float())


class SkippingWindows(WindowDataset):
    """Training windows that name and count a sample that cannot be read, and replace it with the next one.

    The count is shared by all loader processes.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._broken = torch.zeros(len(self.windows), dtype=torch.uint8).share_memory_()  # type: ignore[no-untyped-call]

    def skipped(self) -> list[str]:
        return [self.name(int(index)) for index in self._broken.nonzero()[:, 0]]

    def _sample(self, index: int) -> dict[str, Any]:
        problem: DataError | None = None
        for step in range(min(_PATIENCE, len(self))):
            place = (index + step) % len(self)
            if self._broken[place]:
                continue
            try:
                return super()._sample(place)
            except DataError as error:
                problem = error
                self._broken[place] = 1
                warnings.warn(f"sample skipped: {error}", stacklevel=2)
        reason = f"; the last: {problem}" if problem else ""
        most = min(_PATIENCE, len(self))
        raise DataError(f"{most} samples in a row cannot be read, so on_error=skip gives up{reason}")


def collate(samples: Sequence[Mapping[str, Any]] | Mapping[str, Any]) -> FrameBatch:
    """Stack samples into a batch; ground truth of different sizes is padded with 0 at the bottom and right."""
    rows = [samples] if isinstance(samples, Mapping) else list(samples)
    batch: dict[str, Any] = {}
    for key in dict.fromkeys(key for row in rows for key in row):
        if key == "name":
            batch[key] = [row[key] for row in rows]
        elif key == "depth":
            batch[key], batch["depth_size"] = _pad([row.get("depth") for row in rows])
        else:
            batch[key] = torch.stack([row[key] for row in rows])
    return batch  # type: ignore[return-value]


def _pad(maps: Sequence[torch.Tensor | None]) -> tuple[torch.Tensor, torch.Tensor]:
    sizes = torch.tensor([(1, 1) if each is None else each.shape[-2:] for each in maps])
    padded = torch.zeros(len(maps), 1, *sizes.amax(dim=0).tolist())
    for row, each in zip(padded, maps, strict=True):
        if each is not None:
            row[:, : each.shape[-2], : each.shape[-1]] = each
    return padded, sizes


def resize_depth(depth: NDArray[np.float32], height: int, width: int) -> NDArray[np.float32]:
    """Resize a depth map without mixing values.

    In a sparse map (less than half of it known) each measurement moves to the pixel where it now falls, and the nearest
    wins. A dense map is sampled at the new pixel centers.
    """
    if depth.shape == (height, width):
        return np.ascontiguousarray(depth, dtype=np.float32)
    rows, columns = np.nonzero(depth)
    if 2 * rows.size > depth.size:
        return np.asarray(cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST_EXACT), dtype=np.float32)
    values = depth[rows, columns]
    rows = np.minimum(((rows + 0.5) * (height / depth.shape[0])).astype(np.int64), height - 1)
    columns = np.minimum(((columns + 0.5) * (width / depth.shape[1])).astype(np.int64), width - 1)
    return nearest_map(rows, columns, values, (height, width))


def nearest_map(
    rows: NDArray[np.int64], columns: NDArray[np.int64], values: NDArray[Any], size: tuple[int, int]
) -> NDArray[np.float32]:
    """Scatter values into a map of zeros, height x width; the smallest of several in a pixel wins."""
    order = np.argsort(-values, kind="stable")
    out = np.zeros(size, np.float32)
    out[rows[order], columns[order]] = values[order]
    return out


def other_view(drive: Drive) -> tuple[Drive, NDArray[np.float64]]:
    """Return the recording of the other camera, and T_stereo_cam, 4 x 4, meters."""
    other = drive.stereo()
    T_stereo_cam = None if other is None else drive.T_stereo_cam
    if other is None or T_stereo_cam is None:
        raise DataError(
            f"'{drive.name}' comes from one camera, so it has no stereo view; set data.stereo=false, or use data of "
            "two calibrated cameras"
        )
    return other, T_stereo_cam


def stereo_image(drive: Drive, index: int) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Return the other camera's frame, h x w x 3, RGB, and T_stereo_cam, 4 x 4, meters."""
    other, T_stereo_cam = other_view(drive)
    K, K_other = drive.intrinsics(index), other.intrinsics(index)
    if np.abs(K - K_other).max() > _SAME_K:
        ours, theirs = (f"fx {each[0, 0]:.1f}, cx {each[0, 2]:.1f}, cy {each[1, 2]:.1f}" for each in (K, K_other))
        raise DataError(
            f"'{drive.name}' and its stereo view '{other.name}' have different intrinsics ({ours} and {theirs}); "
            "a stereo source needs rectified images with one K"
        )
    return other.image(index), T_stereo_cam


def measured_distance(drive: Drive, first: int, second: int) -> float:
    """Return the meters traveled between two frames according to the recording; NaN if unknown."""
    known = drive.distance(first, second)
    return math.nan if known is None else known


def reach(offsets: Sequence[int]) -> int:
    """Return the number of frames from the first to the last frame of a window."""
    return max((0, *offsets)) - min((0, *offsets))


def sample_name(drive: str, frame: int) -> str:
    """Return drive and frame as one name; the camera side, if the drive's name ends with one, stays last."""
    folder, _, side = drive.rpartition(" ")
    return f"{folder} {frame:010d} {side}" if folder and side in ("l", "r") else f"{drive} {frame:010d}"


def recording_of(name: str, *, with_side: bool = True) -> str:
    """Return the drive in a `sample_name`; without its camera side, both cameras of a pair are one."""
    return re.sub(r" \d+( [lr])?$", r"\1" if with_side else "", name)
