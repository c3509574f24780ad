"""comma2k19 (Schafer et al., 2018): 33 hours of highway from a phone behind the windshield, with poses and speed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Unpack

from saunet.data.drive import Drive
from saunet.data.loading.options import Loading
from saunet.data.sets.base import FilesDrive, report_missing, transform
from saunet.data.sets.files import RecordingsDataModule
from saunet.data.video.camera import CameraFile
from saunet.data.video.clips import Clip, default_cache, read_clip
from saunet.errors import DataError, positive
from saunet.io.plain import read_array
from saunet.io.progress import bar
from saunet.io.video import VideoReader
from saunet.registry import datamodules

SIZE, FPS = (874, 1164), 20.0  # (height, width); frames per second
K = np.array([[910.0, 0, (1164 - 1) / 2], [0, 910, (874 - 1) / 2], [0, 0, 1]])
"""Its center 582, 437 is counted from the corner of the first pixel."""
_AXES = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""Our camera axes (right, down, forward) to the phone's (forward, right, down)."""
_FIX = "unpack the chunk again"


class CommaDrive(FilesDrive):
    """One minute of a route; its frames are the used frames of the video, in order."""

    numbers: tuple[int, ...] = ()  # of the frames in the video
    speeds: NDArray[np.float64] | None = None
    rate = FPS

    @property
    def fps(self) -> float:
        return FPS

    @property
    def numbering(self) -> str:
        return f"fps={self.rate}"

    def recorded(self, index: int) -> int:
        return self.numbers[index]

    def speed(self, index: int) -> float | None:
        return None if self.speeds is None else float(self.speeds[index])


@datamodules.register("comma2k19")
class CommaDataModule(RecordingsDataModule):
    """comma2k19: real highway video with the camera's true motion and the car's speed, without depth.

    Videos are decoded once into a cache.

    Args:
        root: Folder of the chunks, routes or segments (``video.hevc`` beside ``global_pose``).
        fps: Frames per second to use; the video has 20.
        val_drives: Segments to validate on, by name below the root or by pattern.
        test_drives: Segments to test and predict; by default the held-out frames.
        val_share: Fraction to hold out if none are named: whole segments if there are ten or more, else their ends.
        frames_cache: Folder for decoded videos; by default in the user's cache folder.
        max_width: Frames are kept at most this wide.
        **loading: Loader settings, as in `LoadOptions`.

    Raises:
        ConfigError: if a parameter is out of range.
    """

    protocol = "campus"
    ground_truth = "none"

    def __init__(
        self,
        *,
        root: str = "data/comma2k19",
        fps: float = 10.0,
        val_drives: Sequence[str] = (),
        test_drives: Sequence[str] = (),
        val_share: float = 0.1,
        frames_cache: str | None = None,
        max_width: int = 1164,
        with_pose: bool = False,
        cache: str | None = None,
        **loading: Unpack[Loading],
    ) -> None:
        super().__init__(with_pose=with_pose, cache=cache, **loading)
        self.root, self.fps = root, float(positive("fps", fps))
        self.frames_cache = default_cache() if frames_cache is None else Path(frames_cache).expanduser()
        self.max_width = int(positive("max_width", max_width))
        self.hold_out(val_drives, test_drives, val_share)

    def prepare_data(self) -> None:
        """Decode videos in one process, before the others read them."""
        len(self.recordings)

    def find(self) -> Sequence[Drive]:
        root = Path(self.root).expanduser().absolute()
        videos = sorted(path for level in range(5) for path in root.glob("*/" * level + "video.hevc"))
        if not videos:
            raise DataError(f"no video.hevc at {root} or up to four levels below; unpack the chunks of comma2k19 there")
        lacking = [path.parent for path in videos if not (path.parent / "global_pose" / "frame_positions").is_file()]
        report_missing(lacking if self.with_pose or self.odometer else [], len(videos), "global_pose folders", _FIX)
        found = list[CommaDrive]()
        said = VideoReader(videos[0], FPS).fps or FPS  # bare streams may state a wrong rate
        with bar(self._place()[0] == 0) as shown:
            task = shown.add_task("decoding segments", total=len(videos))
            for path in videos:
                found.append(read_segment(path, root, self.fps, said, self.frames_cache, self.max_width))
                shown.advance(task)
        return found


def read_segment(video: Path, root: Path, fps: float, said: float, cache: Path, max_width: int) -> CommaDrive:
    """Return a minute of a route, whose video states ``said`` frames per second."""
    folder, name = video.parent, video.parent.relative_to(root).as_posix()
    camera = CameraFile(Path("comma2k19's camera"), K, SIZE, fps=FPS)
    recording = read_clip(Clip(name, video, camera), fps * said / FPS, cache, max_width)
    arrays = {
        key: read_array(path).reshape(-1, width).astype(np.float64)
        for key, width in (("times", 1), ("positions", 3), ("orientations", 4))
        if (path := folder / "global_pose" / f"frame_{key}").is_file()
    }
    short = [key for key, rows in arrays.items() if len(rows) <= max(recording.numbers)]
    if short:
        count = len(arrays[short[0]])
        raise DataError(
            f"{folder}/global_pose/frame_{short[0]} has {count} rows, fewer than {video} has frames; {_FIX}"
        )
    times, poses = dict[int, float](), dict[int, NDArray[np.float64]]()
    for index, number in enumerate(recording.numbers):
        times[index] = float(arrays["times"][number, 0]) if "times" in arrays else number / FPS
        if {"positions", "orientations"} <= arrays.keys():
            # despite the data set's description, the quaternion (w first) turns the phone's axes into the earth's
            pair = arrays["orientations"][number].tolist(), arrays["positions"][number].tolist()
            poses[index] = transform(*pair, "wxyz", f"{folder}/global_pose, frame {number}") @ _AXES
    origin = np.linalg.inv(poses[0]) if poses else np.eye(4)  # the center of the earth is too far for single precision
    drive = CommaDrive(
        name if name != "." else folder.name,
        dict(enumerate(recording.paths)),
        K,
        camera.path,
        SIZE,
        times=times,
        poses={index: origin @ pose for index, pose in poses.items()},
        folder=folder,
    )
    drive.numbers, drive.rate = recording.numbers, fps
    log = folder / "processed_log" / "CAN" / "speed"
    if (log / "t").is_file() and (log / "value").is_file():
        stamps, values = read_array(log / "t").ravel(), read_array(log / "value").ravel()
        drive.speeds = np.interp([times[index] for index in sorted(times)], stamps, values)
    return drive
