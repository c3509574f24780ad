"""Outputs of predictions: files per image, a video, a page, a trajectory, and the one pass that fills them all."""

from __future__ import annotations

import abc
import contextlib
import dataclasses
import itertools
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import UInt8

from saunet.errors import ConfigError, DataError, one_of
from saunet.io.atomic import Session, write_json
from saunet.io.colormaps import RunningRange, colorize, depth_to_png16
from saunet.io.images import write_image
from saunet.io.live import CameraReader
from saunet.io.plain import different_settings, read_json
from saunet.io.progress import bar
from saunet.io.video import VideoWriter
from saunet.prediction.panel import fit, label
from saunet.prediction.pointcloud import Camera, ViewerWriter, point_cloud
from saunet.prediction.prediction import ImagePredictor, Prediction
from saunet.prediction.sources import Frame
from saunet.registry import outputs as clip_outputs

if TYPE_CHECKING:
    from saunet.prediction.odometer import Odometer

ENDINGS = {"color": "_disparity.png", "png16": "_depth.png", "npy": "_depth.npy", "ply": "_points.ply"}
OUTPUTS: tuple[str, ...] = (*ENDINGS, "pairs")
"""Outputs per image: disparity in colors, depth as 16-bit PNG (x 256) or float32 array, points; image and depth as a
pair to train on, for Ultralytics and ``data=pairs``."""
LAYOUTS: tuple[str, ...] = ("auto", "stacked", "beside")
"""Depth below the image, beside it, or whichever is closer to a screen's shape."""
MANIFEST = "predictions.json"
"""File in the output folder that records the model and settings of its results."""


@dataclass(frozen=True, slots=True)
class Style:
    """Settings for drawing and writing results."""

    colormap: str = "magma"
    limits: tuple[float, float] | None = None
    camera: Camera | None = None
    max_depth: float | int | None = None


@dataclass(frozen=True, slots=True)
class ClipInfo:
    """The recording and settings that an output is made for."""

    stem: str
    """Folder and beginning of its file names: ``out/drive_``."""
    title: str
    """Title of the recording."""
    fps: float
    """Frames per second of results."""
    timed: bool
    """Whether frames have their own times."""
    style: Style
    retimed: bool = False
    """Whether results nevertheless run at a fixed rate."""
    layout: str = "auto"
    codec: str = "h264"
    odometer: Odometer | None = None
    """The odometer, if a trajectory is requested too."""


class Manifest:
    """The record of an output folder: the model and settings of its files.

    Args:
        folder: The output folder; its files must have been made the same way, unless ``overwrite`` is set.
        predictor: The model.
        style: How results look.
        overwrite: Ignore an earlier record.
        unknown: Settings that are not known yet, which are not compared.
    """

    def __init__(
        self, folder: Path, predictor: ImagePredictor, style: Style, overwrite: bool, unknown: Set[str] = frozenset()
    ) -> None:
        self.path = folder / MANIFEST
        self.settings: dict[str, object] = {
            "model": predictor.fingerprint,
            "unit": predictor.unit,
            "undistorted": predictor.undistorted_by,
            **dataclasses.asdict(dataclasses.replace(style, camera=None)),
            "camera": style.camera.K.tolist() if style.camera else None,
        }
        self.clips: dict[str, Any] = {}
        """Settings of results of whole recordings, by the names of their files."""
        self.written = False
        if overwrite or not self.path.exists():
            return
        try:
            previous = read_json(self.path)
        except (OSError, ValueError) as reason:
            raise DataError(
                f"{self.path} cannot be read ({reason}); delete it, or choose another output folder"
            ) from reason
        known = {key: value for key, value in self.settings.items() if key not in unknown}
        if different := different_settings(previous, known, {"model": "model or scale", "undistorted": "undistort"}):
            raise ConfigError(
                f"{folder} holds predictions made with {different}; choose another output folder, or set overwrite=true"
            )
        clips = previous.get("clips")
        self.written, self.clips = True, clips if isinstance(clips, dict) else {}

    def write(self, clips: Mapping[str, Any] | None = None) -> None:
        """Write the record, with further results of whole recordings."""
        self.clips.update(clips or {})
        write_json(self.path, {**self.settings, **({"clips": self.clips} if self.clips else {})})
        self.written = True


def output_paths(output: str, folder: Path, stem: str) -> tuple[Path, ...]:
    """Return an image's files for one of `OUTPUTS`."""
    if output == "pairs":
        return folder / "images" / f"{stem}.png", folder / "depth" / f"{stem}.npy"
    return (folder / f"{stem}{ENDINGS[output]}",)


def write_output(output: str, folder: Path, stem: str, result: Prediction, style: Style) -> tuple[Path, ...]:
    """Write one of `OUTPUTS` of a prediction, each file whole or not at all, and return their paths."""
    paths = output_paths(output, folder, stem)
    if output == "color":
        write_image(paths[0], result.color(style.limits, style.colormap))
    elif output == "png16":
        write_image(paths[0], depth_to_png16(result.depth))
    elif output == "npy":
        result.save(paths[0])
    elif output == "pairs":
        write_image(paths[0], result.image)
        result.save(paths[1])
    else:
        assert style.camera is not None  # the options require it
        point_cloud(result, style.camera, max_depth=style.max_depth).save(paths[0])
    return paths


def write_pairs_camera(folder: Path, camera: Camera, fps: float | None) -> None:
    """Write the ``camera.yaml`` of pairs, so that training on them knows K."""
    from saunet.data.video.calibrations import FILE_NAME
    from saunet.data.video.camera import CameraFile, write_camera

    path, size = folder / FILE_NAME, (camera.height, camera.width)
    write_camera(
        path, CameraFile(path, camera.K.astype(np.float64), size, fps=fps), "of the images and depth maps here"
    )


class Sink(Session, abc.ABC):
    """Takes predictions in order; an error discards incomplete files."""

    paths: tuple[Path, ...]
    """The files it writes, or their folder."""

    @abc.abstractmethod
    def add(self, frame: Frame, result: Prediction, limits: tuple[float, float]) -> None:
        """Add one more frame, with the color limits of the clip so far."""


class ImageFilesSink(Sink):
    """Files of each image side by side, each in its own colors; finished ones are kept."""

    def __init__(self, folder: Path, outputs: Sequence[str], style: Style, manifest: Manifest, overwrite: bool) -> None:
        self.paths, self.outputs, self.written = (folder,), tuple(outputs), list[Path]()
        self._style, self._manifest, self._overwrite = style, manifest, overwrite

    def wanted(self, frame: Frame) -> Sequence[str]:
        """Return the outputs that are missing, or belong to another version of their image.

        Files appear only when complete, and get the time stamp of their image: a changed image has another stamp,
        whatever the clock does.
        """
        if self._overwrite:
            return self.outputs
        changed = frame.image.stat().st_mtime if frame.image.exists() else None
        paths = {output: output_paths(output, self.paths[0], frame.stem) for output in self.outputs}
        return [
            output
            for output, files in paths.items()
            if not all(path.is_file() and _made_from(path, changed) for path in files)
        ]

    def add(self, frame: Frame, result: Prediction, limits: tuple[float, float]) -> None:
        for output in self.wanted(frame):
            paths = write_output(output, self.paths[0], frame.stem, result, self._style)
            self.written += paths
            if frame.image.exists():
                changed = frame.image.stat()
                for path in paths:
                    os.utime(path, ns=(changed.st_atime_ns, changed.st_mtime_ns))
            if not self._manifest.written:  # only now, so that a run that writes nothing leaves nothing
                self._manifest.write()


def _made_from(path: Path, changed: float | None) -> bool:
    return changed is None or abs(path.stat().st_mtime - changed) < 1e-4  # file systems round


class FrameFilesSink(Sink):
    """Files of each frame of a video in one folder (``000000_depth.png``), in the colors of the clip.

    Frames of an earlier clip in the folder are removed first, because they would be mistaken for this clip's.
    """

    def __init__(self, folder: Path, outputs: Sequence[str], style: Style) -> None:
        self._outputs, self._style, self.paths = tuple(outputs), style, (folder,)

    def session(self) -> Iterator[None]:
        for path in self.paths[0].glob("[0-9][0-9][0-9][0-9][0-9][0-9]_*"):
            if path.name[6:] in ENDINGS.values():
                path.unlink()
        for kind, ending in (("images", "png"), ("depth", "npy")):
            for path in self.paths[0].glob(f"{kind}/[0-9][0-9][0-9][0-9][0-9][0-9].{ending}"):
                path.unlink()
        yield

    def add(self, frame: Frame, result: Prediction, limits: tuple[float, float]) -> None:
        style = dataclasses.replace(self._style, limits=limits)
        for output in self._outputs:
            write_output(output, self.paths[0], Path(frame.stem).name, result, style)


class VideoSink(Sink):
    """A side-by-side video that keeps the times of its frames."""

    def __init__(self, path: Path, fps: float, layout: str, colormap: str, codec: str, timed: bool) -> None:
        self._layout, self._colormap, self._timed = one_of("layout", layout, LAYOUTS), colormap, timed
        self._writer, self.paths, self._start = VideoWriter(path, fps, codec), (path,), 0.0

    def session(self) -> Iterator[None]:
        with self._writer:
            yield

    def add(self, frame: Frame, result: Prediction, limits: tuple[float, float]) -> None:
        name = f"disparity ({'1/meter' if result.metric else 'relative'})"
        painted = colorize(result.disparity, limits, self._colormap)
        time = frame.time if self._timed else None
        if self._writer.count == 0:
            self._start = time or 0.0
        picture = compose(result.image, painted, self._layout, name)
        self._writer.write(picture, None if time is None else time - self._start)


class ViewerSink(Sink):
    """A page for orbiting the points and scrubbing through the clip; see `ViewerWriter`."""

    def __init__(self, path: Path, camera: Camera, fps: float, max_depth: float | int | None, title: str) -> None:
        self._writer = ViewerWriter(path, camera, fps=fps, max_depth=max_depth, title=title)
        self.paths = (path,)

    def session(self) -> Iterator[None]:
        with self._writer:
            yield

    def add(self, frame: Frame, result: Prediction, limits: tuple[float, float]) -> None:
        self._writer.add(result)


class TrajectorySink(Sink):
    """The camera's path: drawn from above, as KITTI poses (``.txt``) and, if times are known, in TUM's format."""

    def __init__(self, path: Path, odometer: Odometer, timed: bool, camera: Camera | None = None) -> None:
        self._odometer, self._times, self._camera = odometer, list[float](), camera
        self.paths = (path, path.with_suffix(".txt"), *((path.with_suffix(".tum"),) if timed else ()))

    def add(self, frame: Frame, result: Prediction, limits: tuple[float, float]) -> None:
        camera = self._camera and self._camera.resized(*result.image.shape[:2])
        self._odometer.add(result.image, None if camera is None else camera.K)
        if frame.time is not None:
            self._times.append(frame.time)

    def session(self) -> Iterator[None]:
        from saunet.io.trajectories import write_tum
        from saunet.prediction.odometer import write_trajectory

        yield
        poses = self._odometer.trajectory()
        write_trajectory(self.paths[0], poses, self._odometer.scale is not None)
        for path in self.paths[2:]:
            write_tum(path, poses, np.array(self._times))


# Outputs of whole recordings, in the order in which they are filled: the odometer moves with the trajectory.


@clip_outputs.register("mp4")
def _video(clip: ClipInfo) -> Sink:
    """Image and disparity."""
    path, timed = Path(f"{clip.stem}disparity.mp4"), clip.timed and not clip.retimed
    return VideoSink(path, clip.fps, clip.layout, clip.style.colormap, clip.codec, timed)


@clip_outputs.register("html")
def _viewer(clip: ClipInfo) -> Sink | None:
    """Points to orbit; nothing for a recording without frames, because its camera is unknown."""
    path, style = Path(f"{clip.stem}points.html"), clip.style
    return None if style.camera is None else ViewerSink(path, style.camera, clip.fps, style.max_depth, clip.title)


@clip_outputs.register("trajectory")
def _trajectory(clip: ClipInfo) -> Sink:
    """The camera's path."""
    assert clip.odometer is not None  # it is asked for
    return TrajectorySink(Path(f"{clip.stem}trajectory.png"), clip.odometer, clip.timed, clip.style.camera)


@clip_outputs.register("rrd")
def _rerun(clip: ClipInfo) -> Sink:
    """Everything for Rerun's viewer."""
    from saunet.prediction.rerun import RerunSink

    return RerunSink(Path(f"{clip.stem}rerun.rrd"), clip.style.camera, clip.style.max_depth, clip.odometer)


def compose(
    image: UInt8[np.ndarray, "h w 3"], painted: UInt8[np.ndarray, "_ _ 3"], layout: str = "auto", name: str = ""
) -> UInt8[np.ndarray, "_ _ 3"]:
    """Return one frame of a side-by-side video, with names above the halves if given."""
    height, width = image.shape[:2]
    halves = [image, fit(painted, height, width)]
    if name:
        halves = [np.concatenate([label(t, width), h]) for t, h in zip(("input", name), halves, strict=True)]
    stacked = layout == "stacked" or (layout == "auto" and width * 3 > height * 4)
    return np.concatenate(halves, axis=0 if stacked else 1)


def fill(
    predictor: ImagePredictor,
    frames: Iterable[Frame],
    sinks: Sequence[Sink],
    range_smoothing: float | int,
    batch_size: int,
    total: int | None,
    *,
    live: CameraReader | None = None,
    failures: list[str] | None = None,
    check: Callable[[], None] = lambda: None,
) -> int:
    """Predict every frame into every sink, holding only a few pictures in memory; return the number of frames.

    A thread writes one batch while the network computes the next; frames of a ``live`` camera are written at once. A
    picture that cannot be read becomes one sentence in ``failures`` if that is given, and an error otherwise; ``check``
    runs before sinks are completed. With a live camera, Ctrl-C completes the results so far.
    """
    count, left, limits = 0, iter(frames), RunningRange(range_smoothing)

    def write(batch: Sequence[Frame], results: Sequence[Prediction]) -> None:
        for frame, result in zip(batch, results, strict=True):
            now = limits.update(result.disparity)
            for sink in sinks:
                sink.add(frame, result, now)

    with contextlib.ExitStack() as stack:
        stopped = stack.enter_context(_interrupt_noted(live))
        for sink in sinks:
            stack.enter_context(sink)
        writer = stack.enter_context(ThreadPoolExecutor(1))  # ends before the sinks
        writing: Future[None] | None = None
        shown = stack.enter_context(bar())
        task = shown.add_task("predicting", total=total)
        try:
            while not stopped() and (batch := list(itertools.islice(left, batch_size))):
                pictures, kept = [], []
                for frame in batch:
                    try:
                        pictures.append(frame.read())
                        kept.append(frame)
                    except DataError as error:
                        if failures is None:
                            raise
                        failures.append(str(error))
                results = predictor.predict_batch(pictures)
                if writing is not None:
                    writing.result()
                if live is None:
                    writing = writer.submit(write, kept, results)
                else:
                    write(kept, results)
                    for at in (frame.arrived for frame in kept if frame.arrived is not None):
                        shown.update(task, description=f"predicting, {live.answered(at)}")
                count += len(kept)
                shown.advance(task, len(batch))
            if stopped() and count == 0:
                raise KeyboardInterrupt
        except KeyboardInterrupt:
            if live is None or stopped() or count == 0:
                raise
        if writing is not None:
            writing.result()
        check()
    return count


@contextlib.contextmanager
def _interrupt_noted(live: CameraReader | None) -> Iterator[Callable[[], bool]]:
    """On the first Ctrl-C in the block, stop the camera instead of raising; a second one raises as usual.

    Raised while a frame is being written, it would be unknown whether the frame is in the file. If Ctrl-C is ignored or
    handled elsewhere, and outside the main thread, nothing changes.
    """
    noted, usual = threading.Event(), signal.default_int_handler
    main = threading.current_thread() is threading.main_thread()
    if live is None or not main or signal.getsignal(signal.SIGINT) is not usual:
        yield noted.is_set
        return

    def note(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGINT, usual)
        noted.set()
        live.stop()

    signal.signal(signal.SIGINT, note)
    try:
        yield noted.is_set
    finally:
        signal.signal(signal.SIGINT, usual)
