"""Clips of frames, one in memory at a time: from a video, a camera or images."""

from __future__ import annotations

import glob
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from saunet.io.images import IMAGE_SUFFIXES, read_image
from saunet.io.video import CameraReader, VideoReader
from saunet.prediction.sources import find_sources, image_paths

IMAGE_FPS = 10.0
"""Frames a second of images, KITTI's rate; files do not say."""


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
Clip = VideoReader | CameraReader | ImageClip | ArrayClip


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
        return CameraReader(source)
    if isinstance(source, str | Path):
        path = Path(source)
        images = path.is_dir() or path.suffix.lower() in IMAGE_SUFFIXES or glob.has_magic(str(source))
        return ImageClip(source, output_dir) if images else VideoReader(source)
    return ArrayClip(source)
