"""Video in, side-by-side depth video out, one frame at a time: memory does not grow, and colours do not flicker."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from saunet.atomic import replacing
from saunet.checks import ConfigError, DataError, in_range, one_of, positive
from saunet.infer.colour import PALETTES, colourise, value_range
from saunet.infer.panel import fit, label
from saunet.infer.pipeline import ImagePredictor
from saunet.infer.progress import bar

LAYOUTS: tuple[str, ...] = ("auto", "stacked", "beside")
"""Depth below the image, beside it, or whichever comes nearer to a screen's shape."""
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


class VideoWriter:
    """Writes RGB frames to an mp4 file that gets its name only when it is complete and plays back every frame.

    Use it as a context manager; leaving it by an error discards the file.

    Args:
        path: The file to write, ending in ``.mp4``.
        fps: Frames a second.

    Raises:
        ConfigError: for another ending or a frame rate that is not positive.
        DataError: if the system refuses to write, or the written file does not play back (a full disk).
    """

    def __init__(self, path: str | Path, fps: float | int) -> None:
        self.path = Path(path)
        one_of(f"the suffix of {self.path.name}", self.path.suffix.lower(), [".mp4"])
        self.fps = positive("fps", fps)
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
        """
        if self._writer is None:
            self._size = (frame.shape[0], frame.shape[1])
            even = (self._size[1] + self._size[1] % 2, self._size[0] + self._size[0] % 2)
            self._writer = cv2.VideoWriter(str(self._temporary), cv2.VideoWriter.fourcc(*"mp4v"), self.fps, even)
            if not self._writer.isOpened():
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


class RunningRange:
    """Colour limits that follow a clip slowly: an exponential mean of each frame's range.

    Args:
        memory: Weight of the past in [0, 1); 0 takes each frame's own range.
    """

    def __init__(self, memory: float = 0.95) -> None:
        self.memory = in_range("memory", memory, 0.0, 0.999999)
        self._limits: tuple[float, float] | None = None

    def update(self, values: Float[np.ndarray, "h w"]) -> tuple[float, float]:
        """Return the limits after seeing one more frame; the first frame sets them."""
        low, high = value_range(values)
        if self._limits is not None:
            low = self.memory * self._limits[0] + (1 - self.memory) * low
            high = self.memory * self._limits[1] + (1 - self.memory) * high
        self._limits = (low, high)
        return self._limits


@dataclass(frozen=True, slots=True)
class VideoSummary:
    """What `render_video` did."""

    path: Path
    frames: int
    missing: int
    """Frames that the source claimed to hold and did not give: a truncated file."""


def render_video(
    predictor: ImagePredictor,
    source: str | Path | int | Iterable[UInt8[np.ndarray, "_ _ 3"]],
    output: str | Path,
    *,
    fps: float | int | None = None,
    layout: str = "auto",
    palette: str = "magma",
    memory: float = 0.95,
    max_frames: int | None = None,
    labels: bool = True,
    progress: bool = True,
) -> VideoSummary:
    """Write a video of image and disparity, with colours that are stable over the clip.

    One frame is in memory at a time, so a source may be of any length. Ctrl-C ends a camera's video cleanly; else it
    discards the unfinished file.

    Args:
        predictor: The model.
        source: A video file, a camera's number, or RGB frames.
        output: The mp4 file to write; never the source.
        fps: Frames a second; the source's by default, 10 for frames.
        layout: ``"stacked"`` (disparity below), ``"beside"``, or ``"auto"``.
        palette: Colour map.
        memory: Weight of the past in the running colour range; see `RunningRange`.
        max_frames: Stop after so many frames.
        labels: Name the two pictures.
        progress: Show a progress bar on a terminal.

    Raises:
        ConfigError: for an unknown layout or palette, or an output that is the source.
        DataError: if the source cannot be read or the system refuses to write.
    """
    one_of("layout", layout, LAYOUTS)
    one_of("palette", palette, PALETTES)
    limits = RunningRange(memory)
    name = f"disparity ({'1/metre' if predictor.scale else 'relative'})" if labels else None
    camera = isinstance(source, int)
    if isinstance(source, str | Path) and Path(source).resolve() == Path(output).resolve():
        raise ConfigError(f"the output {output} is the source; choose another name")
    reader = VideoReader(source) if isinstance(source, str | Path | int) else None
    frames: Iterable[UInt8[np.ndarray, "_ _ 3"]] = reader if reader is not None else source  # type: ignore[assignment]
    rate = fps if fps is not None else reader.fps if reader is not None else 10.0
    total = max_frames if max_frames is not None else reader.declared if reader is not None else None
    try:
        with VideoWriter(output, rate) as writer, bar(progress) as shown:
            task = shown.add_task("rendering", total=total)
            try:
                for frame in itertools.islice(frames, max_frames):
                    result = predictor.predict(frame)
                    painted = colourise(result.disparity, limits.update(result.disparity), palette)
                    writer.write(compose(frame, painted, layout, name))
                    shown.advance(task)
            except KeyboardInterrupt:
                if not camera or writer.count == 0:
                    raise
    finally:
        if reader is not None:
            reader.close()
    declared = reader.declared if reader is not None and max_frames is None else None
    return VideoSummary(Path(output), writer.count, max(0, (declared or 0) - writer.count))


def compose(
    image: UInt8[np.ndarray, "h w 3"],
    painted: UInt8[np.ndarray, "_ _ 3"],
    layout: str = "auto",
    name: str | None = None,
) -> UInt8[np.ndarray, "_ _ 3"]:
    """Return one frame of a side-by-side video.

    Args:
        image: RGB.
        painted: The disparity in colours.
        layout: ``"stacked"``, ``"beside"``, or ``"auto"``, which stacks pictures wider than 4:3.
        name: What the painted half shows; None draws no names.
    """
    height, width = image.shape[:2]
    halves = [image, fit(painted, height, width)]
    if name is not None:
        halves = [np.concatenate([label(t, width), h]) for t, h in zip(("input", name), halves, strict=True)]
    stacked = layout == "stacked" or (layout == "auto" and width * 3 > height * 4)
    return np.concatenate(halves, axis=0 if stacked else 1)
