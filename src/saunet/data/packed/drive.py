"""A recording in packed data: images and depth in shards, everything else that a `Drive` provides in arrays."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from saunet.data.drive import Drive
from saunet.data.loading.windows import measured_distance
from saunet.data.packed.store import Part, Store
from saunet.io.images import decode_image
from saunet.io.plain import read_arrays


class PackedDrive(Drive):
    """See `saunet.data.drive.Drive`; ``facts`` and ``arrays`` are those that `describe` made of the original."""

    def __init__(self, store: Store, facts: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> None:
        self._store, self._facts, self._arrays = store, facts, arrays
        self.other: PackedDrive | None = None
        """The other camera's recording, set by the loader of both."""
        self._indices: list[int] = arrays["indices"].tolist()
        self._distances = {(first, second): way for first, second, way in arrays["distances"].tolist()}

    @property
    def name(self) -> str:
        return str(self._facts["name"])

    @property
    def fps(self) -> float | None:
        fps: float | None = self._facts["fps"]
        return fps

    @property
    def numbering(self) -> str:
        return str(self._facts["numbering"])

    @property
    def origin(self) -> str:
        return str(self._facts["origin"])

    @property
    def camera_height(self) -> float | None:
        height: float | None = self._facts["camera_height"]
        return height

    @property
    def condition(self) -> str | None:
        condition: str | None = self._facts["condition"]
        return condition

    @property
    def indices(self) -> Sequence[int]:
        return self._indices

    def _at(self, key: str, index: int) -> Any:
        """Return the stored entry of a frame; a single entry applies to all frames, and none means unknown."""
        values = self._arrays.get(key)
        if values is None or len(values) == 1:
            return None if values is None else values[0]
        return values[np.searchsorted(self._arrays["indices"], index)]

    def _blob(self, kind: str, index: int) -> bytes | None:
        found = self._at(kind, index)
        part = Part(0, 0, 0) if found is None else Part(*found.tolist())
        return self._store.part(part) if part.length else None

    def image(self, index: int) -> NDArray[np.uint8]:
        data = self._blob("image", index)
        assert data is not None, "every frame was packed"
        return decode_image(data, f"frame {index} of '{self.name}' in {self._store.root}")

    def intrinsics(self, index: int) -> NDArray[np.float64]:
        return np.array(self._at("intrinsics", index))

    def has_depth(self, index: int) -> bool:
        found = self._at("depth", index)
        return found is not None and bool(found[2])

    def depth(self, index: int) -> NDArray[np.float32] | None:
        return self.map("depth", index)

    def map(self, kind: str, index: int) -> NDArray[np.float32] | None:
        """Return a stored map of a frame: ``depth``, or one that was made beforehand."""
        data = self._blob(kind, index)
        return None if data is None else np.asarray(read_arrays(io.BytesIO(data))["depth"], np.float32)

    def pose(self, index: int) -> NDArray[np.float64] | None:
        pose = self._at("pose", index)
        return None if pose is None or np.isnan(pose).any() else np.array(pose)

    def time(self, index: int) -> float | None:
        return self._number("time", index)

    def speed(self, index: int) -> float | None:
        return self._number("speed", index)

    def _number(self, key: str, index: int) -> float | None:
        value = self._at(key, index)
        return None if value is None or np.isnan(value) else float(value)

    def distance(self, first: int, second: int) -> float | None:
        way = self._distances.get((first, second))
        return super().distance(first, second) if way is None else None if np.isnan(way) else way

    @property
    def gaps(self) -> frozenset[int]:
        return frozenset(self._facts["gaps"])

    def stereo(self) -> Drive | None:
        return self.other

    @property
    def T_stereo_cam(self) -> NDArray[np.float64] | None:  # noqa: N802 (frames in names)
        stored = self._facts["T_stereo_cam"]
        return None if stored is None else np.array(stored, np.float64)

    @property
    def frame_size(self) -> tuple[int, int] | None:
        size = self._facts["frame_size"]
        return None if size is None else (int(size[0]), int(size[1]))

    def recorded(self, index: int) -> int:
        return int(self._arrays["recorded"][np.searchsorted(self._arrays["indices"], index)])

    @property
    def has_scene_mask(self) -> bool:
        return "scene_mask" in self._arrays

    @property
    def scene_mask(self) -> NDArray[np.bool_] | None:
        return self._arrays["scene_mask"] if self.has_scene_mask else None


@dataclass(frozen=True)
class _Absent(Drive):
    """A recording without frames."""

    name: str = ""
    indices: Sequence[int] = ()

    def image(self, index: int) -> NDArray[np.uint8]:
        raise IndexError(index)

    def intrinsics(self, index: int) -> NDArray[np.float64]:
        raise IndexError(index)


def describe(drive: Drive, frames: Sequence[int], offsets: Sequence[int], ways: bool) -> tuple[dict[str, Any], Any]:
    """Return the facts of a recording's ``frames``, and its arrays except those of images and maps."""
    kept = set(frames)
    if not frames:  # named by a split but missing, so it has no facts
        drive = _Absent(drive.name)
    T_stereo_cam, gaps = drive.T_stereo_cam, drive.gaps
    facts: dict[str, Any] = {
        "name": drive.name,
        "fps": drive.fps,
        "numbering": drive.numbering,
        "origin": drive.origin,
        "camera_height": drive.camera_height,
        "condition": drive.condition,
        "frame_size": drive.frame_size,
    }
    # The frames around a gap may not all be packed.
    lost = [max((frame for frame in frames if frame <= gap), default=None) for gap in gaps]
    facts |= {"gaps": sorted({frame for frame in lost if frame is not None})}
    facts |= {"T_stereo_cam": None if T_stereo_cam is None else T_stereo_cam.tolist()}
    arrays: dict[str, NDArray[Any]] = {
        "indices": np.array(frames, np.int64),
        "intrinsics": np.array([drive.intrinsics(frame) for frame in frames], np.float64).reshape(-1, 3, 3),
        "recorded": np.array([drive.recorded(frame) for frame in frames], np.int64),
    }
    told: dict[str, tuple[Callable[[int], Any], tuple[int, ...]]]
    told = {"pose": (drive.pose, (4, 4)), "time": (drive.time, ()), "speed": (drive.speed, ())}
    for key, (ask, shape) in told.items():
        values = [ask(frame) for frame in frames]
        if any(each is not None for each in values):
            arrays[key] = np.array([np.full(shape, np.nan) if each is None else each for each in values], np.float64)
    if len(frames) and (arrays["intrinsics"] == arrays["intrinsics"][0]).all():
        arrays["intrinsics"] = arrays["intrinsics"][:1]
    pairs = [(frame, frame + step) for frame in frames for step in offsets if ways and frame + step in kept]
    distances = [(*pair, measured_distance(drive, *pair)) for pair in pairs]
    arrays["distances"] = np.array(distances, np.float64).reshape(-1, 3)
    if drive.has_scene_mask and drive.scene_mask is not None:
        arrays["scene_mask"] = drive.scene_mask
    return facts, arrays
