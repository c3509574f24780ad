"""What predictions go into, one frame at a time: files a frame, a video, a page, a trajectory."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import UInt8

from saunet.errors import one_of
from saunet.io.colormaps import colorize
from saunet.io.video import VideoWriter
from saunet.prediction.files import ENDINGS, Manifest, Style, unfinished, write_output
from saunet.prediction.panel import fit, label
from saunet.prediction.pointcloud import Camera
from saunet.prediction.prediction import Prediction
from saunet.prediction.sources import Frame
from saunet.prediction.viewer import ViewerWriter

if TYPE_CHECKING:
    from saunet.prediction.odometer import Odometer

LAYOUTS: tuple[str, ...] = ("auto", "stacked", "beside")
"""Depth below the image, beside it, or whichever comes nearer to a screen's shape."""


class Sink(abc.ABC):
    """Takes predictions in order; leaving it by an error discards what is not complete."""

    paths: tuple[Path, ...]
    """What it writes, or the folder that it writes into."""

    @abc.abstractmethod
    def add(self, frame: Frame, result: Prediction, limits: tuple[float, float]) -> None:
        """Take one more frame, and the color limits of the clip so far."""

    def __enter__(self) -> Sink:
        return self

    @abc.abstractmethod
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Complete or discard."""


class ImageFilesSink(Sink):
    """Files of each image beside each other, each in its own colors; those that are finished stay."""

    def __init__(self, folder: Path, outputs: Sequence[str], style: Style, manifest: Manifest, overwrite: bool) -> None:
        self.paths, self.outputs, self.written = (folder,), tuple(outputs), list[Path]()
        self._style, self._manifest, self._overwrite = style, manifest, overwrite

    def wanted(self, frame: Frame) -> Sequence[str]:
        """Return the outputs of a frame that have to be written."""
        return self.outputs if self._overwrite else unfinished(frame, self.paths[0], self.outputs)

    def add(self, frame: Frame, result: Prediction, limits: tuple[float, float]) -> None:
        """Write what is not finished."""
        for output in self.wanted(frame):
            self.written.append(write_output(output, self.paths[0] / frame.stem, result, self._style))
            self._manifest.claim()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Every file is complete already, and stays."""


class FrameFilesSink(Sink):
    """Files of each frame of a video in a folder of their own (``000000_depth.png``), in the colors of the clip.

    Frames that an earlier clip left in the folder are removed first: they would be taken for this one's.
    """

    def __init__(self, folder: Path, outputs: Sequence[str], style: Style) -> None:
        self._outputs, self._style, self.paths = tuple(outputs), style, (folder,)

    def __enter__(self) -> FrameFilesSink:
        for path in self.paths[0].glob("[0-9][0-9][0-9][0-9][0-9][0-9]_*"):
            if path.name[6:] in ENDINGS.values():
                path.unlink()
        return self

    def add(self, frame: Frame, result: Prediction, limits: tuple[float, float]) -> None:
        """Write the frame's files."""
        style = dataclasses.replace(self._style, limits=limits)
        for output in self._outputs:
            write_output(output, self.paths[0] / Path(frame.stem).name, result, style)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Every file is complete already, and stays."""


class VideoSink(Sink):
    """A side-by-side video that keeps the times of its frames."""

    def __init__(self, path: Path, fps: float, layout: str, colormap: str, codec: str, timed: bool) -> None:
        self._layout, self._colormap, self._timed = one_of("layout", layout, LAYOUTS), colormap, timed
        self._writer, self.paths = VideoWriter(path, fps, codec), (path,)

    def __enter__(self) -> VideoSink:
        self._writer.__enter__()
        return self

    def add(self, frame: Frame, result: Prediction, limits: tuple[float, float]) -> None:
        """Append a frame."""
        name = f"disparity ({'1/meter' if result.metric else 'relative'})"
        painted = colorize(result.disparity, limits, self._colormap)
        self._writer.write(compose(result.image, painted, self._layout, name), frame.time if self._timed else None)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.__exit__(kind, error, trace)


class ViewerSink(Sink):
    """A page to orbit the points and scrub through the clip; see `ViewerWriter`."""

    def __init__(self, path: Path, camera: Camera, fps: float, max_depth: float | int | None, title: str) -> None:
        self._writer = ViewerWriter(path, camera, fps=fps, max_depth=max_depth, title=title)
        self.paths = (path,)

    def __enter__(self) -> ViewerSink:
        self._writer.__enter__()
        return self

    def add(self, frame: Frame, result: Prediction, limits: tuple[float, float]) -> None:
        """Append a frame."""
        self._writer.add(result)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.__exit__(kind, error, trace)


class TrajectorySink(Sink):
    """The camera's path: drawn from above, as KITTI poses (``.txt``), and where times are known in TUM's format."""

    def __init__(self, path: Path, odometer: Odometer, timed: bool) -> None:
        self._odometer, self._times = odometer, list[float]()
        self.paths = (path, path.with_suffix(".txt"), *((path.with_suffix(".tum"),) if timed else ()))

    def add(self, frame: Frame, result: Prediction, limits: tuple[float, float]) -> None:
        """Follow the camera to the next frame."""
        self._odometer.add(result.image)
        if frame.time is not None:
            self._times.append(frame.time)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            from saunet.io.trajectories import write_tum
            from saunet.prediction.trajectory import write_trajectory

            poses = self._odometer.trajectory()
            write_trajectory(self.paths[0], poses, self._odometer.scale is not None)
            for path in self.paths[2:]:
                write_tum(path, poses, np.array(self._times))


def compose(
    image: UInt8[np.ndarray, "h w 3"],
    painted: UInt8[np.ndarray, "_ _ 3"],
    layout: str = "auto",
    name: str | None = None,
) -> UInt8[np.ndarray, "_ _ 3"]:
    """Return one frame of a side-by-side video."""
    height, width = image.shape[:2]
    halves = [image, fit(painted, height, width)]
    if name is not None:
        halves = [np.concatenate([label(t, width), h]) for t, h in zip(("input", name), halves, strict=True)]
    stacked = layout == "stacked" or (layout == "auto" and width * 3 > height * 4)
    return np.concatenate(halves, axis=0 if stacked else 1)
