"""DDAD: scenes of six cameras and a laser scanner at 10 Hz, described by the json files of TRI's DGP format."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Unpack

from saunet.data.drive import Drive
from saunet.data.loading.options import Loading
from saunet.data.sets.base import (
    FilesDataModule,
    Listing,
    ScannedDrive,
    chosen,
    file_key,
    find_root,
    reading,
    those_present,
    transform,
)
from saunet.errors import DataError
from saunet.io.images import read_image, resize
from saunet.io.plain import read_arrays, read_json
from saunet.registry import datamodules

CAMERAS = ("camera_01", "camera_05", "camera_06", "camera_07", "camera_08", "camera_09")
"""Cameras, the front one first; in the files their names are upper case."""
SPLITS = {"train": "0", "val": "1", "test": "1", "predict": "1"}
"""Split -> its key in ddad.json; the official test images come without depth, so papers report val."""
MAX_RANGE = 250.0  # range of the scanners in meters

Array = NDArray[np.float64]


class DdadDrive(ScannedDrive):
    """One camera of one scene; depth from the scanner's points, moved from their time to that of the image."""

    def __init__(self, scene: Path, plain: Any, camera: str, masks: Path | None, there: Listing) -> None:
        folder, sizes = scene.parent, set[tuple[int, int]]()
        paths: dict[int, Path] = {}
        poses: dict[int, Array] = {}
        times: dict[int, float] = {}
        scans: dict[int, tuple[Path, Array]] = {}
        with reading(scene, "a scene of DDAD"):
            data = {datum["key"]: datum for datum in plain["data"]}
            (key,) = {sample["calibration_key"] for sample in plain["samples"]}
            for index, sample in enumerate(plain["samples"]):
                for datum in map(data.__getitem__, sample["datum_keys"]):
                    name = datum["id"]["name"].lower()
                    if name not in (camera, "lidar"):
                        continue
                    (record,) = datum["datum"].values()
                    T_world_sensor = _transform(record["pose"], f"{scene}: {name} of sample {index}")
                    if name == "lidar":
                        scans[index] = folder / record["filename"], T_world_sensor
                        continue
                    paths[index], poses[index] = folder / record["filename"], T_world_sensor
                    stamp = np.datetime64(datum["id"]["timestamp"].removesuffix("Z"), "us")
                    times[index] = int(stamp.astype(np.int64)) / 1e6
                    sizes.add((int(record["height"]), int(record["width"])))
        self.wanted = sorted(paths)
        calibration = folder / "calibration" / f"{key}.json"
        K, T_car_cam = _read_calibration(calibration, camera)
        super().__init__(
            f"{folder.name}/{camera}",
            {index: path for index, path in paths.items() if path in there},
            K,
            calibration,
            sizes.pop() if len(sizes) == 1 else None,
            times=times,
            poses=poses,
            camera_height=float(T_car_cam[2, 3]),  # the car's frame lies on the ground
            folder=folder,
            scans=scans,
        )
        self._mask = _find_mask(masks, folder.name, camera.upper()) if masks else None

    def points(self, scan: Path) -> NDArray[np.float32]:
        points = read_arrays(scan, DataError).get("data", np.empty(0))
        if points.ndim != 2 or points.shape[1] < 3:
            raise DataError(f"{scan} has 'data' of shape {points.shape}; expected n x 4 (x, y, z, intensity)")
        return points[:, :3]

    def depth(self, index: int) -> NDArray[np.float32] | None:
        depth = super().depth(index)
        if depth is not None:
            depth[depth > MAX_RANGE] = 0
            if self.scene_mask is not None:
                depth[~self.scene_mask] = 0
        return depth

    def depth_key(self, index: int) -> str | None:
        key = super().depth_key(index)
        return (key and self._mask and f"{file_key(self._mask)[:32]}{key[:32]}") or key

    @property
    def has_scene_mask(self) -> bool:
        return self._mask is not None

    @property
    def scene_mask(self) -> NDArray[np.bool_] | None:
        return None if self._mask is None else _read_mask(self._mask, self.native_size)


@datamodules.register("ddad")
class DdadDataModule(FilesDataModule):
    """DDAD: 150 scenes to train, 50 to validate and test, six cameras around the car, depth to 250 m.

    Args:
        root: Folder with ``ddad.json`` and the folders of the scenes.
        cameras: Cameras to train on, of ``camera_01`` (front), ``camera_05`` to ``camera_09``.
        test_cameras: Cameras to validate and test on.
        masks: Folder of masks, black where a camera sees its own car, as ``CAMERA_05/<scene>/mask.png``,
            ``<scene>/CAMERA_05_mask.png`` or ``CAMERA_05_mask.png`` for all scenes. Black pixels have no depth and no
            photometric loss. None uses all pixels.
        **loading: Loader settings, as in `LoadOptions`.

    Raises:
        ConfigError: if a parameter is out of range or a choice is unknown.
    """

    protocol = "ddad"

    def __init__(
        self,
        *,
        root: str = "data/ddad",
        cameras: Sequence[str] = ("camera_01",),
        test_cameras: Sequence[str] = ("camera_01",),
        masks: str | None = None,
        target_depth: bool = False,
        with_pose: bool = False,
        cache: str | None = None,
        **loading: Unpack[Loading],
    ) -> None:
        super().__init__(target_depth=target_depth, with_pose=with_pose, cache=cache, **loading)
        self.root, self.masks = root, None if masks is None else Path(masks).expanduser()
        self.cameras = chosen("cameras", [name.lower() for name in cameras], CAMERAS)
        self.test_cameras = chosen("test_cameras", [name.lower() for name in test_cameras], CAMERAS)

    def drives(self, split: str) -> Sequence[Drive]:
        root = find_root(self.root, "ddad*.json", "the folder with ddad.json")
        index, there = sorted(root.glob("ddad*.json"))[0], Listing()
        with reading(index, "DDAD's list of scenes"):
            scenes = [root / name for name in read_json(index)["scene_splits"][SPLITS[split]]["filenames"]]
        present = those_present(scenes, there, f"scenes that {index.name} lists for {split}", "unpack DDAD.tar there")
        plain = {scene: read_json(scene) for scene in present}
        cameras = self.cameras if split == "train" else self.test_cameras
        return [DdadDrive(scene, plain[scene], camera, self.masks, there) for scene in present for camera in cameras]

    def targets(self, split: str, drive: Drive) -> Sequence[int]:
        made = cast(DdadDrive, drive)  # by `drives`
        return made.wanted


@functools.lru_cache(maxsize=16)
def _read_mask(path: Path, size: tuple[int, int]) -> NDArray[np.bool_]:
    return np.asarray(resize(read_image(path)[..., 0], *size) >= 128, dtype=np.bool_)


def _find_mask(masks: Path, scene: str, camera: str) -> Path | None:
    names = (f"{camera}/{scene}/mask.png", f"{scene}/{camera}_mask.png", f"{camera}_mask.png")
    found = next((masks / name for name in names if (masks / name).is_file()), None)
    if found is None and camera.lower() != CAMERAS[0]:  # the front camera does not see its car
        raise DataError(f"no mask of {camera} in scene {scene} at {masks}; expected one of {', '.join(names)}")
    return found


def _transform(plain: Any, where: str) -> Array:
    rotation = [plain["rotation"].get(key, 0.0) for key in ("qw", "qx", "qy", "qz")]  # protobuf may omit zeros
    return transform(rotation, [plain["translation"].get(key, 0.0) for key in "xyz"], "wxyz", where)


def _read_calibration(path: Path, camera: str) -> tuple[Array, Array]:
    """Return K in pixels (as OpenCV's, so pixel centers are integers) and T_car_cam."""
    with reading(path, "a calibration of DDAD"):
        plain = read_json(path)
        place = [name.lower() for name in plain["names"]].index(camera)
        fx, fy, cx, cy, skew = (plain["intrinsics"][place].get(key, 0.0) for key in ("fx", "fy", "cx", "cy", "skew"))
        T_car_cam = _transform(plain["extrinsics"][place], f"{path}: {camera}")
    return np.array([[fx, skew, cx], [0, fy, cy], [0, 0, 1]], np.float64), T_car_cam
