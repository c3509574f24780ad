"""Clips of any camera as a data module: frames or videos and one ``camera.yaml``."""

from __future__ import annotations

import functools
import glob
import math
import sys
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Literal

from lightning.pytorch.utilities import rank_zero_info
from rich.progress import Progress
from typing_extensions import Unpack

from saunet.data.loading.module import DepthDataModule
from saunet.data.loading.options import Loading
from saunet.data.loading.selecting import BETWEEN, Division, divide
from saunet.data.loading.windows import Selection, reach
from saunet.data.video.calibrations import FILE_NAME
from saunet.data.video.camera import CameraFile, check_crop, write_camera
from saunet.data.video.clips import (
    Clip,
    FramesCacheError,
    default_cache,
    find_clips,
    read_clip,
    short_hash,
)
from saunet.data.video.drive import SPEEDS, ClipDrive, speeds_file
from saunet.data.video.focal import WINDOW, FocalEstimate, drive_windows, estimate_focal, refusal
from saunet.data.video.motion import measure, motion_key
from saunet.errors import ConfigError, DataError, UnreadableError, in_range, one_of, positive
from saunet.io.atomic import write_json
from saunet.io.plain import read_json
from saunet.io.progress import bar
from saunet.registry import datamodules

_WINDOWS = 100
"""Number of windows in which to look for turns if the camera is unknown."""


@datamodules.register("video")
@datamodules.register("campus", root="data/campus", camera_height=1.20)
class VideoDataModule(DepthDataModule):
    """Your own camera: each folder of frames and each video below the root is a clip; ``camera.yaml`` describes it.

    Frames are undistorted and cropped as they are read. Videos are decoded once into a cache. The motion of the picture
    is measured once, to leave out doubled frames and stops. The originals are never written to.

    Args:
        root: Folder of clips at any depth, a folder of frames, or a video.
        camera: Description of the camera of all clips; by default the nearest ``camera.yaml`` of each. ``unknown``: the
            focal length is estimated from turns in the clips.
        conditions: Only clips whose camera file has one of these conditions, such as ``[cloudy, sunny]``; all if empty.
        val_clips: Clips to hold out, by name below the root or by pattern, such as ``night_*``.
        test_clips: Clips to test and predict; by default the held-out frames.
        val_share: Fraction to hold out if no clips are named: whole clips if there are ten or more, else the clips'
            ends.
        fps: Frames per second to use; None uses all. Folders of frames need ``fps`` in their camera file for that.
        parallax: Use a frame once the picture has moved this far since the last used one (median flow in pixels at 320
            width; 3 is moderate), for even steps at any speed. 0 goes by time alone.
        static: Frames in which nothing moves: ``drop`` leaves them out of training and validation, and doubled frames
            out of everything; ``keep`` keeps all and measures nothing.
        crop: Fractions to cut off at the [top, bottom, left, right], such as ``[0,0.12,0,0]`` for a hood; by default
            those of the camera file.
        camera_height: Meters from the road to the camera, for clips whose camera file has no height.
        align_speeds: Find the clock offset of each ``speeds.csv`` from optical flow, if its clock differs from the
            frames'.
        frames_cache: Folder for decoded videos and measurements; by default in the user's cache folder.
        max_width: Frames of videos are kept at most this wide.
        **loading: Loader settings, as in `LoadOptions`.

    Raises:
        ConfigError: if a parameter is out of range or a choice is unknown.
    """

    recognizable = False
    protocol = "campus"
    ground_truth = "none"

    root: str

    def __init__(
        self,
        *,
        root: str = "data/video",
        camera: str | None = None,
        conditions: Sequence[str] = (),
        val_clips: Sequence[str] = (),
        test_clips: Sequence[str] = (),
        val_share: float = 0.1,
        fps: float | None = 10.0,
        parallax: float = 0.0,
        static: Literal["drop", "keep"] = "drop",
        crop: Sequence[float] | None = None,
        camera_height: float | None = None,
        align_speeds: bool = False,
        frames_cache: str | None = None,
        max_width: int = 1280,
        cache: str | None = None,
        **loading: Unpack[Loading],
    ) -> None:
        super().__init__(cache=cache, **loading)
        self.root, self.camera = root, camera
        self.conditions = tuple(conditions)
        self.val_clips, self.test_clips = tuple(val_clips), tuple(test_clips)
        self.val_share = in_range("val_share", val_share, 0.0, 0.9)
        self.fps = None if fps is None else float(positive("fps", fps))
        self.parallax = float(positive("parallax", parallax, allow_zero=True))
        self.static = one_of("static", static, ("drop", "keep"))
        if crop is not None:
            check_crop(crop, "crop", ConfigError)
        self.crop = None if crop is None else tuple(crop)
        self._height = None if camera_height is None else float(positive("camera_height", camera_height))
        self.frames_cache = default_cache() if frames_cache is None else Path(frames_cache).expanduser()
        self.max_width = int(positive("max_width", max_width))
        self.align_speeds = align_speeds
        self._drives: list[ClipDrive] | None = None
        self._paths: list[Path] = []
        self._broken: list[str] = []

    def prepare_data(self) -> None:
        """Decode videos and measure motion in one process, before the others read them."""
        self.drives()

    def drives(self) -> list[ClipDrive]:
        if self._drives is None:
            clips = find_clips(self.root, self.camera)
            self._paths = [clip.path for clip in clips]
            if self.conditions:
                found = sorted({clip.camera.condition or "none" for clip in clips})
                for condition in self.conditions:
                    one_of("conditions", condition, found)
                clips = [clip for clip in clips if clip.camera.condition in self.conditions]
            with bar(self._place()[0] == 0) as shown:
                drives = [drive for drive in (self._usable_drive(clip, shown) for clip in clips) if drive]
            self._drives = self._with_focal_lengths(drives)
        return self._drives

    @property
    def camera_height(self) -> float | None:
        """Meters of the camera above the road if all clips agree, else None."""
        heights = {drive.camera_height for drive in self.drives()}
        return heights.pop() if len(heights) == 1 else None

    def summary(self, split: str) -> str:
        """Return what a split uses and leaves out; for training also the clips that cannot be read."""
        broken = self._broken if split == "train" else []
        return "\n  ".join([super().summary(split), *(f"clip left out: {error}" for error in broken)])

    def overlap(self) -> str | None:
        return self._division.overlap()

    def speed_problems(self) -> list[str]:
        """Return a sentence about each table of speeds that does not match its clip, or belongs to none by its name."""
        problems = []
        for drive in self.drives():
            try:
                drive.check_speeds()
            except DataError as error:
                problems.append(str(error))
        root = Path(self.root).expanduser()
        begins = root.stem if root.is_file() else ""  # the folder may hold other videos
        base = root.parent if root.is_file() else root
        places = {place for path in self._paths for place in (path, *path.parents) if place.is_relative_to(base)}
        tables = {file for place in places if place.is_dir() for file in place.glob(f"{glob.escape(begins)}*.csv")}
        read = {speeds_file(path) for path in self._paths}
        problems += [
            f"{file} is not read: the speeds of a folder of frames are expected in it as {SPEEDS}, and those of "
            f"drive.mp4 beside it as drive.{SPEEDS}"
            for file in sorted(tables - read)
            if "speed" in file.name.lower()
        ]
        return problems

    @functools.cached_property
    def _division(self) -> Division:
        frames = {drive.name: drive.indices for drive in self.drives()}
        held = {"val_clips": self.val_clips, "test_clips": self.test_clips}
        return divide(frames, held, self.val_share, reach(self.offsets), self.seed)

    def select(self, split: str) -> Sequence[Selection]:
        drives = {drive.name: drive for drive in self.drives()}
        if not any(drive.indices for drive in drives.values()):
            example = next(iter(drives), None) or self._broken[0]
            raise DataError(f"the clips below {self.root} hold no usable frame, such as {example}")
        division = self._division
        if split == "train" and not division.train and not division.unused:
            raise ConfigError(
                f"val_clips and test_clips hold out all clips ({', '.join(drives)}); leave one to train on"
            )
        selections = []
        for name, wanted in division.of(split).items():
            drive = drives[name]
            left_out = {} if split == "val" else dict(drive.left_out)
            if split == "train":
                left_out[BETWEEN] = division.unused.get(name, 0)
            if self.static == "drop" and split in ("train", "val"):
                static = drive.static()
                left_out["static"] = sum(frame in static for frame in wanted)
                wanted = [frame for frame in wanted if frame not in static]
            selections.append(Selection(drive, wanted, left_out))
        return selections

    def _with_focal_lengths(self, drives: list[ClipDrive]) -> list[ClipDrive]:
        """Estimate the focal length of each unknown camera from turns in all its clips."""
        groups: dict[tuple[Path, tuple[int, int]], list[ClipDrive]] = {}
        for drive in drives:
            if not drive.clip.camera.is_known and drive.indices:
                groups.setdefault((drive.clip.camera.path, drive.recorded_size), []).append(drive)
        known: dict[str, CameraFile] = {}
        for (_, (height, width)), several in groups.items():
            found, what = self._focal(several), f"the clips of {self.root} without a known camera"
            if found is None or not found.is_known:
                why = refusal(found, what)
                if not self.guess_camera:
                    raise DataError(f"{why}; or train with model.intrinsics=learned, which starts from a guess")
                rank_zero_info(f"{why}; model.intrinsics=learned starts from 60 degrees of view")
                continue
            K = found.intrinsics(height, width, several[0].frame_size[1])
            focal = float(K[0, 0])
            view = math.degrees(2 * math.atan(width / 2 / focal))
            lens: dict[str, Any] = {"model": "division", "distortion": (found.distortion,)} if found.bend else {}
            for drive in several:
                known[drive.name] = replace(drive.clip.camera, K=K, image_size=(height, width), is_known=True, **lens)
            said = (
                f"known to within {found.uncertainty:.2%} from {found.windows} windows of {WINDOW} frames; "
                f"{found.assumed}"
            )
            camera = known[several[0].name]
            file = self.frames_cache / f"camera-{short_hash(repr((K.tolist(), camera)))}.yaml"
            if not file.is_file():
                write_camera(file, camera, f"estimated from {what}: {said}")
            rank_zero_info(
                f"focal length of {what}: {focal:.1f} px of {width} ({view:.0f} degrees), {said}; this camera is "
                f"kept in {file}; give it to saunet predict as undistort="
            )
        return [drive.seen_by(known[drive.name]) if drive.name in known else drive for drive in drives]

    def _focal(self, drives: Sequence[ClipDrive]) -> FocalEstimate | None:
        """Return the focal length of one camera from turns, in widths of its drives' frames; it is kept on disk."""
        keys = [motion_key(drive.recording.paths, self.crop or drive.clip.camera.crop) for drive in drives]
        key = short_hash(repr((keys, self.fps, self.parallax, self.static, "with center")))
        file = self.frames_cache / f"focal-{key}.json"
        with suppress(OSError, UnreadableError, TypeError):
            kept = read_json(file)
            return None if kept is None else FocalEstimate(**kept)
        K, (_, width) = drives[0].intrinsics(drives[0].indices[0]), drives[0].frame_size
        center = (K[0, 2] + 0.5) / width, (K[1, 2] + 0.5) / width
        found = estimate_focal(drive_windows(drives, _WINDOWS), center=center)
        write_json(file, None if found is None else asdict(found), FramesCacheError, indent=None)
        return found

    def _usable_drive(self, clip: Clip, shown: Progress) -> ClipDrive | None:
        """Return a clip as a drive; None if it cannot be read and unreadable files are skipped."""
        try:
            return self._drive(clip, shown)
        except DataError as error:
            if self.on_error != "skip" or isinstance(error, FramesCacheError):
                raise
            warnings.warn(f"clip left out: {error}", stacklevel=2)
            self._broken.append(str(error))
            return None

    def _drive(self, clip: Clip, shown: Progress) -> ClipDrive:
        task = shown.add_task(f"decoding {clip.path.name}", total=None, visible=clip.path.is_file())
        recording = read_clip(
            clip,
            self.fps,
            self.frames_cache,
            self.max_width,
            lambda done, total: shown.update(task, completed=done, total=total),
        )
        shown.update(task, visible=False)
        if recording.plain:
            warnings.warn(
                f"{recording.plain} frames of {clip.path} have one single color; they may not have been decoded: "
                "check the video",
                stacklevel=2,
            )
        if self.fps is not None and recording.fps is None:
            warnings.warn(
                f"the frame rate of {clip.path} is unknown, so data.fps has no effect and all frames are used; give "
                f"fps in {FILE_NAME}",
                stacklevel=2,
            )
        motion = None
        if self.static == "drop" or self.parallax > 0 or self.align_speeds:
            task = shown.add_task(f"measuring motion of {clip.path.name}", total=len(recording.paths))
            motion = measure(
                recording.paths,
                self.crop or clip.camera.crop,
                exact=self.parallax > 0,
                skip_unreadable=self.on_error == "skip",
                cache=self.frames_cache,
                advance=lambda count: shown.advance(task, count),
            )
            shown.update(task, visible=False)
        settings = f"fps={self.fps} parallax={self.parallax} static={self.static}"
        dropping = motion if self.static == "drop" or self.parallax > 0 else None
        drive = ClipDrive(clip, recording, self.crop, dropping, self.parallax, settings, self._height)
        if self.align_speeds and motion is not None:
            found = drive.align_speeds(motion.flow)
            if self._place()[0] == 0:
                print(found, file=sys.stderr)
        elif self.odometer is not None:
            drive.check_speeds()
        return drive
