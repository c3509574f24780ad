"""Recordings of the CARLA simulator: images and depth as its cameras save them, and a table of camera poses."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from typing_extensions import Unpack

from saunet.data.checks import common_size
from saunet.data.loading.options import Loading
from saunet.data.sets.base import report_missing
from saunet.data.sets.files import DepthFilesDrive, RecordingsDataModule, numbered, read_rows, read_words
from saunet.errors import DataError, positive
from saunet.io.images import read_unchanged
from saunet.registry import datamodules

COLUMNS = ("frame", "timestamp", "x", "y", "z", "pitch", "yaw", "roll", "fov")
"""Columns of ``poses.csv``, from a CARLA image's ``frame``, ``timestamp``, ``transform`` and ``fov``:
seconds, meters and degrees, in Unreal's left-handed axes (x forward, y right, z up)."""
FAR = 1000.0
"""Meters of the largest stored depth, which the sky has."""
WEATHER = re.compile(
    r"(?:Clear|Cloudy|Wet|WetCloudy|SoftRain|MidRain(?:y)?|HardRain)(?:Noon|Sunset|Night)|DustStorm|Default"
)
"""Names of CARLA's weather presets, allowed as names of recording folders."""
_FIX = "record it as docs/datasets.md shows"


class CarlaDrive(DepthFilesDrive):
    """One camera of one drive; depth is the camera's z."""

    @staticmethod
    def read(path: Path) -> NDArray[np.float32]:
        """Return a stored map in meters: 24 bits in red (lowest), green and blue; the sky is unknown."""
        stored = read_unchanged(path)
        if stored.dtype != np.uint8 or stored.ndim != 3:
            raise DataError(
                f"{path} contains {stored.dtype} of shape {stored.shape}; expected CARLA's depth in the three 8-bit "
                "channels of a PNG: save it unchanged, without a color converter"
            )
        blue, green, red = (stored[..., channel].astype(np.float64) for channel in range(3))
        depth = (red + 256 * green + 65_536 * blue) * (FAR / (2**24 - 1))
        return np.where(depth < FAR - 1, depth, 0).astype(np.float32)


@datamodules.register("carla")
class CarlaDataModule(RecordingsDataModule):
    """Recordings of the CARLA simulator: exact depth, poses and intrinsics of your own drives in any weather.

    Args:
        root: Folder of the recordings, each with ``rgb``, ``depth`` and ``poses.csv``, at most four levels below.
        val_drives: Recordings to validate on, by name below the root or by pattern.
        test_drives: Recordings to test and predict; by default the held-out frames.
        val_share: Fraction to hold out if none are named: whole recordings if there are ten or more, else their ends.
        camera_height: Meters from the road to the camera.
        **loading: Loader settings, as in `LoadOptions`.

    Raises:
        ConfigError: if a parameter is out of range.
    """

    protocol = "synthetic"
    ground_truth = "exact"

    def __init__(
        self,
        *,
        root: str = "data/carla",
        val_drives: Sequence[str] = (),
        test_drives: Sequence[str] = (),
        val_share: float = 0.1,
        camera_height: float | None = None,
        target_depth: bool = False,
        with_pose: bool = False,
        cache: str | None = None,
        **loading: Unpack[Loading],
    ) -> None:
        super().__init__(target_depth=target_depth, with_pose=with_pose, cache=cache, **loading)
        self.root = root
        self._height = None if camera_height is None else float(positive("camera_height", camera_height))
        self.hold_out(val_drives, test_drives, val_share)

    @property
    def camera_height(self) -> float | None:
        return self._height

    def find(self) -> Sequence[CarlaDrive]:
        root = Path(self.root).expanduser().absolute()
        folders = sorted(path.parent for level in range(5) for path in root.glob("*/" * level + "poses.csv"))
        found = [read_recording(folder, root, self._height) for folder in folders]
        if not any(drive.indices for drive in found):
            there = f"{len(found)} folders with a poses.csv and no images" if found else "no poses.csv"
            raise DataError(f"{there} at {root} or up to four levels below; {_FIX}")
        return [drive for drive in found if drive.indices]


def read_recording(folder: Path, root: Path, camera_height: float | None) -> CarlaDrive:
    """Return the recording in a folder; its frames are those that have a row and an image."""
    table = folder / "poses.csv"
    if [words for _, words in read_words(table, _FIX)[:1]] != [list(COLUMNS)]:
        raise DataError(f"{table} must start with the line {','.join(COLUMNS)}; {_FIX}")
    rows = {int(row[0]): row for row in read_rows(table, COLUMNS, skip=1, fix=_FIX)}
    images = numbered(folder / "rgb", r"(\d+)\.(?:png|jpg)")
    report_missing(sorted(rows.keys() - images.keys()) if images else [], len(rows), f"images of {table}", _FIX)
    kept = sorted(rows.keys() & images.keys())
    # CARLA counts simulation ticks, and a camera may record only every second or third
    index = {frame: place for place, frame in enumerate(kept)}
    K, size = np.eye(3), (2, 2)
    if kept:
        _, size = common_size([images[frame] for frame in kept])
        fovs = {float(rows[frame][8]) for frame in kept}
        if len(fovs) > 1 or not 0 < min(fovs) < 180:
            raise DataError(
                f"{table} has fov {sorted(fovs)}; a recording must have one, in degrees: record each separately"
            )
        f = size[1] / 2 / np.tan(np.radians(fovs.pop()) / 2)
        K = np.array([[f, 0, (size[1] - 1) / 2], [0, f, (size[0] - 1) / 2], [0, 0, 1]])
    parts = folder.relative_to(root).parts
    drive = CarlaDrive(
        "/".join(parts) or folder.name,
        {index[frame]: images[frame] for frame in kept},
        K,
        table,
        size,
        times={index[frame]: float(rows[frame][1]) for frame in kept},
        poses={index[frame]: pose(*rows[frame][2:8]) for frame in kept},
        camera_height=camera_height,
        condition=next((part for part in folder.parts if WEATHER.fullmatch(part)), None),
        folder=folder,
    )
    depths = numbered(folder / "depth", r"(\d+)\.png")
    drive.depths = {index[frame]: depths[frame] for frame in kept if frame in depths}
    return drive


def pose(x: float, y: float, z: float, pitch: float, yaw: float, roll: float) -> NDArray[np.float64]:
    """Return T_world_cam (right, down, forward) of a transform of CARLA (forward, right, up; degrees).

    Its positive yaw turns right, its positive pitch looks up, its positive roll sinks the right side: rotations about
    our down, right and forward axes, applied in this order.
    """
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("YXZ", [yaw, pitch, roll], degrees=True).as_matrix()
    T[:3, 3] = y, -z, x
    return T
