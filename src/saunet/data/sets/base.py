"""Shared by the public data sets: recordings made of image files, and data modules made of whole recordings."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from lightning.pytorch.utilities import rank_zero_warn
from numpy import ndarray
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from saunet.data.checks import check_intrinsics, common_size, scaled
from saunet.data.drive import Drive
from saunet.data.lidar import points_to_depth
from saunet.data.loading.module import DepthDataModule
from saunet.data.loading.selecting import with_poses, with_truth
from saunet.data.loading.windows import Selection
from saunet.errors import ConfigError, DataError, SaunetError, one_of
from saunet.io.images import read_image

Array = NDArray[np.float64]


class FilesDrive(Drive):
    """A recording of image files with one K; a subclass adds the depth that its data set has.

    Args:
        name: See `Drive.name`.
        paths: Frame number -> image file.
        K: 3 x 3, in pixels (with integer centers) of images of ``size``; the images may be scaled, but not cropped.
        calibration: The file with K, for messages.
        size: (height, width) that K belongs to; None if the files do not say.
        times: Frame number -> seconds.
        poses: Frame number -> T_world_cam, 4 x 4, meters.
        camera_height: Meters above the road.
        condition: Weather or light, such as ``night``.
        folder: Folder of the recording.
    """

    def __init__(
        self,
        name: str,
        paths: Mapping[int, Path],
        K: Array,
        calibration: Path,
        size: tuple[int, int] | None = None,
        *,
        times: Mapping[int, float] | None = None,
        poses: Mapping[int, Array] | None = None,
        camera_height: float | None = None,
        condition: str | None = None,
        folder: Path | None = None,
    ) -> None:
        self._name, self.paths, self._indices = name, paths, sorted(paths)
        self.calibrated_K, self.calibration, self._given_size = K, calibration, size
        self._times, self._poses = times or {}, poses or {}
        self._camera_height, self._condition, self._folder = camera_height, condition, folder

    @property
    def name(self) -> str:
        return self._name

    @property
    def indices(self) -> Sequence[int]:
        return self._indices

    def path(self, index: int) -> Path:
        return self.paths[index]

    def image(self, index: int) -> NDArray[np.uint8]:
        return read_image(self.path(index))

    def intrinsics(self, index: int) -> Array:
        return self._scaled.copy()

    @functools.cached_property
    def _scaled(self) -> Array:
        native, where = self.native_size, str(self.calibration)
        check_intrinsics(self.calibrated_K, *native, where)
        return scaled(self.calibrated_K, native, self.recorded_size, self._common[0], self.calibration)

    @property
    def native_size(self) -> tuple[int, int]:
        """(height, width) of the images that the calibration is for, and of computed depth maps."""
        return self._given_size or self.recorded_size

    @property
    def recorded_size(self) -> tuple[int, int]:
        """(height, width) of the image files."""
        return self._common[1]

    @functools.cached_property
    def _common(self) -> tuple[Path, tuple[int, int]]:
        return common_size([self.paths[index] for index in self._indices])

    @property
    def frame_size(self) -> tuple[int, int]:
        return self.recorded_size

    def time(self, index: int) -> float | None:
        return self._times.get(index)

    def pose(self, index: int) -> Array | None:
        return self._poses.get(index)

    @property
    def folder(self) -> Path | None:
        return self._folder

    @property
    def camera_height(self) -> float | None:
        return self._camera_height

    @property
    def condition(self) -> str | None:
        return self._condition


class ScannedDrive(FilesDrive):
    """A recording with a laser scanner: depth from its points, moved from the time of the scan to that of the image.

    Args:
        *args: As for `FilesDrive`.
        scans: Frame number -> file of points, and T_world_lidar at the time of the scan.
        **kwargs: As for `FilesDrive`; frames with a scan need a pose.
    """

    def __init__(self, *args: Any, scans: Mapping[int, tuple[Path, Array]], **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._scans = scans

    def points(self, scan: Path) -> NDArray[np.float32]:
        """Return a file's points in the scanner's frame, n x 3, meters; each data set stores them differently."""
        raise NotImplementedError(f"{type(self).__name__} does not implement reading its points")

    def has_depth(self, index: int) -> bool:
        return index in self._scans and self._scans[index][0].is_file()

    def depth(self, index: int) -> NDArray[np.float32] | None:
        if not self.has_depth(index):
            return None
        T = self._T_cam_lidar(index)
        points = self.points(self._scans[index][0]) @ T[:3, :3].T + T[:3, 3]
        return points_to_depth(points, self.depth_K, self.native_size)

    def depth_key(self, index: int) -> str | None:
        if not self.has_depth(index):
            return None
        return file_key(self._scans[index][0], self._T_cam_lidar(index), self.depth_K, self.native_size)

    @property
    def depth_K(self) -> Array:  # noqa: N802 (matrices in names)
        """K of depth maps, which have the `native_size`."""
        return self.calibrated_K

    def _T_cam_lidar(self, index: int) -> Array:  # noqa: N802 (frames in names)
        T: Array = np.linalg.inv(self._poses[index]) @ self._scans[index][1]
        return T


class FilesDataModule(DepthDataModule):
    """A data set whose splits are lists of recordings; a subclass implements `drives` instead of `select`."""

    root: str

    def drives(self, split: str) -> Sequence[Drive]:
        """Return the recordings of ``train``, ``val``, ``test`` or ``predict``."""
        raise NotImplementedError(f"{type(self).__name__} does not define the recordings of '{split}'")

    def targets(self, split: str, drive: Drive) -> Sequence[int]:
        """Return a recording's frames for a split: all of them unless a subclass overrides it."""
        return drive.indices

    def select(self, split: str) -> Sequence[Selection]:
        """Return a split's target frames: for tests only those with ground truth, with poses if these are needed."""
        selections = [Selection(drive, self.targets(split, drive)) for drive in self.drives(split)]
        if split == "test" and self.ground_truth != "none":
            selections = [with_truth(selection) for selection in selections]
        if self.with_pose and self.has_neighbors(split):
            selections = [with_poses(selection, self.offsets) for selection in selections]
        known = (drive.has_depth(frame) for drive, frames, _ in selections for frame in frames)
        if split == "train" and self.target_depth and not any(known):
            raise DataError(
                f"target_depth is true but no training frame below {self.root} has depth; add the files with depth "
                "(see docs/datasets.md), or set data.target_depth=false"
            )
        return selections


def find_root(root: str | Path, holds: str, what: str) -> Path:
    """Return the folder with an entry ``holds`` (a name or pattern): root, one or two levels below, or one above.

    Raises:
        DataError: if there is none; ``what`` describes such a folder in the message.
    """
    folder = Path(root).expanduser().absolute()
    if not folder.is_dir():
        raise DataError(f"no data root at {folder}; set data.root to {what}")
    for pattern in (holds, f"*/{holds}", f"*/*/{holds}", f"../{holds}"):
        found = sorted(folder.glob(pattern))
        if found:
            depth = len(Path(holds).parts)
            return found[0].parents[depth - 1].resolve()
    raise DataError(f"no '{holds}' at {folder}, one or two levels below or one above; set data.root to {what}")


def transform(
    quaternion: Sequence[float | int],
    translation: Sequence[float | int],
    order: Literal["wxyz", "xyzw"],
    where: str,
) -> Float[ndarray, "4 4"]:
    """Return the rigid motion of a quaternion (in the stated order of its numbers) and a translation, 4 x 4.

    ``where`` names the record in messages. A norm off by more than 1 % is an error; smaller deviations are normalized.
    """
    numbers = np.array([*quaternion, *translation], np.float64)
    length = float(np.linalg.norm(numbers[:4]))
    if numbers.shape != (7,) or not np.isfinite(numbers).all() or abs(length - 1) > 0.01:
        raise DataError(
            f"{where} has rotation {list(quaternion)} and translation {list(translation)}; expected a unit "
            f"quaternion (its length is {length:.4g}) and three finite numbers: copy the file again"
        )
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(np.roll(numbers[:4], -1) if order == "wxyz" else numbers[:4]).as_matrix()
    T[:3, 3] = numbers[4:]
    return T


@contextlib.contextmanager
def reading(path: Path, what: str) -> Iterator[None]:
    """Turn the exceptions of a missing or malformed file into one sentence; ``what`` is what it should be."""
    try:
        yield
    except SaunetError:
        raise
    except OSError as reason:
        raise DataError(f"cannot read {reason.filename or path}, {what}: {reason.strerror or reason}") from reason
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as reason:
        lacks = f"lacks {reason}" if isinstance(reason, KeyError) else str(reason)
        raise DataError(f"{path} is not {what} as published ({lacks}); copy it again") from reason


class Listing:
    """Whether files exist, listing each folder once."""

    def __init__(self) -> None:
        self._names: dict[Path, set[str]] = {}

    def __contains__(self, path: Path) -> bool:
        folder = path.parent
        if folder not in self._names:
            self._names[folder] = set(os.listdir(folder)) if folder.is_dir() else set()
        return path.name in self._names[folder]


def those_present(paths: Sequence[Path], there: Listing, what: str, fix: str) -> list[Path]:
    """Return the paths that exist; warn with a count if some are missing.

    Raises:
        DataError: if none of them exists.
    """
    report_missing([path for path in paths if path not in there], len(paths), what, fix)
    return [path for path in paths if path in there]


def report_missing(missing: Sequence[Any], wanted: int, what: str, fix: str) -> None:
    """Warn that some are missing, with their count and the first; raise if all are."""
    if missing:
        told = f"{len(missing)} of {wanted} {what} are missing, the first {missing[0]}; {fix}"
        if len(missing) == wanted:
            raise DataError(told)
        rank_zero_warn(told)


def associate(first: Float[ndarray, " n"], second: Float[ndarray, " m"], most: float) -> list[tuple[int, int]]:
    """Return pairs of positions in two lists of ascending times, nearest pairs first, each position at most once.

    ``most`` is the largest difference within a pair, in seconds; pairs are sorted by the first position.
    """
    low, high = np.searchsorted(second, first - most, "left"), np.searchsorted(second, first + most, "right")
    close = [(abs(first[i] - second[j]), i, j) for i in range(len(first)) for j in range(low[i], high[i])]
    pairs: dict[int, int] = {}
    taken: set[int] = set()
    for _, i, j in sorted(close):
        if i not in pairs and j not in taken:
            pairs[i] = j
            taken.add(j)
    return sorted(pairs.items())


def chosen(key: str, names: Sequence[str], known: Sequence[str]) -> tuple[str, ...]:
    """Return the names of a setting ``key``, after checking each; at least one is required."""
    if not names:
        raise ConfigError(f"{key} is empty; name at least one of {', '.join(known)}")
    return tuple(one_of(key, name, known) for name in names)


def file_key(path: Path, *facts: Any) -> str:
    """Return a hash of a file's path, size and age and of everything else that ground truth is computed from."""
    state = path.stat()
    plain = [each.tolist() if isinstance(each, np.ndarray) else each for each in facts]
    return hashlib.sha256(repr((str(path.absolute()), state.st_size, state.st_mtime_ns, plain)).encode()).hexdigest()
