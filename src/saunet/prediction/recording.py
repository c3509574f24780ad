"""Images predicted once, into files of their own and into what is made of them as a clip; the whole is resumable."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from saunet.errors import DataError
from saunet.io.atomic import write_json
from saunet.io.colormaps import RunningRange
from saunet.io.plain import read_json
from saunet.prediction.clips import IMAGE_FPS
from saunet.prediction.files import (
    MANIFEST,
    OUTPUTS,
    Style,
    Summary,
    check_claim,
    first_size,
    predict_files,
    settings_of,
)
from saunet.prediction.pipeline import ImagePredictor
from saunet.prediction.pointcloud import Camera
from saunet.prediction.prediction import Prediction
from saunet.prediction.sinks import Sink
from saunet.prediction.sources import Source, find_sources
from saunet.prediction.video import check_outputs, clip_sinks, refuse_existing, title_of

if TYPE_CHECKING:
    from saunet.prediction.odometer import Odometer


@dataclass(frozen=True, slots=True)
class RecordingSummary:
    """What `predict_recording` did."""

    images: Summary
    """The files of single images."""
    frames: int
    """Images that the clip's results are made of."""
    paths: tuple[Path, ...]
    """The clip's results written now."""
    skipped: tuple[Path, ...]
    """The clip's results that were finished before."""


def predict_recording(
    predictor: ImagePredictor,
    source: str | Path,
    output_dir: str | Path,
    outputs: Sequence[str],
    *,
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
) -> RecordingSummary:
    """Predict images in one pass into files, as `predict_files`, and into a clip's results, as `predict_clip` does.

    What is finished and newer than its images is skipped, so an interrupted run goes on where it stopped; a clip's
    results start anew, as they are whole or not there.

    Args:
        predictor: The model.
        source: A folder or pattern of images, or an image.
        output_dir: Where results go; made if missing.
        outputs: Any of `saunet.prediction.files.OUTPUTS` and `saunet.prediction.video.CLIP_OUTPUTS`.
        fps: Frames a second; 10 by default.
        layout: Of the video: ``"stacked"``, ``"beside"``, or ``"auto"``.
        colormap: Color map.
        memory: Weight of the past in the clip's running color range; see `RunningRange`.
        codec: How the video is encoded, one of `saunet.io.video.CODECS`.
        camera: True intrinsics, which ``"ply"`` and ``"html"`` need; see `predict_clip`.
        max_depth: Leave points out that are farther, in the unit of depth.
        odometer: What ``"trajectory"`` needs.
        batch_size: Images that go through the network together.
        max_frames: Take the first so many images; all by default.
        overwrite: Replace results that are already there, whoever made them.
        progress: Show a progress bar on a terminal.

    Raises:
        ConfigError: for what `predict_files` and `predict_clip` refuse, or a clip's results that are there and are not
            known to be made of these images in this way.
        DataError: if there is no image, one of a clip cannot be read, or the system refuses to write.
    """
    check_outputs(outputs, colormap, batch_size, max_frames, camera, odometer)
    folder, sources = Path(output_dir), find_sources(source, output_dir)[:max_frames]
    if camera is not None and not isinstance(camera, Camera):
        camera = Camera.from_numbers(camera, *first_size(sources))
    rate = IMAGE_FPS if fps is None else fps
    sinks = clip_sinks(
        folder, title_of(source), outputs, rate, layout=layout, colormap=colormap, codec=codec, camera=camera,
        max_depth=max_depth, odometer=odometer,
    )  # fmt: skip
    limits = RunningRange(memory)
    settings = settings_of(predictor, Style(colormap, None, camera, max_depth))
    known = _clips(folder) if check_claim(folder, settings, overwrite) else {}
    look = {"fps": float(rate), "layout": layout, "memory": float(memory), "codec": codec}
    ours = [sink for sink in sinks if not overwrite and _made_like(known.get(sink.paths[0].name), look)]
    refuse_existing([sink for sink in sinks if sink not in ours], overwrite)
    skipped = [sink for sink in ours if _finished(sink, known[sink.paths[0].name], sources)]
    todo = [sink for sink in sinks if sink not in skipped]

    def feed(result: Prediction) -> None:
        now = limits.update(result.disparity)
        for sink in todo:
            sink.add(result, now)

    files = [output for output in dict.fromkeys(outputs) if output in OUTPUTS]
    summary = Summary((), 0)
    with contextlib.ExitStack() as stack:
        for sink in todo:
            stack.enter_context(sink)
        if files or todo:
            summary = predict_files(
                predictor, source, folder, files, colormap=colormap, camera=camera, max_depth=max_depth,
                batch_size=batch_size, max_frames=max_frames, overwrite=overwrite, progress=progress,
                each=feed if todo else None,
            )  # fmt: skip
        if summary.failures and todo:
            names = ", ".join(path.name for sink in todo for path in sink.paths)
            raise DataError(f"{summary.failures[0]}; {names} would lack it, so nothing but single images was written")
    if todo:
        made = {sink.paths[0].name: {"images": len(sources), **look} for sink in todo}
        write_json(folder / MANIFEST, {**settings, "clips": {**known, **made}})
    written, before = (tuple(path for sink in group for path in sink.paths) for group in (todo, skipped))
    return RecordingSummary(summary, len(sources), written, before)


def _clips(folder: Path) -> dict[str, Any]:
    """Return how the clips' results in a folder were made, by the names of their files."""
    found = read_json(folder / MANIFEST).get("clips")
    return found if isinstance(found, dict) else {}


def _made_like(made: Any, look: dict[str, Any]) -> bool:
    return isinstance(made, dict) and all(made.get(key) == value for key, value in look.items())


def _finished(sink: Sink, made: dict[str, Any], sources: Sequence[Source]) -> bool:
    if made.get("images") != len(sources) or not all(path.is_file() for path in sink.paths):
        return False
    newest = max(source.path.stat().st_mtime for source in sources)
    return all(path.stat().st_mtime >= newest for path in sink.paths)
