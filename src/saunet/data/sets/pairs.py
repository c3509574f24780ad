"""Any folder of images with depth maps: Ultralytics' layout, NYU-like ones, and what ``saunet predict`` writes."""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from lightning.pytorch.utilities import rank_zero_warn
from numpy.typing import NDArray
from typing_extensions import Unpack

from saunet.data.drive import Drive
from saunet.data.loading.options import Loading
from saunet.data.sets.files import RecordingsDataModule
from saunet.data.video.calibrations import FILE_NAME
from saunet.data.video.camera import CameraFile, read_camera, unknown_camera
from saunet.errors import DataError, positive
from saunet.io.images import IMAGE_SUFFIXES, frame_order, image_size, read_depth, read_image
from saunet.io.plain import read_array
from saunet.registry import datamodules

IMAGES, DEPTHS = frozenset({"images", "image", "rgb", "color"}), frozenset({"depth", "depths"})
"""Names of sibling folders with the images and their depth maps."""
VIEW = 60.0
"""Horizontal field of view of `unknown_camera` in degrees; only losses and metrics of 3D shape use it."""
_SPLITS = {"train": "train", "training": "train", "val": "val", "valid": "val", "validation": "val", "test": "test"}
_WORD = r"(?:(?:sync_)?depth|rgb|colou?r|image|img)s?"
_WORDS = re.compile(rf"^{_WORD}[_-]?|[_-]?{_WORD}$", re.IGNORECASE)
_DEPTH = re.compile(r"(?:sync_)?depth.*|.*depth", re.IGNORECASE)
_LAYOUT = (
    "expected images/NAME.jpg beside depth/NAME.npy (meters) or depth/NAME.png (16 bits), or rgb_NAME.jpg beside "
    "depth_NAME.png in one folder"
)


class PairsDrive(Drive):
    """The images of a folder, in order, with their depth maps; images may differ in size."""

    def __init__(
        self,
        name: str,
        images: Mapping[int, Path],
        depths: Mapping[int, Path],
        depth_scale: float,
        camera: CameraFile,
    ) -> None:
        self._name, self.images, self.depths = name, images, depths
        self.depth_scale, self.camera = depth_scale, camera
        self._indices = sorted(images)
        self._known_K: dict[tuple[int, int], NDArray[np.float64]] = {}

    @property
    def name(self) -> str:
        return self._name

    @property
    def indices(self) -> Sequence[int]:
        return self._indices

    @property
    def folder(self) -> Path:
        return self.images[self._indices[0]].parent

    @property
    def camera_height(self) -> float | None:
        return self.camera.camera_height

    @property
    def condition(self) -> str | None:
        return self.camera.condition

    def time(self, index: int) -> float | None:
        return index / self.camera.fps if self.camera.fps else None

    def path(self, index: int) -> Path:
        return self.images[index]

    def image(self, index: int) -> NDArray[np.uint8]:
        return read_image(self.path(index))

    def intrinsics(self, index: int) -> NDArray[np.float64]:
        size = image_size(self.path(index))
        if size not in self._known_K:
            self._known_K[size] = self.camera.intrinsics(*size, str(self.path(index)))
        return self._known_K[size].copy()

    def has_depth(self, index: int) -> bool:
        return index in self.depths

    def depth(self, index: int) -> NDArray[np.float32] | None:
        return read_pair_depth(self.depths[index], self.depth_scale) if index in self.depths else None


def read_pair_depth(path: Path, depth_scale: float) -> NDArray[np.float32]:
    """Return depth in meters, h x w, 0 where unknown: where the file has 0, a negative or a non-finite number."""
    if path.suffix.lower() != ".npy":
        return read_depth(path, depth_scale)
    depth = read_array(path)
    depth = depth[..., 0] if depth.ndim == 3 and depth.shape[2] == 1 else depth
    if depth.ndim != 2 or depth.dtype.kind != "f":
        raise DataError(
            f"{path} contains {depth.dtype} of shape {depth.shape}; a depth map must have h x w floating-point "
            "numbers in meters"
        )
    return np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)


@datamodules.register("pairs")
class PairsDataModule(RecordingsDataModule):
    """Any folder of images with depth maps in meters, laid out like Ultralytics, NYU-like sets or ``pairs`` of predict.

    Depth is a float ``.npy`` in meters or a 16-bit PNG; values of 0 or below are unknown. The images of a folder, in
    order, are one recording, and training takes neighbors in it as neighbors in time. Folders called train, val and
    test are the splits unless recordings are named.

    Args:
        root: Folder of the images and depth maps, at any depth.
        depth_scale: Value of one meter in 16-bit PNGs: 1000 for millimeters, 256 for KITTI's maps.
        camera: Calibration of the camera; by default the nearest ``camera.yaml`` of each folder.
        val_drives: Folders to validate on, by name below the root or by pattern.
        test_drives: Folders to test and predict; by default the held-out frames.
        val_share: Fraction to hold out if neither folders nor names define validation.
        **loading: Loader settings, as in `LoadOptions`.

    Raises:
        ConfigError: if a parameter is out of range.
    """

    recognizable = False
    protocol = "synthetic"
    ground_truth = "exact"
    cacheable = False  # copies need recordings with images of one size

    def __init__(
        self,
        *,
        root: str = "data/pairs",
        depth_scale: float = 1000.0,
        camera: str | None = None,
        val_drives: Sequence[str] = (),
        test_drives: Sequence[str] = (),
        val_share: float = 0.1,
        target_depth: bool = False,
        **loading: Unpack[Loading],
    ) -> None:
        super().__init__(target_depth=target_depth, **loading)
        self.root, self.camera = root, camera
        self.depth_scale = float(positive("depth_scale", depth_scale))
        self.hold_out(val_drives, test_drives, val_share)

    def find(self) -> Sequence[PairsDrive]:
        root = Path(self.root).expanduser()
        if not root.is_dir():
            raise DataError(f"no data root at {root.absolute()}; set data.root to a folder of images and depth maps")
        images, depths = _find_files(root)
        if not images.keys() & depths.keys():
            what = f"{len(images)} images and {len(depths)} depth maps below {root} but no image matches a depth map"
            raise DataError(f"{what}; {_LAYOUT}")
        folders: dict[Path, list[tuple[str, str]]] = {}
        for key in images:
            folders.setdefault(images[key].parent, []).append(key)
        given = read_camera(self.camera) if self.camera else None
        found, assumed = [], []
        for folder, keys in sorted(folders.items()):
            if not any(key in depths for key in keys):
                continue
            camera = given or _nearest_camera(folder, root)
            if camera is None:
                assumed.append(folder)
                camera = unknown_camera(folder / FILE_NAME)
            if not camera.is_straight:
                raise DataError(
                    f"{camera.path} describes images with distortion, and depth maps cannot be undistorted here; "
                    "undistort both first"
                )
            names = [images[key].name for key in keys]
            order = [keys[place] for place in frame_order(names)]
            numbers = [re.findall(r"\d+", Path(images[key].name).stem)[-1:] for key in order]
            counted = [int(number[0]) for number in numbers if number]
            if len(set(counted)) < len(order) or counted != sorted(counted):
                counted = list(range(len(order)))
            found.append(
                PairsDrive(
                    folder.relative_to(root).as_posix() if folder != root else root.absolute().name,
                    {number: images[key] for number, key in zip(counted, order, strict=True)},
                    {number: depths[key] for number, key in zip(counted, order, strict=True) if key in depths},
                    self.depth_scale,
                    camera,
                )
            )
        if assumed:
            rank_zero_warn(
                f"{len(assumed)} of {len(found)} folders have no {FILE_NAME}, the first {assumed[0]}; a horizontal "
                f"field of view of {VIEW:g} degrees is assumed; set data.camera before training on video"
            )
        return found

    @functools.cached_property
    def recordings(self) -> Mapping[str, Drive]:
        """All recordings by name; folder names decide what is held out unless recordings are named."""
        found = {drive.name: drive for drive in self.find()}
        if not self.val_drives and not self.test_drives:
            splits = {name: _SPLITS.get(_split_folder(name), "train") for name in found}
            self.val_drives = tuple(name for name, split in splits.items() if split == "val")
            self.test_drives = tuple(name for name, split in splits.items() if split == "test")
        return found


def _find_files(root: Path) -> tuple[dict[tuple[str, str], Path], dict[tuple[str, str], Path]]:
    """Return images and depth maps by their common key: the folder, and the name without words for either."""
    images: dict[tuple[str, str], Path] = {}
    depths: dict[tuple[str, str], Path] = {}
    for place, folders, names in os.walk(root, followlinks=True):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        parts = Path(place).relative_to(root).parts
        common = "/".join("*" if part.lower() in IMAGES | DEPTHS else part for part in parts)
        inside = [part.lower() in DEPTHS for part in parts if part.lower() in IMAGES | DEPTHS][-1:]
        for name in sorted(names):
            stem, suffix = os.path.splitext(name)
            is_depth = suffix.lower() == ".npy" or (inside[0] if inside else bool(_DEPTH.fullmatch(stem)))
            if name.startswith(".") or suffix.lower() not in (IMAGE_SUFFIXES | {".npy"}):
                continue
            known, key = depths if is_depth else images, (common, _WORDS.sub("", stem))
            if key in known and not is_depth:
                raise DataError(f"{known[key]} and {Path(place) / name} would share one depth map; remove one of them")
            if key not in known or suffix.lower() == ".png":  # PNG before NPY, as in Ultralytics
                known[key] = Path(place) / name
    return images, depths


def _split_folder(name: str) -> str:
    return next((part.lower() for part in name.split("/") if part.lower() in _SPLITS), "")


def _nearest_camera(folder: Path, root: Path) -> CameraFile | None:
    above = [folder, *folder.parents]
    path = next((p / FILE_NAME for p in above[: above.index(root) + 1] if (p / FILE_NAME).is_file()), None)
    return None if path is None else read_camera(path)
