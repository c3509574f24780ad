"""TUM RGB-D (Sturm et al., 2012): a Kinect moved through rooms, with depth and poses from motion capture."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from typing_extensions import Unpack

from saunet.data.loading.options import Loading
from saunet.data.sets.base import associate, transform
from saunet.data.sets.files import DepthFilesDrive, RecordingsDataModule, read_rows, read_words
from saunet.data.video.lens_models import straightening_maps
from saunet.errors import ConfigError, DataError, one_of, positive
from saunet.io.images import read_depth, read_image
from saunet.registry import datamodules

SIZE = (480, 640)  # (height, width)
STEPS = 5000
"""Stored depth of one meter."""
DEFAULT = (525.0, 525.0, 319.5, 239.5)
"""fx, fy, cx, cy of ROS' driver, which registered depth to the images; the data set recommends these."""
CALIBRATED: dict[str, tuple[tuple[float, float, float, float], tuple[float, ...]]] = {
    "freiburg1": ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "freiburg2": ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "freiburg3": ((535.4, 539.2, 320.1, 247.6), (0.0, 0.0, 0.0, 0.0, 0.0)),
}
"""The calibration of each Kinect: fx, fy, cx, cy, then k1, k2, p1, p2, k3; freiburg3's images are undistorted."""
_FIX = "unpack the sequence's .tgz again"
_POSE = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")


class TumDrive(DepthFilesDrive):
    """One sequence; with a calibration, images and depth are both undistorted."""

    bend: tuple[float, ...] = ()  # distortion of the images

    @staticmethod
    def read(path: Path) -> NDArray[np.float32]:
        return read_depth(path, STEPS)

    def image(self, index: int) -> NDArray[np.uint8]:
        return self._straight(read_image(self.path(index)), cv2.INTER_LINEAR)

    def depth(self, index: int) -> NDArray[np.float32] | None:
        depth = super().depth(index)
        return None if depth is None else self._straight(depth, cv2.INTER_NEAREST)  # no mixing across edges

    def _straight(self, picture: NDArray[Any], interpolation: int) -> NDArray[Any]:
        if not any(self.bend):
            return picture
        K = self.intrinsics(self.indices[0])
        maps = straightening_maps("pinhole", self.bend, K, K, *self.frame_size)
        if interpolation == cv2.INTER_NEAREST:  # OpenCV 5.0 rounds fixed-point maps the wrong way
            return np.asarray(cv2.remap(picture, *cv2.convertMaps(*maps, cv2.CV_32FC1), interpolation))
        return np.asarray(cv2.remap(picture, *maps, interpolation))


@datamodules.register("tum")
class TumDataModule(RecordingsDataModule):
    """TUM RGB-D: hand-held and robot sequences of rooms, with the depth of a Kinect and true poses.

    Images, depth and poses are taken at different times; each image gets the depth and the pose nearest in time, and
    each of these is used once.

    Args:
        root: Folder of the sequences (``rgbd_dataset_freiburg1_xyz``, ...), or one of them.
        calibration: ``default`` uses K for images as they are, as the data set recommends, because depth is registered
            with it; ``kinect`` undistorts images and depth with the calibration of each camera.
        max_difference: Largest difference in time between an image and its depth or pose, in seconds.
        val_drives: Sequences to validate on, by name or by pattern.
        test_drives: Sequences to test and predict; by default the held-out frames.
        val_share: Fraction to hold out if none are named: whole sequences if there are ten or more, else their ends.
        **loading: Loader settings, as in `LoadOptions`.

    Raises:
        ConfigError: if a parameter is out of range or a choice is unknown.
    """

    protocol = "indoor"
    ground_truth = "camera_z"

    def __init__(
        self,
        *,
        root: str = "data/tum",
        calibration: Literal["default", "kinect"] = "default",
        max_difference: float = 0.02,
        val_drives: Sequence[str] = (),
        test_drives: Sequence[str] = (),
        val_share: float = 0.1,
        target_depth: bool = False,
        with_pose: bool = False,
        cache: str | None = None,
        **loading: Unpack[Loading],
    ) -> None:
        super().__init__(target_depth=target_depth, with_pose=with_pose, cache=cache, **loading)
        self.root = root
        self.calibration = one_of("calibration", calibration, ("default", "kinect"))
        self.max_difference = float(positive("max_difference", max_difference))
        self.hold_out(val_drives, test_drives, val_share)

    def find(self) -> Sequence[TumDrive]:
        root = Path(self.root).expanduser().absolute()
        lists = [root / "rgb.txt", *sorted(root.glob("*/rgb.txt")), *sorted(root.glob("*/*/rgb.txt"))]
        folders = [path.parent for path in lists if path.is_file()]
        if not folders:
            raise DataError(f"no rgb.txt at {root} or up to two levels below; unpack the sequences' .tgz there")
        return [read_sequence(folder, self.calibration, self.max_difference) for folder in folders]


def read_sequence(folder: Path, calibration: str, most: float) -> TumDrive:
    """Return a sequence, with frames numbered in the order of rgb.txt."""
    times, paths = _listed(folder / "rgb.txt")
    (fx, fy, cx, cy), bend = DEFAULT, tuple[float, ...]()
    if calibration == "kinect":
        camera = re.search("freiburg[123]", folder.name)
        if not camera:
            raise ConfigError(
                f"the name '{folder.name}' has no freiburg1, 2 or 3; rename it, or set data.calibration=default"
            )
        (fx, fy, cx, cy), bend = CALIBRATED[camera[0]]
    poses, truth = dict[int, NDArray[np.float64]](), folder / "groundtruth.txt"
    if truth.is_file():
        rows = read_rows(truth, _POSE, fix=_FIX)
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
        for frame, row in associate(times, rows[:, 0], most):
            numbers_of = rows[row, 4:].tolist(), rows[row, 1:4].tolist()
            poses[frame] = transform(*numbers_of, "xyzw", f"{truth}, time {rows[row, 0]:.4f}")
    drive = TumDrive(
        folder.name,
        dict(enumerate(paths)),
        np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
        Path(f"{folder.name}: calibration={calibration}"),
        SIZE,
        times=dict(enumerate(times.tolist())),
        poses=poses,
        folder=folder,
    )
    drive.bend = bend
    if (folder / "depth.txt").is_file():
        depth_times, depths = _listed(folder / "depth.txt")
        drive.depths = {frame: depths[row] for frame, row in associate(times, depth_times, most)}
    return drive


def _listed(path: Path) -> tuple[NDArray[np.float64], list[Path]]:
    """Return the times, ascending, and files of a list."""
    rows = []
    for line, words in read_words(path, _FIX):
        try:
            rows.append((float(words[0]), path.parent / words[1]))
        except (ValueError, IndexError):
            got = " ".join(words)[:60]
            raise DataError(f"{path}, line {line}: expected a time and a file name, got '{got}'; {_FIX}") from None
    rows = sorted(row for row in rows if row[1].is_file())
    if not rows:
        raise DataError(f"{path} lists no existing file; {_FIX}")
    return np.array([time for time, _ in rows]), [file for _, file in rows]
