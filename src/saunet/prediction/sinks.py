"""What predictions go into: files an image, a video, a page, a trajectory, and the one pass that fills all of them."""

from __future__ import annotations

import abc
import contextlib
import dataclasses
import itertools
import json
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
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
from saunet.io.plain import read_json
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
"""What can be written for each image: disparity in colors, depth as 16-bit PNG (x 256) or float32 array, points; image
and depth as a pair to train on, which Ultralytics and ``data=pairs`` read."""
LAYOUTS: tuple[str, ...] = ("auto", "stacked", "beside")
"""Depth below the image, beside it, or whichever comes nearer to a screen's shape."""
MANIFEST = "predictions.json"
"""Written into the output folder: which model and settings its files come from."""


@dataclass(frozen=True, slots=True)
class Style:
    """How results are drawn and written."""

    colormap: str = "magma"
    limits: tuple[float, float] | None = None
    camera: Camera | None = None
    max_depth: float | int | None = None


@dataclass(frozen=True, slots=True)
class ClipInfo:
    """What an output of a whole recording is made for."""

    stem: str
    """How the names of its files begin, with their folder: ``out/drive_``."""
    title: str
    """Of the recording."""
    fps: float
    """Frames per second of results."""
    timed: bool
    """Whether frames have times of their own."""
    style: Style
    retimed: bool = False
    """Whether results run at a rate of their own all the same."""
    layout: str = "auto"
    codec: str = "h264"
    odometer: Odometer | None = None
    """What follows the camera, where a trajectory is asked for too."""


class Manifest:
    """What an output folder says its files come from."""

    def __init__(self, folder: Path, predictor: ImagePredictor, style: Style, overwrite: bool) -> None:
        self.path = folder / MANIFEST
        self.settings: dict[str, object] = {
            "model": predictor.fingerprint,
            "unit": predictor.unit,
            "undistorted": predictor.undistorted_by,
            **dataclasses.asdict(dataclasses.replace(style, camera=None)),
            "camera": style.camera.K.tolist() if style.camera else None,
        }
        self.clips: dict[str, Any] = {}
        """How results of whole recordings were made, by the names of their files."""
        self.written = False
        if overwrite or not self.path.exists():
            return
        try:
            previous = read_json(self.path)
        except (OSError, ValueError) as reason:
            raise DataError(
                f"{self.path} cannot be read ({reason}); delete it, or choose another output folder"
            ) from reason
        current = json.loads(json.dumps(self.settings))
        changed = [key for key in current if not isinstance(previous, dict) or previous.get(key) != current[key]]
        if changed:
            told = ["model or scale" if key == "model" else key for key in changed]
            raise ConfigError(
                f"{folder} holds predictions made with another {', '.join(told)}; "
                "choose another output folder, or set overwrite=true"
            )
        clips = previous.get("clips")
        self.written, self.clips = True, clips if isinstance(clips, dict) else {}

    def write(self, clips: Mapping[str, Any] | None = None) -> None:
        """Write it, with further results of whole recordings."""
        self.clips.update(clips or {})
        write_json(self.path, {**self.settings, **({"clips": self.clips} if self.clips else {})})
        self.written = True


def output_paths(output: str, folder: Path, stem: str) -> tuple[Path, ...]:
    """Return the files of one of `OUTPUTS` of an image."""
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
        assert style.camera is not None  # the options have asked for it
        point_cloud(result, style.camera, max_depth=style.max_depth).save(paths[0])
    return paths


def write_pairs_camera(folder: Path, camera: Camera, fps: float | None) -> None:
    """Write the ``camera.yaml`` of pairs, so that training on them knows K."""
    from saunet.data.video.camera import FILE_NAME, CameraFile, write_camera

    path, size = folder / FILE_NAME, (camera.height, camera.width)
    write_camera(
        path, CameraFile(path, camera.K.astype(np.float64), size, fps=fps), "of the images and depth maps here"
    )


class Sink(Session, abc.ABC):
    """Takes predictions in order; leaving it by an error discards what is not complete."""

    paths: tuple[Path, ...]
    """What it writes, or the folder that it writes into."""

    @abc.abstractmethod
    def add(self, frame: Frame, result: Prediction, limits: tuple[float, float]) -> None:
        """Take one more frame, and the color limits of the clip so far."""


class ImageFilesSink(Sink):
    """Files of each image beside each other, each in its own colors; those that are finished stay."""

    def __init__(self, folder: Path, outputs: Sequence[str], style: Style, manifest: Manifest, overwrite: bool) -> None:
        self.paths, self.outputs, self.written = (folder,), tuple(outputs), list[Path]()
        self._style, self._manifest, self._overwrite = style, manifest, overwrite

    def wanted(self, frame: Frame) -> Sequence[str]:
        """Return the outputs that are not there yet, or of another version of their image.

        Files appear only when complete, and have the time stamp of their image: whatever a clock does, a changed image
        has another one.
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
            if not self._manifest.written:  # only now: a run that writes nothing leaves nothing
                self._manifest.write()


def _made_from(path: Path, changed: float | None) -> bool:
    return changed is None or abs(path.stat().st_mtime - changed) < 1e-4  # file systems round


class FrameFilesSink(Sink):
    """Files of each frame of a video in a folder of their own (``000000_depth.png``), in the colors of the clip.

    Frames that an earlier clip left in the folder are removed first: they would be taken for this one's.
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
    """A page to orbit the points and scrub through the clip; see `ViewerWriter`."""

    def __init__(self, path: Path, camera: Camera, fps: float, max_depth: float | int | None, title: str) -> None:
        self._writer = ViewerWriter(path, camera, fps=fps, max_depth=max_depth, title=title)
        self.paths = (path,)

    def session(self) -> Iterator[None]:
        with self._writer:
            yield

    def add(self, frame: Frame, result: Prediction, limits: tuple[float, float]) -> None:
        self._writer.add(result)


class TrajectorySink(Sink):
    """The camera's path: drawn from above, as KITTI poses (``.txt``), and where times are known in TUM's format."""

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
    """Points to orbit; nothing for a recording without a frame, whose camera is unknown."""
    path, style = Path(f"{clip.stem}points.html"), clip.style
    return None if style.camera is None else ViewerSink(path, style.camera, clip.fps, style.max_depth, clip.title)


@clip_outputs.register("trajectory")
def _trajectory(clip: ClipInfo) -> Sink:
    """The camera's path."""
    assert clip.odometer is not None  # it is asked for
    return TrajectorySink(Path(f"{clip.stem}trajectory.png"), clip.odometer, clip.timed, clip.style.camera)


@clip_outputs.register("rrd")
def _rerun(clip: ClipInfo) -> Sink:
    """All of it for Rerun's viewer."""
    from saunet.prediction.rerun import RerunSink

    return RerunSink(Path(f"{clip.stem}rerun.rrd"), clip.style.camera, clip.style.max_depth, clip.odometer)


def compose(
    image: UInt8[np.ndarray, "h w 3"], painted: UInt8[np.ndarray, "_ _ 3"], layout: str = "auto", name: str = ""
) -> UInt8[np.ndarray, "_ _ 3"]:
    """Return one frame of a side-by-side video, with names above the halves if one is given."""
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
    """Predict every frame into every sink, with a few pictures in memory; return how many.

    A thread writes one batch while the network has the next one; what a ``live`` camera shows is written at once. A
    picture that cannot be read becomes one sentence in ``failures`` if that is given, and is an error else; ``check``
    has the last word before sinks are completed. Ctrl-C completes what a live camera has given so far.
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
        writer = stack.enter_context(ThreadPoolExecutor(1))  # ends before the sinks do
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
    """Note the first Ctrl-C of the block instead of raising, and stop the camera; a second one raises as ever.

    Raised in the middle of writing a frame, it would leave nobody knowing whether the frame is in the file. Where
    Ctrl-C is ignored or another program handles it, and outside of the main thread, everything stays as it is.
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
