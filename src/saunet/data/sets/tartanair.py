"""TartanAir (Wang et al., 2020) and its V2: flights through rendered worlds, with depth, poses and both cameras."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Unpack

from saunet.data.loading.options import Loading
from saunet.data.sets.base import transform
from saunet.data.sets.files import DepthFilesDrive, RecordingsDataModule, numbered, pair_up, read_rows
from saunet.errors import DataError
from saunet.io.images import read_unchanged
from saunet.io.plain import read_array
from saunet.registry import datamodules

FOCAL = 320.0
"""Pixels: half of 640 columns at 90 degrees. Its center 320, 240 is counted from the corner of the first pixel."""
BASELINE = 0.25  # meters between the cameras
SKY = 1000.0
"""From this depth on, in meters, a pixel is sky: it is painted on a sphere (10 000, or infinity in half precision)."""
_AXES = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""Our camera axes (right, down, forward) to theirs, which are those of the world too (north, east, down)."""
_POSE = ("tx", "ty", "tz", "qx", "qy", "qz", "qw")
_CAMERAS = {"V1": ("left", "right"), "V2": ("lcam_front", "rcam_front")}
_SIZES = {"V1": (480, 640), "V2": (640, 640)}  # (height, width)
_FIX = "unpack image_left.zip and depth_left.zip of its worlds (V2: image_lcam_front.zip, depth_lcam_front.zip)"


class TartanAirDrive(DepthFilesDrive):
    """One camera of one flight; depth is the camera's z."""

    @staticmethod
    def read(path: Path) -> NDArray[np.float32]:
        """Return a stored map in meters, from an array, or from V2's four bytes per PNG pixel; the sky is unknown."""
        if path.suffix == ".npy":
            depth = read_array(path)
        else:
            depth = read_unchanged(path)
            if depth.dtype == np.uint8 and depth.ndim == 3 and depth.shape[2] == 4:
                depth = np.ascontiguousarray(depth).view("<f4")[..., 0]
        if depth.ndim != 2 or depth.dtype.kind != "f":
            raise DataError(
                f"{path} contains {depth.dtype} of shape {depth.shape}; expected h x w floating-point numbers"
            )
        return np.where((depth > 0) & (depth < SKY), depth, 0).astype(np.float32)


@datamodules.register("tartanair")
class TartanAirDataModule(RecordingsDataModule):
    """TartanAir and TartanAir V2: rendered flights, easy and hard, indoors and outdoors, with exact depth and poses.

    Args:
        root: Folder of the worlds, in either version's layout, at any of the levels above ``P000``.
        right: Use the right camera's images too.
        val_drives: Flights to validate on, by name below the root (``abandonedfactory/Easy/P011 l``) or by pattern.
        test_drives: Flights to test and predict; by default the held-out frames.
        val_share: Fraction to hold out if no flights are named: whole flights if there are ten or more, else their
            ends.
        **loading: Loader settings, as in `LoadOptions`.

    Raises:
        ConfigError: if a parameter is out of range.
    """

    protocol = "synthetic"
    ground_truth = "exact"

    def __init__(
        self,
        *,
        root: str = "data/tartanair",
        right: bool = False,
        val_drives: Sequence[str] = (),
        test_drives: Sequence[str] = (),
        val_share: float = 0.1,
        target_depth: bool = False,
        with_pose: bool = False,
        stereo: bool = False,
        cache: str | None = None,
        **loading: Unpack[Loading],
    ) -> None:
        super().__init__(target_depth=target_depth, with_pose=with_pose, stereo=stereo, cache=cache, **loading)
        self.root, self.right = root, right
        self.hold_out(val_drives, test_drives, val_share)

    def find(self) -> Sequence[TartanAirDrive]:
        root = Path(self.root).expanduser().absolute()
        found: list[TartanAirDrive] = []
        for version, (left, right) in _CAMERAS.items():
            folders = [path.parent for level in range(5) for path in root.glob("*/" * level + f"image_{left}")]
            for folder in sorted(folders):
                parts = folder.relative_to(root).parts or (folder.name,)  # an archive repeats its world's name
                name = "/".join(part for place, part in enumerate(parts) if part not in parts[:place])
                sides = read_flight(folder, name, version, left, "l"), read_flight(folder, name, version, right, "r")
                T_right_left = np.eye(4)
                T_right_left[0, 3] = -BASELINE
                pair_up(*sides, T_right_left)
                found += [side for side in sides[: 1 + self.right] if side.indices]
        if not found:
            raise DataError(
                f"no folder image_left or image_lcam_front with images at {root} or up to four below; {_FIX}"
            )
        return found


def read_flight(folder: Path, name: str, version: str, camera: str, side: str) -> TartanAirDrive:
    """Return one camera's recording; without its pose file, poses are unknown."""
    height, width = _SIZES[version]
    paths = numbered(folder / f"image_{camera}", rf"(\d+)_{camera}\.(?:png|jpg)")
    file, poses = folder / f"pose_{camera}.txt", dict[int, NDArray[np.float64]]()
    if file.is_file():
        rows = read_rows(file, _POSE)
        if paths and len(rows) <= max(paths):
            raise DataError(f"{file} has {len(rows)} poses but the images go up to number {max(paths)}; copy it again")
        for frame in paths:
            T_ned = transform(rows[frame, 3:].tolist(), rows[frame, :3].tolist(), "xyzw", f"{file}, pose {frame}")
            poses[frame] = _AXES.T @ T_ned @ _AXES
    K = np.array([[FOCAL, 0, (width - 1) / 2], [0, FOCAL, (height - 1) / 2], [0, 0, 1]])
    drive = TartanAirDrive(
        f"{name} {side}", paths, K, Path("TartanAir's camera"), (height, width), poses=poses, folder=folder
    )
    drive.depths = numbered(folder / f"depth_{camera}", rf"(\d+)_{camera}_depth\.(?:npy|png)")
    return drive
