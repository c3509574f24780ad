"""Cityscapes: snippets of 30 frames at 17 Hz, one camera file and one annotated frame each, depth from stereo."""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Unpack

from saunet.data.drive import Drive
from saunet.data.loading.options import Loading
from saunet.data.sets.base import FilesDataModule, FilesDrive, find_root, reading
from saunet.errors import DataError, one_of
from saunet.io.images import read_depth, read_image
from saunet.io.plain import read_json
from saunet.registry import datamodules

FPS = 17.0
SIZE = (1024, 2048)
BEFORE, AFTER = 19, 10
"""Frames of a snippet before and after the annotated one, which has the camera file."""
KEPT = 0.75
"""Fraction of the images that is used, from the top: below are the hood and the star on it (Watson et al. 2021)."""
_NAME = re.compile(r"(.+_\d{6}_)(\d{6})_[A-Za-z0-9]+\.(?:png|jpg|json)")

Files = Mapping[tuple[str, int], Path]  # ("aachen_000000_", 19) -> file


class CityscapesDrive(FilesDrive):
    """The frames around one annotated frame of one camera; depth maps of the left one."""

    def __init__(self, camera: Path, split: str, files: Mapping[str, Files], kept: float, side: str = "l") -> None:
        start, number = _parts(camera)
        self.annotated, self._made = number, (camera, split, files, kept)
        self.wanted = range(number - BEFORE, number + AFTER + 1)
        found = {kind: {i: of[start, i] for i in self.wanted if (start, i) in of} for kind, of in files.items()}
        self._disparities = found["disparity"] if side == "l" else {}
        self._kept = kept
        K, self.baseline, height = _read_camera(camera)
        times = {index: index / FPS for index in self.wanted}
        paths = found["left" if side == "l" else "right"]
        super().__init__(
            f"{split}/{start}{number:06d} {side}", paths, K, camera, SIZE, times=times, camera_height=height
        )

    @property
    def origin(self) -> str:
        return f"upper {self._kept:g}"

    @property
    def frame_size(self) -> tuple[int, int]:
        height, width = self.recorded_size
        return round(self._kept * height), width

    def image(self, index: int) -> NDArray[np.uint8]:
        return self._upper(read_image(self.path(index)))

    def has_depth(self, index: int) -> bool:
        return index in self._disparities

    def depth(self, index: int) -> NDArray[np.float32] | None:
        """Return depth from the stored disparity: (p - 1) / 256 pixels; p = 0 is unknown and 1 infinitely far."""
        if index not in self._disparities:
            return None
        disparity = read_depth(self._disparities[index]) - np.float32(1 / 256)
        if disparity.shape != SIZE:
            raise DataError(
                f"{self._disparities[index]} is {disparity.shape[1]}x{disparity.shape[0]} (width x height); its "
                f"values are pixels of images of {SIZE[1]}x{SIZE[0]}: use the original map"
            )
        far = np.float32(self.baseline * self.calibrated_K[0, 0])
        return self._upper(np.divide(far, disparity, out=np.zeros_like(disparity), where=disparity > 0))

    def stereo(self) -> CityscapesDrive | None:
        return self._stereo if self._made[2]["right"] else None

    @functools.cached_property
    def _stereo(self) -> CityscapesDrive:
        return CityscapesDrive(*self._made, side="r")

    @property
    def T_stereo_cam(self) -> NDArray[np.float64]:  # noqa: N802 (frames in names)
        T = np.eye(4)
        T[0, 3] = -self.baseline
        return T

    def _upper(self, picture: NDArray[Any]) -> NDArray[Any]:
        return np.ascontiguousarray(picture[: round(self._kept * len(picture))])


@datamodules.register("cityscapes")
class CityscapesDataModule(FilesDataModule):
    """Cityscapes: training on the 30 frames of each snippet, validation and test on the annotated ones with disparity.

    Args:
        root: Folder with ``leftImg8bit_sequence``, ``camera`` and ``disparity``, each holding train, val and test.
        crop: ``bonnet`` keeps the upper three quarters of images and depth, as the protocol requires; ``none`` keeps
            all.
        **loading: Loader settings, as in `LoadOptions`.

    Raises:
        ConfigError: if a parameter is out of range or a choice is unknown.
    """

    protocol = "cityscapes"

    def __init__(
        self,
        *,
        root: str = "data/cityscapes",
        crop: Literal["bonnet", "none"] = "bonnet",
        target_depth: bool = False,
        stereo: bool = False,
        cache: str | None = None,
        **loading: Unpack[Loading],
    ) -> None:
        super().__init__(target_depth=target_depth, stereo=stereo, cache=cache, **loading)
        self.root = root
        self.crop = one_of("crop", crop, ("bonnet", "none"))

    def drives(self, split: str) -> Sequence[Drive]:
        split = "test" if split == "predict" else split
        root = find_root(self.root, "leftImg8bit*", "the folder with leftImg8bit_sequence, camera and disparity")
        cameras = sorted(root.glob(f"camera/{split}/*/*_camera.json"))
        if not cameras:
            raise DataError(f"no camera files at {root / 'camera' / split}; unpack camera_trainvaltest.zip at {root}")
        if self.has_neighbors(split) and self.offsets and not (root / "leftImg8bit_sequence").is_dir():
            raise DataError(
                f"{root} has no leftImg8bit_sequence, and {split} needs the neighbors of its {len(cameras)} annotated "
                f"frames; unpack leftImg8bit_sequence_trainvaltest.zip at {root}"
            )
        kinds = {"left": "leftImg8bit", "right": "rightImg8bit", "disparity": "disparity"}
        files = {kind: _files(root, folder, split) for kind, folder in kinds.items()}
        return [CityscapesDrive(camera, split, files, KEPT if self.crop == "bonnet" else 1.0) for camera in cameras]

    def targets(self, split: str, drive: Drive) -> Sequence[int]:
        made = cast(CityscapesDrive, drive)  # by `drives`
        return made.wanted if split == "train" else [made.annotated]


def _parts(path: Path) -> tuple[str, int]:
    match = _NAME.fullmatch(path.name)
    if match is None:
        raise DataError(f"{path} is not named as Cityscapes' files are, such as aachen_000000_000019_{path.parts[-4]}")
    return match[1], int(match[2])


def _files(root: Path, folder: str, split: str) -> Files:
    """Return the files of single frames and of snippets; if a frame has both, that of the snippet."""
    single, snippets = (root.glob(f"{name}/{split}/*/*.png") for name in (folder, f"{folder}_sequence"))
    return {_parts(path): path for paths in (single, snippets) for path in paths}


def _read_camera(path: Path) -> tuple[NDArray[np.float64], float, float]:
    """Return K in pixels of full images (as OpenCV's, so pixel centers are integers), baseline and height in meters."""
    with reading(path, "a camera file of Cityscapes"):
        plain = read_json(path)
        fx, fy, u0, v0 = (float(plain["intrinsic"][key]) for key in ("fx", "fy", "u0", "v0"))
        baseline, height = float(plain["extrinsic"]["baseline"]), float(plain["extrinsic"]["z"])
    return np.array([[fx, 0, u0], [0, fy, v0], [0, 0, 1]]), baseline, height
