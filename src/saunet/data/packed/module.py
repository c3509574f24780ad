"""Packed data as a data module: the same windows, splits and truth as the folders that they were packed from."""

from __future__ import annotations

import contextlib
import io
import itertools
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Unpack

from saunet.data.drive import Drive
from saunet.data.loading.module import DepthDataModule
from saunet.data.loading.options import Loading
from saunet.data.loading.stored import DepthMaps, MapKind
from saunet.data.loading.windows import Selection, measured_distance
from saunet.data.packed.drive import PackedDrive
from saunet.data.packed.store import DESCRIPTION, FORMAT, Store
from saunet.errors import ConfigError, DataError, positive
from saunet.io.plain import parse_json, read_arrays
from saunet.registry import datamodules

KEPT = ("protocol", "ground_truth", "target_depth", "with_pose", "stereo")
"""Settings of the original data module that packed data keep."""


@datamodules.register("packed")
class PackedDataModule(DepthDataModule):
    """A data set that ``saunet prepare pack`` wrote to a few large files, on a disk or in an object store.

    Windows, splits, ground truth and the contents of batches (depth, poses, the stereo view, another model's depth) are
    those of the data module that was packed. Loader settings are free; ``seed`` decides order and augmentation.

    Args:
        root: Folder of the packed data, or an address such as ``s3://bucket/name`` (extra ``stream``).
        stream_cache: Local folder that keeps what was read from an address; None keeps nothing.
        stream_cache_gb: Largest size of that folder in gigabytes.
        **loading: Loader settings, as in `LoadOptions`.

    Raises:
        ConfigError: if a parameter is out of range.
    """

    cacheable = False
    recognizable = False

    root: str

    def __init__(
        self,
        *,
        root: str = "data/packed",
        stream_cache: str | None = None,
        stream_cache_gb: float = 50.0,
        **loading: Unpack[Loading],
    ) -> None:
        super().__init__(**loading)
        self.root = root
        keep = int(positive("stream_cache_gb", stream_cache_gb) * 1e9)
        folder = Path(stream_cache).expanduser() if stream_cache else None
        self._store = Store(root if "://" in root else str(Path(root).expanduser().absolute()), folder, keep)
        self._facts: dict[str, Any] = {}
        with contextlib.suppress(DataError):  # `select` reports the error once the data are needed
            self._open()

    @property
    def camera_height(self) -> float | None:
        """Meters from the road to the camera, where all recordings agree; else None."""
        height = self._open()["camera_height"]
        return None if height is None else float(height)

    @property
    def protocols(self) -> tuple[str, ...]:
        return tuple(self._open()["protocols"])

    def _open(self) -> dict[str, Any]:
        """Return the description, and apply its settings."""
        if self._facts:
            return self._facts
        plain = parse_json(self._store.file(DESCRIPTION), f"{self.root}/{DESCRIPTION}", DataError)
        if not isinstance(plain, dict) or plain.get("format") != FORMAT:
            raise DataError(f"{self.root}/{DESCRIPTION} is not packed data of format {FORMAT}; run saunet prepare pack")
        for key in KEPT:
            setattr(self, key, plain[key])
        self.neighbors = tuple(dict.fromkeys((*plain["neighbors"], *self.neighbors)))
        self.odometer = measured_distance if plain["with_speed"] or self.odometer else None
        self.maps = {key: _PackedMaps(key, kind) for key, kind in plain["maps"].items()}
        self._store.starts = list(itertools.accumulate(plain["shards"], initial=0))
        self._facts = plain
        return plain

    def select(self, split: str) -> Sequence[Selection]:
        facts = self._open()
        packed, wanted = ([0, *offsets] for offsets in (facts["offsets"], self.offsets))
        if min(wanted) < min(packed) or max(wanted) > max(packed):
            raise ConfigError(
                f"offsets are {list(self.offsets)} but the data at {self.root} were packed for {facts['offsets']}; "
                "use offsets within these, or pack them again with the larger ones"
            )
        drives = facts["splits"].get(split, [])
        arrays: dict[int, dict[str, NDArray[Any]]] = defaultdict(dict)
        if drives:
            for name, array in read_arrays(io.BytesIO(self._store.file(f"{split}.npz")), DataError).items():
                number, _, key = name.partition("_")
                arrays[int(number)][key] = array
        made = [PackedDrive(self._store, each, arrays[number]) for number, each in enumerate(drives)]
        for drive, each in zip(made, drives, strict=True):
            drive.other = None if each["stereo"] is None else made[each["stereo"]]
        return [
            Selection(drive, arrays[number]["selected"].tolist(), each["left_out"])
            for number, (drive, each) in enumerate(zip(made, drives, strict=True))
            if "selected" in arrays[number]
        ]


class _PackedMaps(DepthMaps):
    """Depth maps made beforehand, stored in the pack."""

    def __init__(self, key: str, kind: MapKind) -> None:
        super().__init__(kind)
        self._key = key

    def read(self, drive: Drive, frame: int) -> NDArray[np.float32] | None:
        return cast(PackedDrive, drive).map(self._key, frame)  # `select` makes no others
