"""Metric scale for prediction, measured on the input's own frames according to `ScaleOptions`, and reported."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from saunet.errors import ConfigError
from saunet.io.live import live_source
from saunet.prediction.pointcloud import Camera
from saunet.prediction.prediction import ImagePredictor
from saunet.prediction.sources import Input, Recording
from saunet.scale.options import ScaleOptions

if TYPE_CHECKING:
    from saunet.io.speeds import SpeedTable
    from saunet.types import TrainBatch

_ALIGNED = 3000
"""Number of frames, evenly spread, to compare with a table of speeds."""


def apply_scale(
    options: ScaleOptions,
    predictor: ImagePredictor,
    source: Input,
    camera: Camera | None,
    folder: Path,
    checkpoint: str | Path,
    camera_height: float | None = None,
    store_in: Path | None = None,
) -> None:
    """Set a predictor's scale according to the options; print and record the measurement.

    The camera's height in its file applies unless the options give one. ``store_in`` is the file of the model that
    keeps the factor.
    """
    if options.measures:
        import torch

        from saunet.scale.estimate import estimate_scale, keep_scale
        from saunet.weights.files import read_model

        def depth(image: Any) -> Any:
            return 1 / torch.from_numpy(predictor.disparity(image.numpy()))[:, None]

        pose, offsets = None, tuple[int, ...]()
        if options.method == "speed":
            model = read_model(checkpoint)
            pose = model.networks()[1]
            if pose is not None:
                pose, offsets = pose.eval(), model.record.offsets
        with _batches(options, predictor, source, camera, pose, offsets) as batches:
            height = camera_height if options.camera_height is None else options.camera_height
            estimate = estimate_scale(options.method, batches, depth, pose, height)
        predictor.scale = keep_scale(estimate, checkpoint, store_in, folder)
    predictor.scale = options.chosen(predictor.scale)


@contextlib.contextmanager
def _batches(
    options: ScaleOptions,
    predictor: ImagePredictor,
    source: Input,
    camera: Camera | None,
    pose: Any,
    offsets: Sequence[int],
) -> Iterator[Iterator[TrainBatch]]:
    from saunet.io.speeds import read_speeds
    from saunet.scale.recorded import clip_batches

    method, more, size = options.method, dict[str, Any](), (predictor.height, predictor.width)
    if live_source(source) is not None:
        raise ConfigError(
            f"scale.method={method} needs a whole recording, which a live camera does not have; measure with "
            "scale.store=true on recorded frames first, then leave scale.method out"
        )
    if method != "speed":
        K = _needed(method, "camera", camera, "camera.yaml, or [fx,fy,cx,cy] in pixels of the images")
        more["intrinsics"] = lambda height, width: K.resized(height, width).K
    with contextlib.ExitStack() as stack:
        recording, times = stack.enter_context(contextlib.closing(Recording(source))), list[float | None]()
        table: SpeedTable | None = None

        def pictures() -> Iterator[Any]:
            zero = 0.0
            for number, frame in enumerate(recording):
                if number == 0 and table is not None and frame.time is not None:
                    zero = table.start(frame.time)
                times.append(None if frame.time is None else frame.time - zero)
                yield frame.read()

        if method == "speed":
            table = read_speeds(
                _needed(method, "scale.speeds", options.speeds, "a CSV file with the columns frame,speed")
            )
            table.check_drives([])
            if options.align and pose is not None:
                table = _aligned(table, Recording(source), options.fps, pose, offsets, size)
            clock = times if recording.timed and options.fps is None else None
            fps = options.fps or recording.fps
            more["distance"] = functools.partial(table.distance, "", fps=fps, times=clock)
        if method == "stereo":
            images = _needed(method, "scale.stereo", options.stereo, "the other camera's images")
            baseline = _needed(method, "scale.baseline", options.baseline, "the distance to the right camera in meters")
            other = stack.enter_context(contextlib.closing(Recording(images)))
            more |= {"stereo": (frame.read() for frame in other), "baseline": baseline}
        yield clip_batches(pictures(), *size, offsets=offsets, most=options.frames, count=recording.declared, **more)


def _aligned(
    table: SpeedTable, recording: Recording, fps: float | None, pose: Any, offsets: Sequence[int], size: tuple[int, int]
) -> SpeedTable:
    """Align a table's clock with the frames, by the pose network's predicted motion; report the offset."""
    import torch

    from saunet.io.alignment import align_speeds
    from saunet.scale.recorded import clip_batches

    clock, targets, motion = list[float](), list[float](), list[float]()

    def pictures() -> Iterator[Any]:
        for number, frame in enumerate(recording):
            known = frame.time if recording.timed and fps is None else number / (fps or recording.fps)
            clock.append(np.nan if known is None else known)
            yield frame.read()

    def elapsed(first: int, second: int) -> float:
        if first + offsets[0] == second:
            targets.append(clock[first])
        return abs(clock[second] - clock[first])

    with contextlib.closing(recording), torch.inference_mode():
        found = clip_batches(
            pictures(), *size, offsets=offsets, distance=elapsed, count=recording.declared, most=_ALIGNED
        )
        for batch in found:
            lengths = pose(batch["target"], batch["sources"])[0, :, :3, 3].norm(dim=-1)
            motion.append(float((lengths / batch["distance"][0]).mean()))
    moved, alignment = align_speeds(table, "", np.array(targets), np.array(motion))
    print(f"{table.path}: {alignment}")
    return moved


def _needed(method: str, key: str, value: Any, what: str) -> Any:
    if value is None:
        raise ConfigError(f"scale.method={method} needs {key}: {what}")
    return value
