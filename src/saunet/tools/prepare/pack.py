"""Packs a data set into a few large files: images, depth maps and all other information, for all splits."""

from __future__ import annotations

import functools
import hashlib
import io
import tarfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from saunet.data.drive import Drive
from saunet.data.loading.module import DepthDataModule
from saunet.data.loading.windows import Selection, other_view
from saunet.data.packed.drive import describe
from saunet.data.packed.module import KEPT
from saunet.data.packed.store import DESCRIPTION, FORMAT, Part, shard_name
from saunet.errors import DataError
from saunet.io.atomic import check_folder, write_bytes, write_json
from saunet.io.images import decode_image, encode_png
from saunet.io.progress import bar

_TOGETHER = 64  # frames in memory at once


@dataclass(frozen=True, slots=True)
class PackReport:
    """The result of `pack`."""

    frames: int
    maps: int
    """Depth maps."""
    shards: int
    bytes: int
    folder: Path

    def __str__(self) -> str:
        size = f"{self.bytes / 1e9:.2f} GB in {self.shards} shards"
        return f"{self.frames} frames and {self.maps} depth maps packed, {size}: {self.folder}"


@dataclass
class _Shards:
    """Writes one archive after another; equal content is written once."""

    folder: Path
    size: int
    known: dict[bytes, Part] = field(default_factory=dict)
    sizes: list[int] = field(default_factory=list)
    _file: Any = None
    _tar: Any = None

    def add(self, name: str, data: bytes) -> Part:
        digest = hashlib.sha256(data).digest()
        if digest not in self.known:
            if self._tar is None or self._file.tell() + len(data) > self.size:
                self.close()
                self._file = io.BytesIO()
                self._tar = tarfile.open(fileobj=self._file, mode="w", format=tarfile.GNU_FORMAT)  # noqa: SIM115
            entry = tarfile.TarInfo(name)
            entry.size = len(data)
            self._tar.addfile(entry, io.BytesIO(data))
            padded = -(-len(data) // tarfile.BLOCKSIZE) * tarfile.BLOCKSIZE
            self.known[digest] = Part(len(self.sizes), self._file.tell() - padded, len(data))
        return self.known[digest]

    def close(self) -> None:
        if self._tar is not None:
            self._tar.close()
            data = self._file.getvalue()
            write_bytes(self.folder / shard_name(len(self.sizes)), data)
            self.sizes.append(len(data))
            self._tar = None


def pack(data: DepthDataModule, folder: str | Path, shard_mb: int, workers: int = 0) -> PackReport:
    """Write all splits of a data module into an empty folder; it is complete once the description exists."""
    target = check_folder(Path(folder).expanduser())
    if (target / DESCRIPTION).exists():
        raise DataError(f"{target} already has packed data; delete it, or set folder to a new one")
    strange = [path for path in target.glob("*") if path.suffix not in (".tar", ".npz")]
    if strange:
        raise DataError(f"{target} is not empty ({strange[0].name}); set folder to a new one")
    data.prepare_data()
    shards = _Shards(target, shard_mb << 20)
    splits = {split: _read(data, split) for split in ("train", "val", "test", "predict")}
    images: dict[tuple[str, int], Part] = {}
    described: dict[str, list[dict[str, Any]]] = {}
    maps = 0
    total = sum(len(frames) for entries in splits.values() for _, frames, _ in entries)
    with ThreadPoolExecutor(max(1, workers)) as pool, bar() as shown:
        task = shown.add_task("pack", total=total)
        for split, entries in splits.items():
            arrays: dict[str, NDArray[Any]] = {}
            described[split] = []
            for number, (drive, frames, selection) in enumerate(entries):
                facts, known = describe(drive, frames, data.offsets, data.odometer is not None)
                paired = data.stereo and data.has_neighbors(split) and selection
                facts |= {
                    "stereo": number + 1 if paired else None,  # the other camera follows
                    "left_out": dict(selection.left_out) if selection else {},
                }
                kinds: dict[str, list[Part]] = {"image": [], "depth": [], **{key: [] for key in data.maps}}
                make = functools.partial(_encode, data, drive, images)
                for some in (frames[first : first + _TOGETHER] for first in range(0, len(frames), _TOGETHER)):
                    for frame, found in zip(some, pool.map(make, some), strict=True):
                        for kind, (suffix, blob) in found.items():
                            name = f"{number:06d}_{frame:010d}.{kind}{suffix}"
                            kinds[kind].append(shards.add(f"{split}_{name}", blob) if blob else Part(0, 0, 0))
                        if "image" in found:
                            images[drive.name, frame] = kinds["image"][-1]
                        else:
                            kinds["image"].append(images[drive.name, frame])
                        shown.advance(task)
                for kind, parts in kinds.items():
                    maps += sum(part.length > 0 for part in parts) if kind != "image" else 0
                    if any(part.length for part in parts):
                        known[kind] = np.array(parts, np.int64)
                if selection:
                    known["selected"] = np.array(list(selection.frames), np.int64)
                arrays |= {f"{number}_{key}": array for key, array in known.items()}
                described[split].append(facts)
            stream = io.BytesIO()
            np.savez(stream, **arrays)  # type: ignore[arg-type]
            write_bytes(target / f"{split}.npz", stream.getvalue())
    shards.close()
    plain = {"format": FORMAT, **{key: getattr(data, key) for key in KEPT}, "offsets": list(data.offsets)}
    plain |= {"neighbors": [split for split in splits if data.has_neighbors(split)]}
    plain |= {"with_speed": data.odometer is not None, "shards": shards.sizes}
    plain |= {"maps": {key: each.kind for key, each in data.maps.items()}, "splits": described}
    plain |= {"camera_height": data.camera_height, "protocols": list(data.protocols)}
    write_json(target / DESCRIPTION, plain, indent=None)
    return PackReport(len(images), maps, len(shards.sizes), sum(shards.sizes), target)


def _read(data: DepthDataModule, split: str) -> list[tuple[Drive, list[int], Selection | None]]:
    """Return each recording of a split with the frames to pack and its selection; other cameras have none."""
    together = data.has_neighbors(split)
    found: list[tuple[Drive, list[int], Selection | None]] = []
    for each in data.select(split):
        selection = Selection(*each)
        existing = set(selection.drive.indices)
        steps = (0, *data.offsets) if together else (0,)
        wanted = sorted(existing & {frame + step for frame in selection.frames for step in steps})
        found.append((selection.drive, wanted, selection))
        if data.stereo and together:
            other, _ = other_view(selection.drive)
            found.append((other, sorted(set(wanted).intersection(other.indices)), None))
    return found


def _encode(
    data: DepthDataModule, drive: Drive, images: dict[tuple[str, int], Part], frame: int
) -> dict[str, tuple[str, bytes]]:
    """Return the files of a frame by kind, without an image that is packed already."""
    found: dict[str, tuple[str, bytes]] = {}
    if (drive.name, frame) not in images:
        found["image"] = _image_file(drive, frame)
    found["depth"] = _depth_file(drive.depth(frame))
    for key, maps in data.maps.items():
        found[key] = _depth_file(maps.read(drive, frame))
    return found


def _image_file(drive: Drive, frame: int) -> tuple[str, bytes]:
    """Return the original file if it decodes to the recording's frame, else a lossless one."""
    image, path = drive.image(frame), drive.path(frame)
    if path is not None and path.is_file():
        data = path.read_bytes()
        try:
            if np.array_equal(decode_image(data, str(path)), image):
                return path.suffix, data
        except DataError:  # a kind of file that is more than an image of 8 bits
            pass
    return ".png", encode_png(image)


def _depth_file(depth: NDArray[np.float32] | None) -> tuple[str, bytes]:
    if depth is None:
        return "", b""
    stream = io.BytesIO()
    np.savez_compressed(stream, depth=depth)
    return ".npz", stream.getvalue()
