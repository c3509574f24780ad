"""Clips in, results out, one pass and a few frames at a time: memory does not grow, and colors do not flicker."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from saunet.errors import ConfigError, one_of, positive
from saunet.io.colormaps import COLORMAPS, RunningRange
from saunet.io.progress import bar
from saunet.prediction.clips import Clip, Source, open_clip
from saunet.prediction.files import OUTPUTS, Style
from saunet.prediction.interrupt import interrupt_noted
from saunet.prediction.pipeline import ImagePredictor
from saunet.prediction.pointcloud import Camera
from saunet.prediction.sinks import LAYOUTS, FrameSink, Sink, TrajectorySink, VideoSink, ViewerSink

if TYPE_CHECKING:
    from saunet.prediction.odometer import Odometer

CLIP_OUTPUTS: tuple[str, ...] = ("mp4", "html", "trajectory")
"""What can be written for a clip as a whole, besides `saunet.prediction.files.OUTPUTS` for each of its frames."""

_NAMES = {"mp4": "_disparity.mp4", "html": "_points.html", "trajectory": "_trajectory.png"}


@dataclass(frozen=True, slots=True)
class VideoSummary:
    """What `render_video` did."""

    path: Path
    frames: int
    missing: int
    """Frames that the source claimed to hold and did not give: a truncated file."""


@dataclass(frozen=True, slots=True)
class ClipSummary:
    """What `predict_clip` did."""

    paths: tuple[Path, ...]
    """The files written; for files a frame, the folder."""
    frames: int
    missing: int
    """Frames that the source claimed to hold and did not give: a truncated file."""


def render_video(
    predictor: ImagePredictor,
    source: Source,
    output: str | Path,
    *,
    fps: float | int | None = None,
    layout: str = "auto",
    colormap: str = "magma",
    memory: float = 0.95,
    codec: str = "h264",
    max_frames: int | None = None,
    labels: bool = True,
    progress: bool = True,
) -> VideoSummary:
    """Write a video of image and disparity, with colors that are stable over the clip.

    One frame is in memory at a time, so a source may be of any length. Ctrl-C ends a camera's video cleanly; a second
    one, or one with another source, discards the unfinished file.

    Args:
        predictor: The model.
        source: A video file, a folder or pattern of images, a camera's number, or RGB frames.
        output: The mp4 file to write; never the source.
        fps: Frames a second; the source's by default, 10 for images.
        layout: ``"stacked"`` (disparity below), ``"beside"``, or ``"auto"``.
        colormap: Color map.
        memory: Weight of the past in the running color range; see `RunningRange`.
        codec: How the video is encoded, one of `saunet.io.video.CODECS`; ``"vp09"`` plays in browsers.
        max_frames: Stop after so many frames.
        labels: Name the two pictures.
        progress: Show a progress bar on a terminal.

    Raises:
        ConfigError: for an unknown layout, colormap or codec, or an output that is the source.
        DataError: if the source cannot be read or the system refuses to write.
    """
    one_of("layout", layout, LAYOUTS)
    one_of("colormap", colormap, COLORMAPS)
    limits = RunningRange(memory)
    if isinstance(source, str | Path) and Path(source).resolve() == Path(output).resolve():
        raise ConfigError(f"the output {output} is the source; choose another name")
    if max_frames is not None:
        positive("max_frames", max_frames)
    clip = open_clip(source)
    with contextlib.closing(clip):
        sink = VideoSink(Path(output), fps if fps is not None else clip.fps, layout, colormap, labels, codec)
        camera = isinstance(source, int)
        frames = _run(predictor, clip, [sink], limits, 1, max_frames, progress, finish=camera)
    return VideoSummary(Path(output), frames, _missing(clip, frames, max_frames))


def predict_clip(
    predictor: ImagePredictor,
    source: Source,
    output_dir: str | Path,
    outputs: Sequence[str] = ("mp4",),
    *,
    name: str | None = None,
    fps: float | int | None = None,
    layout: str = "auto",
    colormap: str = "magma",
    memory: float = 0.95,
    codec: str = "h264",
    camera: Camera | Sequence[float | int] | None = None,
    max_depth: float | int | None = None,
    odometer: Odometer | None = None,
    batch_size: int = 1,
    max_frames: int | None = None,
    overwrite: bool = False,
    progress: bool = True,
) -> ClipSummary:
    """Predict a clip once and write any of its results, with colors that are stable over the clip.

    A batch of frames is in memory at a time. Ctrl-C ends a camera's results cleanly after the batch at hand; a second
    one, or one with another source, discards those that are not complete, and files of single frames stay.

    Args:
        predictor: The model.
        source: A video file, a folder or pattern of images, a camera's number, or RGB frames.
        output_dir: Where results go; made if missing.
        outputs: ``"mp4"`` (image and disparity), ``"html"`` (points to orbit, clip to scrub through), ``"trajectory"``
            (from above, and as KITTI poses), and any of `saunet.prediction.files.OUTPUTS` for each frame.
        name: What results are called; after the source by default.
        fps: Frames a second; the source's by default, 10 for images.
        layout: Of the video: ``"stacked"``, ``"beside"``, or ``"auto"``.
        colormap: Color map.
        memory: Weight of the past in the running color range; see `RunningRange`.
        codec: How the video is encoded, one of `saunet.io.video.CODECS`; ``"vp09"`` plays in browsers.
        camera: True intrinsics, which ``"ply"`` and ``"html"`` need: a `Camera`, or numbers as `Camera.from_numbers`
            takes them, in pixels of the first frame.
        max_depth: Leave points out that are farther, in the unit of depth.
        odometer: What ``"trajectory"`` needs.
        batch_size: Frames that go through the network together.
        max_frames: Stop after so many frames.
        overwrite: Replace results that are already there.
        progress: Show a progress bar on a terminal.

    Raises:
        ConfigError: for an unknown word, points without a camera, a trajectory without pose network, or results that
            are already there.
        DataError: if the source cannot be read or the system refuses to write.
    """
    check_outputs(outputs, colormap, batch_size, max_frames, camera, odometer)
    title = name or title_of(source)
    limits = RunningRange(memory)
    clip = open_clip(source, output_dir)
    with contextlib.closing(clip):
        rate = fps if fps is not None else clip.fps
        folder = Path(output_dir)
        sinks = clip_sinks(
            folder, title, outputs, rate, layout=layout, colormap=colormap, codec=codec, camera=camera,
            max_depth=max_depth, odometer=odometer,
        )  # fmt: skip
        frame_outputs = [output for output in dict.fromkeys(outputs) if output in OUTPUTS]
        if frame_outputs:
            sinks.append(FrameSink(folder / title, frame_outputs, Style(colormap, max_depth=max_depth), camera))
        refuse_existing(sinks, overwrite)
        finish = isinstance(source, int)
        frames = _run(predictor, clip, sinks, limits, batch_size, max_frames, progress, finish=finish)
    return ClipSummary(tuple(path for sink in sinks for path in sink.paths), frames, _missing(clip, frames, max_frames))


def check_outputs(
    outputs: Sequence[str],
    colormap: str,
    batch_size: int,
    max_frames: int | None,
    camera: Camera | Sequence[float | int] | None,
    odometer: Odometer | None,
) -> None:
    """Check what can be checked before anything is read; see `predict_clip` for the arguments.

    Raises:
        ConfigError: for a word or number that is not allowed, or an output that lacks what it needs.
    """
    for output in outputs:
        one_of("outputs", output, (*OUTPUTS, *CLIP_OUTPUTS))
    if not outputs:
        raise ConfigError(f"outputs is empty; allowed: {', '.join((*OUTPUTS, *CLIP_OUTPUTS))}")
    one_of("colormap", colormap, COLORMAPS)
    positive("batch_size", batch_size)
    if max_frames is not None:
        positive("max_frames", max_frames)
    for output in outputs:
        if output in ("ply", "html") and camera is None:
            raise ConfigError(
                f"outputs has '{output}', which needs the camera's true intrinsics; give camera fx, fy, cx, cy, "
                "or one number, the horizontal field of view in degrees"
            )
    if "trajectory" in outputs and odometer is None:
        raise ConfigError("outputs has 'trajectory', which needs a model with a pose network")


def clip_sinks(
    folder: Path,
    title: str,
    outputs: Sequence[str],
    fps: float | int,
    *,
    layout: str,
    colormap: str,
    codec: str,
    camera: Camera | Sequence[float | int] | None,
    max_depth: float | int | None,
    odometer: Odometer | None,
) -> list[Sink]:
    """Return what takes the outputs that are made of a clip as a whole; arguments as in `predict_clip`."""
    sinks, paths = list[Sink](), {output: folder / f"{title}{_NAMES[output]}" for output in CLIP_OUTPUTS}
    if "mp4" in outputs:
        sinks.append(VideoSink(paths["mp4"], fps, layout, colormap, codec=codec))
    if "html" in outputs and camera is not None:
        sinks.append(ViewerSink(paths["html"], camera, fps, max_depth, title))
    if "trajectory" in outputs and odometer is not None:
        sinks.append(TrajectorySink(paths["trajectory"], odometer))
    return sinks


def refuse_existing(sinks: Sequence[Sink], overwrite: bool) -> None:
    """Check that no sink would replace a file, or fill a folder that holds some, unless it is told to.

    Raises:
        ConfigError: if one would.
    """
    for path in (path for sink in sinks for path in sink.paths):
        if path.exists() and not overwrite and not (path.is_dir() and not any(path.iterdir())):
            raise ConfigError(f"{path} exists; choose another output folder, or set overwrite=true")


def _run(
    predictor: ImagePredictor,
    clip: Clip,
    sinks: Sequence[Sink],
    limits: RunningRange,
    batch_size: int,
    max_frames: int | None,
    progress: bool,
    *,
    finish: bool,
) -> int:
    """Predict every frame into every sink; with ``finish``, Ctrl-C ends the clip instead of discarding results."""
    count = 0
    with contextlib.ExitStack() as stack:
        stopped = stack.enter_context(interrupt_noted(finish))
        for sink in sinks:
            stack.enter_context(sink)
        shown = stack.enter_context(bar(progress))
        task = shown.add_task("rendering", total=max_frames or clip.declared)
        frames = itertools.islice(clip, max_frames)
        try:
            while not stopped() and (batch := list(itertools.islice(frames, batch_size))):
                for result in predictor.predict_batch(batch):
                    now = limits.update(result.disparity)
                    for sink in sinks:
                        sink.add(result, now)
                    count += 1
                shown.advance(task, len(batch))
            if stopped() and count == 0:
                raise KeyboardInterrupt
        except KeyboardInterrupt:
            if not finish or stopped() or count == 0:
                raise
    return count


def _missing(clip: Clip, frames: int, max_frames: int | None) -> int:
    declared = clip.declared if clip.declared is not None and max_frames is None else 0
    return max(0, declared - frames)


def title_of(source: Source) -> str:
    """Return what to call a source's results."""
    if isinstance(source, int):
        return f"camera{source}"
    if not isinstance(source, str | Path):
        return "frames"
    path = Path(source)
    if "*" in path.name or "?" in path.name or "[" in path.name:
        path = path.parent
    return path.resolve().name if path.is_dir() else path.stem or "frames"
