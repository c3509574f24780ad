"""Clips of frames, one in memory at a time: from a video, a camera or images; and whole, verified mp4 files."""

from __future__ import annotations

import glob
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np
from jaxtyping import UInt8

from saunet.errors import ConfigError, DataError, one_of, positive
from saunet.io.atomic import replacing
from saunet.io.images import IMAGE_SUFFIXES, read_image
from saunet.io.video import VideoReader
from saunet.prediction.sources import find_sources, image_paths

CODECS: tuple[str, ...] = ("mp4v", "vp09")
"""``mp4v`` (MPEG-4) is quick and plays in players such as VLC; ``vp09`` (VP9) plays in browsers, and is slower."""

IMAGE_FPS = 10.0
"""Frames a second of images, KITTI's rate; files do not say."""


class VideoWriter:
    """Writes RGB frames to an mp4 file that gets its name only when it is complete and plays back every frame.

    Use it as a context manager; leaving it by an error discards the file.

    Args:
        path: The file to write, ending in ``.mp4``.
        fps: Frames a second.
        codec: One of `CODECS`.

    Raises:
        ConfigError: for another ending, codec, or a frame rate that is not positive.
        DataError: if the system refuses to write, or the written file does not play back (a full disk).
    """

    def __init__(self, path: str | Path, fps: float | int, codec: str = "mp4v") -> None:
        self.path = Path(path)
        one_of(f"the suffix of {self.path.name}", self.path.suffix.lower(), [".mp4"])
        self.fps, self.codec = positive("fps", fps), one_of("codec", codec, CODECS)
        self.count = 0
        self._writer: cv2.VideoWriter | None = None
        self._size = (0, 0)
        self._replacing = replacing(self.path)

    def __enter__(self) -> VideoWriter:
        self._temporary = self._replacing.__enter__()
        return self

    def write(self, frame: UInt8[np.ndarray, "_ _ 3"]) -> None:
        """Append a frame; all have the size of the first, made even, since the codec needs that.

        Raises:
            DataError: if a frame has another size, or the file cannot be opened.
            ConfigError: if this OpenCV lacks the codec.
        """
        if self._writer is None:
            self._size = (frame.shape[0], frame.shape[1])
            even = (self._size[1] + self._size[1] % 2, self._size[0] + self._size[0] % 2)
            self._writer = cv2.VideoWriter(str(self._temporary), cv2.VideoWriter.fourcc(*self.codec), self.fps, even)
            if not self._writer.isOpened():
                self._temporary.touch()  # where it is the system that refuses, this says why
                if self.codec != "mp4v":
                    raise ConfigError(
                        f"codec is {self.codec}, with which this OpenCV cannot write {self.path}; set codec=mp4v"
                    )
                raise DataError(f"cannot write {self.path}; check the folder, its rights and its space")
        if frame.shape[:2] != self._size:
            raise DataError(
                f"frame {self.count} is {frame.shape[:2]} (height, width), the ones before it are {self._size}"
            )
        pad = ((0, self._size[0] % 2), (0, self._size[1] % 2), (0, 0))
        self._writer.write(cv2.cvtColor(np.pad(frame, pad, mode="edge"), cv2.COLOR_RGB2BGR))
        self.count += 1

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._writer is not None:
            self._writer.release()
        if kind is None:
            try:
                self._check()
            except DataError as problem:
                self._replacing.__exit__(DataError, problem, problem.__traceback__)
                raise
        self._replacing.__exit__(kind, error, trace)

    def _check(self) -> None:
        if self.count == 0:
            raise DataError(f"no frame was given, so {self.path} was not written")
        capture = cv2.VideoCapture(str(self._temporary))
        kept = int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) if capture.isOpened() else 0
        capture.release()
        if kept != self.count:
            raise DataError(f"{self.path} kept {kept} of {self.count} frames, so it was discarded; is the disk full?")


class ImageClip:
    """Image files as a clip, read one at a time; the counterpart of `VideoReader` for frames that are files.

    Args:
        source: A folder, a pattern such as ``frames/*.png``, or an image.
        output_dir: Where results go, if anywhere; what lies there already is no part of the clip.

    Attributes:
        fps: `IMAGE_FPS`.
        declared: Number of images.

    Raises:
        DataError: if there is no image.
        ConfigError: if the output folder holds the originals.
    """

    def __init__(self, source: str | Path, output_dir: str | Path | None = None) -> None:
        self._paths = image_paths(source) if output_dir is None else [s.path for s in find_sources(source, output_dir)]
        self.name, self.fps, self.declared = str(source), IMAGE_FPS, len(self._paths)

    def __iter__(self) -> Iterator[UInt8[np.ndarray, "_ _ 3"]]:
        return map(read_image, self._paths)

    def close(self) -> None:
        """Nothing is held open."""


class ArrayClip:
    """RGB arrays as a clip; they may come from a generator.

    Args:
        frames: RGB images.

    Attributes:
        fps: 10; arrays do not say.
        declared: None: the number is not known beforehand.
    """

    def __init__(self, frames: Iterable[UInt8[np.ndarray, "_ _ 3"]]) -> None:
        self._frames = frames
        self.name, self.fps, self.declared = "frames", 10.0, None

    def __iter__(self) -> Iterator[UInt8[np.ndarray, "_ _ 3"]]:
        return iter(self._frames)

    def close(self) -> None:
        """Nothing is held open."""


Source = str | Path | int | Iterable[UInt8[np.ndarray, "_ _ 3"]]
"""A video file, a folder or pattern of images, a camera's number, or RGB frames."""
Clip = VideoReader | ImageClip | ArrayClip


def open_clip(source: Source, output_dir: str | Path | None = None) -> Clip:
    """Open what frames come from.

    Args:
        source: Where frames come from.
        output_dir: Where results go, if anywhere; images that lie there already are no part of the clip.

    Raises:
        DataError: if it does not exist or holds no frame.
        ConfigError: if the output folder holds the originals.
    """
    if isinstance(source, int):
        return VideoReader(source)
    if isinstance(source, str | Path):
        path = Path(source)
        images = path.is_dir() or path.suffix.lower() in IMAGE_SUFFIXES or glob.has_magic(str(source))
        return ImageClip(source, output_dir) if images else VideoReader(source)
    return ArrayClip(source)
