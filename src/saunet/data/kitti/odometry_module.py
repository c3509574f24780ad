"""The KITTI odometry benchmark as a data module."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from typing_extensions import Unpack

from saunet.data.kitti.odometry import CAMERAS, OdometrySequence, find_root
from saunet.data.kitti.raw import CAMERA_HEIGHT
from saunet.data.loading.holdout import Frame, hold_out_tails
from saunet.data.loading.module import DepthDataModule
from saunet.data.loading.options import Loading
from saunet.data.loading.windows import Selection, reach
from saunet.errors import in_range, one_of
from saunet.registry import datamodules


@datamodules.register("kitti_odometry")
class KittiOdometryDataModule(DepthDataModule):
    """KITTI odometry sequences with true camera motion: color or gray, standard or chosen sequences.

    Args:
        root: Folder that holds ``sequences`` and ``poses``.
        train_sequences: Sequences to train on.
        test_sequences: Sequences to test and predict.
        val_share: Share of each training sequence, its end, that validates.
        camera: ``color_left``, ``color_right``, ``gray_left`` or ``gray_right``.
        with_pose: Batches carry the true motion.
        stereo: Batches carry the other camera of the pair as one more source, placed by the calibration; with
            ``offsets: []`` it is the only one.
        cache: Folder of smaller copies made by ``saunet prepare cache``; training and validation read images from it.
        **loading: Loader settings, as in `LoadOptions`.

    Raises:
        ConfigError: if a parameter is out of range or a word unknown.
    """

    neighbors = ("train", "val", "test")
    camera_height = CAMERA_HEIGHT

    root: str

    def __init__(
        self,
        *,
        root: str = "data/kitti_odometry",
        train_sequences: Sequence[str] = ("00", "01", "02", "03", "04", "05", "06", "07", "08"),
        test_sequences: Sequence[str] = ("09", "10"),
        val_share: float = 0.05,
        camera: Literal["color_left", "color_right", "gray_left", "gray_right"] = "color_left",
        with_pose: bool = False,
        stereo: bool = False,
        cache: str | None = None,
        **loading: Unpack[Loading],
    ) -> None:
        super().__init__(
            with_pose=with_pose,
            stereo=stereo,
            cache=cache,
            **loading,
        )
        self.root = root
        self.train_sequences, self.test_sequences = tuple(train_sequences), tuple(test_sequences)
        self.val_share = in_range("val_share", val_share, 0.0, 0.9)
        self.camera = one_of("camera", camera, CAMERAS)

    def select(self, split: str) -> Sequence[Selection]:
        """Return the frames of a split, a sequence each."""
        root: Path = find_root(self.root)
        names = self.train_sequences if split in ("train", "val") else self.test_sequences
        selections = []
        for name in names:
            drive = OdometrySequence(root, name, self.camera)
            frames: Sequence[int] = drive.indices
            left_out = {}
            if split in ("train", "val"):
                listed = [Frame(name, index, "l") for index in frames]
                parts = hold_out_tails(listed, self.val_share, gap=reach(self.offsets))
                if split == "train":
                    left_out = {"between training and validation": len(frames) - len(parts[0]) - len(parts[1])}
                frames = [frame.number for frame in parts[split == "val"]]
                if not frames:
                    continue
            if self.with_pose and split in self.neighbors:
                known = self._with_motion(drive, frames)
                left_out["without pose"] = len(frames) - len(known)
                frames = known
            selections.append(Selection(drive, frames, left_out))
        return selections

    def _with_motion(self, drive: OdometrySequence, frames: Sequence[int]) -> list[int]:
        """Drop the frames of which a pose is missing, their own or that of a neighbor that exists."""
        unknown = {index for index in drive.indices if drive.pose(index) is None}
        return [index for index in frames if not any(index + offset in unknown for offset in (0, *self.offsets))]
