"""Side-by-side depth videos, one frame at a time: memory does not grow, and colours do not flicker."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from saunet.checks import ConfigError, in_range, one_of
from saunet.infer.clips import VIDEO_SUFFIXES, Source, VideoReader, VideoWriter, open_clip
from saunet.infer.colour import PALETTES, colourise, value_range
from saunet.infer.panel import fit, label
from saunet.infer.pipeline import ImagePredictor
from saunet.infer.progress import bar

__all__ = [
    "LAYOUTS",
    "VIDEO_SUFFIXES",
    "RunningRange",
    "VideoReader",
    "VideoSummary",
    "VideoWriter",
    "compose",
    "render_video",
]

LAYOUTS: tuple[str, ...] = ("auto", "stacked", "beside")
"""Depth below the image, beside it, or whichever comes nearer to a screen's shape."""


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
    source: Source,
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
        source: A video file, a folder or pattern of images, a camera's number, or RGB frames.
        output: The mp4 file to write; never the source.
        fps: Frames a second; the source's by default, 10 for images.
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
    clip = open_clip(source)
    try:
        with VideoWriter(output, fps if fps is not None else clip.fps) as writer, bar(progress) as shown:
            task = shown.add_task("rendering", total=max_frames or clip.declared)
            try:
                for frame in itertools.islice(clip, max_frames):
                    result = predictor.predict(frame)
                    painted = colourise(result.disparity, limits.update(result.disparity), palette)
                    writer.write(compose(frame, painted, layout, name))
                    shown.advance(task)
            except KeyboardInterrupt:
                if not camera or writer.count == 0:
                    raise
    finally:
        clip.close()
    declared = clip.declared if clip.declared is not None and max_frames is None else 0
    return VideoSummary(Path(output), writer.count, max(0, declared - writer.count))


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
