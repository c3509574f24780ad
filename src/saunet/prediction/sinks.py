"""What a clip's predictions go into, one frame at a time: a video, files a frame, a page, a trajectory."""

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
from saunet.io.colormaps import COLORMAPS, colorize
from saunet.io.video import VideoWriter
from saunet.prediction.files import ENDINGS, Style, write_output
from saunet.prediction.panel import fit, label
from saunet.prediction.pointcloud import Camera
from saunet.prediction.prediction import Prediction
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
    def add(self, result: Prediction, limits: tuple[float, float]) -> None:
        """Take one more frame, and the color limits of the clip so far."""

    def __enter__(self) -> Sink:
        return self

    @abc.abstractmethod
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Complete or discard."""


class VideoSink(Sink):
    """A side-by-side video; see `saunet.prediction.video.render_video`.

    Args:
        path: The mp4 to write.
        fps: Frames per second.
        layout: How image and disparity are arranged, one of ``LAYOUTS``.
        colormap: Colors of the disparity, one of ``COLORMAPS``.
        labels: Write what is shown into the picture.
        codec: One of `saunet.io.video.CODECS`.

    Raises:
        ConfigError: for a layout, colormap or codec that does not exist.
    """

    def __init__(
        self,
        path: Path,
        fps: float | int,
        layout: str = "auto",
        colormap: str = "magma",
        labels: bool = True,
        codec: str = "h264",
    ) -> None:
        self._layout = one_of("layout", layout, LAYOUTS)
        self._colormap = one_of("colormap", colormap, COLORMAPS)
        self._writer, self._labels, self.paths = VideoWriter(path, fps, codec), labels, (path,)

    def __enter__(self) -> VideoSink:
        self._writer.__enter__()
        return self

    def add(self, result: Prediction, limits: tuple[float, float]) -> None:
        """Append a frame."""
        name = f"disparity ({'1/meter' if result.metric else 'relative'})" if self._labels else None
        painted = colorize(result.disparity, limits, self._colormap)
        self._writer.write(compose(result.image, painted, self._layout, name))

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.__exit__(kind, error, trace)


class FrameSink(Sink):
    """Files a frame, ``000000_depth.png`` and so on, in a folder of their own; each is complete once it is there.

    Frames that an earlier clip left in the folder are removed first: they would be taken for this one's.

    Args:
        folder: Where the files go.
        outputs: What is written of each frame, keys of ``ENDINGS``.
        style: Colors and limits of pictures.
        camera: Intrinsics, for point clouds.
    """

    def __init__(
        self, folder: Path, outputs: Sequence[str], style: Style, camera: Camera | Sequence[float | int] | None = None
    ) -> None:
        self._outputs, self._style, self._camera = tuple(outputs), style, camera
        self._count, self.paths = 0, (folder,)

    def __enter__(self) -> FrameSink:
        for path in self.paths[0].glob("[0-9][0-9][0-9][0-9][0-9][0-9]_*"):
            if path.name[6:] in ENDINGS.values():
                path.unlink()
        return self

    def add(self, result: Prediction, limits: tuple[float, float]) -> None:
        """Write the frame's files."""
        if self._camera is not None and not isinstance(self._camera, Camera):
            self._camera = Camera.from_numbers(self._camera, *result.depth.shape)
        style = dataclasses.replace(self._style, limits=limits, camera=self._camera)
        for output in self._outputs:
            write_output(output, self.paths[0] / f"{self._count:06d}", result, style)
        self._count += 1

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Every file is complete already, and stays."""


class ViewerSink(Sink):
    """A page to orbit the points and scrub through the clip; see `ViewerWriter`.

    Args:
        path: The HTML file to write.
        camera: Intrinsics, see `saunet.prediction.pointcloud`.
        fps: Frames per second.
        max_depth: Points further away are left out, in the unit of the depth; None keeps all.
        title: Title of the page.
    """

    def __init__(
        self,
        path: Path,
        camera: Camera | Sequence[float | int],
        fps: float | int,
        max_depth: float | int | None,
        title: str,
    ) -> None:
        self._writer = ViewerWriter(path, camera, fps=fps, max_depth=max_depth, title=title)
        self.paths = (path,)

    def __enter__(self) -> ViewerSink:
        self._writer.__enter__()
        return self

    def add(self, result: Prediction, limits: tuple[float, float]) -> None:
        """Append a frame."""
        self._writer.add(result)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.__exit__(kind, error, trace)


class TrajectorySink(Sink):
    """The camera's path, drawn from above and as KITTI poses.

    Args:
        path: The picture to write; the poses go beside it as ``.txt``.
        odometer: Follows the camera from frame to frame.
    """

    def __init__(self, path: Path, odometer: Odometer) -> None:
        self._odometer, self.paths = odometer, (path, path.with_suffix(".txt"))

    def add(self, result: Prediction, limits: tuple[float, float]) -> None:
        """Follow the camera to the next frame."""
        self._odometer.add(result.image)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            from saunet.prediction.trajectory import write_trajectory

            write_trajectory(self.paths[0], self._odometer.trajectory(), self._odometer.scale is not None)


def compose(
    image: UInt8[np.ndarray, "h w 3"],
    painted: UInt8[np.ndarray, "_ _ 3"],
    layout: str = "auto",
    name: str | None = None,
) -> UInt8[np.ndarray, "_ _ 3"]:
    """Return one frame of a side-by-side video.

    Args:
        image: RGB.
        painted: The disparity in colors.
        layout: ``"stacked"``, ``"beside"``, or ``"auto"``, which stacks pictures wider than 4:3.
        name: What the painted half shows; None draws no names.
    """
    height, width = image.shape[:2]
    halves = [image, fit(painted, height, width)]
    if name is not None:
        halves = [np.concatenate([label(t, width), h]) for t, h in zip(("input", name), halves, strict=True)]
    stacked = layout == "stacked" or (layout == "auto" and width * 3 > height * 4)
    return np.concatenate(halves, axis=0 if stacked else 1)
