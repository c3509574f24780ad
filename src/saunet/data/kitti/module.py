"""KITTI raw recordings as a data module."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from typing_extensions import Unpack

from saunet.data.kitti import splits
from saunet.data.kitti.raw import CAMERA_HEIGHT, CAMERAS, DEPTH_KINDS, DepthKind, KittiRaw
from saunet.data.loading.module import DepthDataModule
from saunet.data.loading.options import Loading
from saunet.data.loading.selecting import BETWEEN, Frame, has_speed, hold_out, hold_out_drives, moving, with_truth
from saunet.data.loading.stored import DENSE_KINDS, DepthMaps
from saunet.data.loading.windows import Selection, reach
from saunet.errors import ConfigError, DataError, in_range, one_of, suggest
from saunet.registry import datamodules

_PROTOCOLS = {"camera_z": "eigen_camera_z", "lidar_x": "eigen_lidar_x", "improved": "eigen_improved"}


@datamodules.register("kitti")
@datamodules.register("kitti_dense", dense="linear")
class KittiDataModule(DepthDataModule):
    """KITTI raw recordings: real street video with LiDAR depth and the calibrated intrinsics of each camera and date.

    Missing drives, frames, sides and scans are left out and reported; it is an error if nothing is left.

    Args:
        root: Folder of the recordings: the one with the date folders, one above it, or one of the date folders.
        split: Training and validation frames: ``eigen_zhou_by_drive``, ``eigen_zhou_random``, ``eigen_full``; ``all``
            for every frame found; a file in Monodepth2's format, or a folder with train_files.txt and val_files.txt.
        test_split: Test frames: ``eigen_test``, ``eigen_benchmark_test``, ``all``, or a file. By default ``eigen_test``
            for a named split, test_files.txt of a folder, and otherwise the held-out frames. Frames without ground
            truth are left out.
        val_drives: Drives to hold out instead of those of the split, such as ``2011_09_26_drive_0001_sync``.
        val_share: Fraction to hold out of ``all`` or a file: whole drives if there are ten or more, else the drives'
            ends.
        cameras: ``left``, ``right`` or both.
        static: Frames of a standing car in training and validation: ``keep`` them; drop those with an OXTS ``speed``
            below 0.5 m/s (without OXTS, by flow); or drop those whose median optical ``flow`` to the previous frame is
            below half a pixel at 320 pixels width. Flow reads every frame once at set-up.
        depth: Kind of ground truth: LiDAR depth as ``camera_z`` or ``lidar_x`` (evaluation only), or ``improved``.
        annotated: Folder of the unpacked data_depth_annotated archive, for ``improved``; by default the maps are looked
            for in the drives' folders, and in the archive's layout below the folder with the dates and the one above
            it.
        dense: Dense depth maps as the target instead of the sparse scan: ``linear`` or ``colorization``, made
            beforehand by ``saunet prepare densify``; ``none`` uses the scan.
        teacher: Batches carry another model's depth, made beforehand by ``saunet prepare teacher``.
        maps: Folder of these maps; None: beside the recordings.
        **loading: Loader settings, as in `LoadOptions`.

    Raises:
        ConfigError: if a parameter is out of range or a choice is unknown.
    """

    camera_height = CAMERA_HEIGHT

    root: str

    def __init__(
        self,
        *,
        root: str = "data/kitti",
        split: str = "eigen_zhou_by_drive",
        test_split: str | None = None,
        val_drives: Sequence[str] = (),
        val_share: float = 0.1,
        cameras: Sequence[str] = ("left", "right"),
        static: Literal["keep", "speed", "flow"] = "keep",
        depth: Literal["camera_z", "lidar_x", "improved"] = "camera_z",
        annotated: str | None = None,
        target_depth: bool = False,
        dense: Literal["none", "linear", "colorization"] = "none",
        teacher: bool = False,
        maps: str | None = None,
        cache: str | None = None,
        stereo: bool = False,
        **loading: Unpack[Loading],
    ) -> None:
        super().__init__(target_depth=target_depth or dense != "none", stereo=stereo, cache=cache, **loading)
        self.root = root
        self.split = _known(split, "split", (*splits.TRAINING, "all"))
        self.test_split = test_split and _known(test_split, "test_split", (*splits.TEST, "all"))
        self.val_drives = tuple(val_drives)
        self.val_share = in_range("val_share", val_share, 0.0, 0.9)
        self.cameras = tuple(one_of("cameras", camera, CAMERAS) for camera in cameras)
        if not self.cameras:
            raise ConfigError(f"cameras is empty; name at least one of {', '.join(CAMERAS)}")
        self.static = one_of("static", static, ("keep", "speed", "flow"))
        self.ground_truth = one_of("depth", depth, DEPTH_KINDS)
        self.protocol = _PROTOCOLS[depth]
        self._depth: DepthKind = depth
        self.annotated = annotated
        self._raw: KittiRaw | None = None
        one_of("dense", dense, ("none", *DENSE_KINDS))
        if dense != "none":
            self.maps["target_depth"] = DepthMaps(dense, maps)
        if teacher:
            self.maps["target_teacher"] = DepthMaps("teacher", maps)

    def select(self, split: str) -> Sequence[Selection]:
        raw = self._raw = self._raw or KittiRaw(self.root, self.annotated)
        skip = self.on_error == "skip"
        between: Counter[tuple[str, str]] = Counter()
        if split in ("train", "val"):
            train, val, unused = self._training(raw)
            sides = {CAMERAS[camera][1] for camera in self.cameras}
            frames = [frame for frame in (train if split == "train" else val) if frame.side in sides]
            if split == "train":
                between.update((frame.drive, frame.side) for frame in unused)
        else:
            frames = self._test(raw)
        self._check_drives(raw, split, frames)
        # Losses always compare with the camera's depth, whatever the evaluation uses.
        kind: DepthKind = "camera_z" if split == "train" and self._depth == "lidar_x" else self._depth
        numbers: dict[tuple[str, str], list[int]] = {}
        for frame in frames:
            numbers.setdefault((frame.drive, frame.side), []).append(frame.number)
        cameras = {side: camera for camera, (_, side) in CAMERAS.items()}
        selections = [
            Selection(raw.drive(drive, cameras[side], kind), wanted, {BETWEEN: between[drive, side]})
            for (drive, side), wanted in numbers.items()
        ]
        if self.static != "keep" and split in ("train", "val"):
            selections = [moving(each, by_speed=self.static == "speed", skip_unreadable=skip) for each in selections]
        if split == "test":
            selections = [with_truth(selection) for selection in selections]
        if split == "train" and self.target_depth and not any(map(_has_truth, selections)):
            raise DataError(
                f"target_depth is true but no training frame below {raw.root} has {kind} depth; "
                "add the velodyne_points, or set data.target_depth=false"
            )
        if split == "train" and self.odometer and not any(has_speed(each, skip) for each in selections):
            raise DataError(
                f"with_speed is true but no training frame below {raw.root} has an OXTS record; "
                "add the oxts folders, or set data.with_speed=false"
            )
        if split in ("train", "val"):
            self._check_maps(selections)
        return selections

    def _check_maps(self, selections: Sequence[Selection]) -> None:
        """Check that the frames of a split have the depth maps asked for; a frame without a scan needs no dense one."""
        for maps in self.maps.values():
            wanted = []
            for drive, frames, _ in selections:
                existing = set(drive.indices)
                dense = maps.kind != "teacher"
                wanted.append((drive, [f for f in frames if f in existing and (not dense or drive.has_depth(f))]))
            what = "teacher checkpoint=..." if maps.kind == "teacher" else f"densify kinds=[{maps.kind}]"
            folder = f" folder={maps.folder}" if maps.folder else ""
            maps.check(wanted, f"saunet prepare {what} root={self.root}{folder}")

    def listed(self, split: str) -> list[str]:
        """Return the names of all images that a split lists, in its order, including those missing below the root."""
        if split != "test":
            return super().listed(split)
        return [str(frame) for frame in self._test(self._raw or KittiRaw(self.root, self.annotated))]

    def _training(self, raw: KittiRaw) -> tuple[list[Frame], list[Frame], set[Frame]]:
        """Return training and validation frames, and those between them, which are in neither."""
        folder, unused = Path(self.split), set[Frame]()
        if self.split in splits.TRAINING:
            parts = splits.training_split(self.split, self.seed)
        elif self.split != "all" and folder.is_dir():
            parts = splits.read_split(folder / "train_files.txt"), splits.read_split(folder / "val_files.txt")
        elif self.val_drives:
            parts = self._listed(raw, self.split), []
        else:
            frames = self._listed(raw, self.split)
            parts = hold_out(frames, self.val_share, reach(self.offsets), self.seed)
            unused = set(frames).difference(*parts)
        if self.val_drives:
            parts = hold_out_drives([*parts[0], *parts[1]], self.val_drives)
        return *parts, unused

    def _test(self, raw: KittiRaw) -> list[Frame]:
        split, file = self.test_split, Path(self.split) / "test_files.txt"
        if split is None:
            split = "eigen_test" if self.split in splits.TRAINING else str(file) if file.is_file() else None
        return self._training(raw)[1] if split is None else self._listed(raw, split)

    def _listed(self, raw: KittiRaw, split: str) -> list[Frame]:
        """Return every frame found for ``all``, those of a named test split, or those of a file."""
        if split != "all":
            return splits.test_split(split) if split in splits.TEST else splits.read_split(Path(split))
        return [
            Frame(name, number, CAMERAS[camera][1])
            for name in raw.drives
            for camera in self.cameras
            for number in raw.drive(name, camera).indices
        ]

    def _check_drives(self, raw: KittiRaw, split: str, frames: Sequence[Frame]) -> None:
        wanted = {frame.drive for frame in frames}
        if wanted and not wanted & raw.drives.keys():
            found = ", ".join(list(raw.drives)[:4])
            raise DataError(
                f"none of the {len(wanted)} drives of the {split} split is below {raw.root} (found: {found}...); "
                "use data.split=all, or add the drives"
            )
        if not wanted and not any(raw.drive(drive).indices for drive in raw.drives):
            raise DataError(f"the drives below {raw.root} hold no images, such as {next(iter(raw.drives.values()))}")


def _known(value: str, name: str, words: Sequence[str]) -> str:
    if value in words or Path(value).exists():
        return value
    hint = suggest(value, words)
    raise ConfigError(f"{name} is '{value}'{hint or ','} allowed: {', '.join(words)}, or the path of an existing file")


def _has_truth(selection: Selection) -> bool:
    return any(selection.drive.has_depth(frame) for frame in selection.frames)
