"""The one reader of videos, for training data and prediction alike: frames in order, as RGB bytes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np
from jaxtyping import UInt8

from saunet.errors import DataError

VIDEO_SUFFIXES = frozenset({".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".wmv", ".ts"})
"""File name endings that are taken for videos."""


class VideoReader:
    """Frames of a video file or a camera, as RGB bytes, in order.

    Args:
        source: A video file, or the number of a camera.

    Attributes:
        fps: Frames a second; 25 where the file does not say.
        declared: Number of frames that the file claims to hold; None for a camera or where it does not say.

    Raises:
        DataError: if it does not exist, is no video that can be read, or holds no frame.
    """

    def __init__(self, source: str | Path | int) -> None:
        self.name = f"camera {source}" if isinstance(source, int) else str(source)
        if not isinstance(source, int):
            path = Path(source)
            if not path.is_file():
                raise DataError(f"no video at {path}; check the path")
            if path.stat().st_size == 0:
                raise DataError(f"{path} is empty (0 bytes); copy it again")
        self._capture = cv2.VideoCapture(source if isinstance(source, int) else str(source))
        opened = self._capture.isOpened()
        done, frame = self._capture.read() if opened else (False, None)
        if not done or frame is None:
            self._capture.release()
            raise DataError(self._why(isinstance(source, int), opened))
        self._first: UInt8[np.ndarray, "h w 3"] | None = frame
        self.height, self.width = frame.shape[:2]
        fps = self._capture.get(cv2.CAP_PROP_FPS)
        self.fps = float(fps) if 0 < fps < 1000 else 25.0
        count = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        self.declared = count if count > 0 and not isinstance(source, int) else None

    def _why(self, camera: bool, opened: bool) -> str:
        if camera:
            return f"{self.name} gives no picture; check that it is connected and that no other program uses it"
        if opened:
            return f"{self.name} holds no frame that can be decoded; it may be truncated or have an unusual codec"
        return f"{self.name} is not a video that can be read, or is truncated; copy it again or convert it to mp4"

    def __iter__(self) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        while self._first is not None:
            yield cv2.cvtColor(self._first, cv2.COLOR_BGR2RGB)
            done, frame = self._capture.read()
            self._first = frame if done else None

    def close(self) -> None:
        """Release the file or camera."""
        self._capture.release()
        self._first = None

    def __enter__(self) -> VideoReader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
