"""Another model's depth as a target: predicted once for all frames, or taken over from any system's files."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from saunet.data.kitti.raw import KittiDrive
from saunet.data.loading.stored import DepthMaps
from saunet.data.loading.windows import sample_name
from saunet.errors import DataError
from saunet.io.colormaps import depth_to_png16
from saunet.io.images import read_depth, write_image
from saunet.io.plain import read_array
from saunet.tools.prepare.pool import Done, OnError, Work, remove_partial
from saunet.tools.prepare.recordings import Recording

Values = Literal["depth", "disparity"]
ENDINGS = ("", "_depth", "_disp")
"""What may stand between the name of an image and the suffix of its file."""
SUFFIXES = (".npy", ".png")
_TYPICAL = 16.0
"""Depth of which 16-bit steps of 1/256 are fine enough, and which leaves room for what is farther."""


@runtime_checkable
class DepthSource(Protocol):
    """Gives depth for a frame, at whatever size it has it."""

    def made_from(self) -> dict[str, Any]:
        """Return what decides the values, to be written down beside them."""

    def depth(self, drive: KittiDrive, frame: int) -> Float32[ndarray, "_ _"]:
        """Return depth, up to scale, 0 where unknown."""


class ModelTeacher:
    """Depth as a model predicts it."""

    def __init__(self, predictor: Any) -> None:
        self.predictor = predictor

    def made_from(self) -> dict[str, Any]:
        """Return the fingerprint of the model."""
        return {"model": self.predictor.fingerprint}

    def depth(self, drive: KittiDrive, frame: int) -> Float32[ndarray, "_ _"]:
        """Predict a frame."""
        return np.asarray(self.predictor.predict(drive.image(frame), str(drive.path(frame))).depth, dtype=np.float32)


class FileTeacher:
    """Depth from files that any system wrote.

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
            if path.suffix.lower() in SUFFIXES
        }
        if not self._files:
            raise DataError(f"no .npy or .png files below {self.folder.absolute()}; set input to a teacher's folder")

    def made_from(self) -> dict[str, Any]:
        """Return folder and kind of values."""
        return {"input": str(self.folder.resolve()), "values": self.values}

    def file(self, drive: KittiDrive, frame: int) -> Path:
        """Return the file of a frame."""
        tree = f"image_{drive.number:02d}/data/{frame:010d}"
        names = [
            sample_name(drive.name, frame),
            f"{drive.folder.parent.name}/{drive.folder.name}/{tree}",
            f"{drive.folder.name}/{tree}",
        ]
        if len({path.parent for path in self._files.values()}) == 1:  # the depth of one recording
            names += [tree, f"{frame:010d}"]
        for name in names:
            for ending in ENDINGS:
                path = self._files.get(_plain(name + ending))
                if path is not None:
                    return path
        raise DataError(
            f"{self.folder} has no depth for {drive.path(frame)}; expected {names[1]}.npy or .png there, "
            f"or {_plain(names[0])}.npy"
        )

    def depth(self, drive: KittiDrive, frame: int) -> Float32[ndarray, "_ _"]:
        """Read a frame's depth."""
        path = self.file(drive, frame)
        values = read_depth(path) if path.suffix.lower() == ".png" else _read_array(path)
        known = np.isfinite(values) & (values > 0)
        if self.values == "disparity":
            values = np.divide(1, values, where=known, out=np.zeros_like(values))
        return np.where(known, values, 0).astype(np.float32)


def teach(
    recordings: Sequence[Recording], source: DepthSource, folder: str | None = None, on_error: OnError = "raise"
) -> Done:
    """Write a teacher's depth for recordings (``folder`` None: beside each); what is there already is left alone."""
    maps = DepthMaps("teacher", folder)
    items, before = [], 0
    for position, (drive, frames) in enumerate(recordings):
        remove_partial(maps.home(drive))
        if (maps.home(drive) / "maps.json").exists():
            maps.claim(drive, source.made_from())
        there = maps.frames(drive)
        before += len(there.intersection(frames))
        items += [(position, frame) for frame in frames if frame not in there]
    work: Work[tuple[int, int], None] = Work(_writer(recordings, source, maps), 0, on_error)
    made = sum(1 for _ in work.run(items, "teacher"))
    return Done(made, before, None, tuple(work.failures))


def _writer(recordings: Sequence[Recording], source: DepthSource, maps: DepthMaps) -> Callable[[tuple[int, int]], None]:
    factors: dict[int, float] = {}

    def write(item: tuple[int, int]) -> None:
        drive, frame = recordings[item[0]][0], item[1]
        depth = source.depth(drive, frame)
        known = depth[depth > 0]
        if known.size == 0:
            raise DataError(f"the teacher knows no depth in {drive.path(frame)}")
        if item[0] not in factors:
            # Relative depth may be of any magnitude; a power of two brings it to where 16 bits resolve it.
            scale = 2.0 ** round(math.log2(_TYPICAL / float(np.median(known))))
            factors[item[0]] = maps.claim(drive, source.made_from(), scale)
        write_image(maps.path(drive, frame), depth_to_png16(depth * np.float32(factors[item[0]])))

    return write


def source_of(checkpoint: str | None, files: str | None, values: Values, device: str) -> DepthSource:
    """Return the teacher that is asked for: a checkpoint, or a folder of files that another system wrote."""
    if files is not None:
        return FileTeacher(files, values)
    from saunet.prediction.predictor import Predictor

    assert checkpoint is not None
    return ModelTeacher(Predictor.from_checkpoint(checkpoint, device))


def _plain(name: str) -> str:
    """Return a name in which all but letters and digits is one kind of separator."""
    return "-".join(part for part in "".join(c if c.isalnum() else " " for c in name).split())


def _read_array(path: Path) -> Float32[ndarray, "_ _"]:
    try:
        array = np.squeeze(read_array(path))
    except OSError as reason:
        raise DataError(f"cannot read {path}: {reason.strerror or reason}; check its rights") from reason
    if array.ndim != 2 or array.dtype.kind not in "fiu":
        raise DataError(f"{path} holds {array.dtype} of shape {array.shape}; depth is height x width numbers")
    return np.asarray(array, dtype=np.float32)
