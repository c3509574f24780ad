"""Metric scale for prediction: measured on the input's own frames, as `ScaleOptions` asks for, and reported."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from saunet.errors import ConfigError
from saunet.io.live import live_source
from saunet.prediction.pointcloud import Camera
from saunet.prediction.prediction import ImagePredictor
from saunet.prediction.sources import Input, Recording
from saunet.scale.options import ScaleOptions

if TYPE_CHECKING:
    from saunet.types import TrainBatch


def apply_scale(
    options: ScaleOptions,
    predictor: ImagePredictor,
    source: Input,
    camera: Camera | None,
    folder: Path,
    checkpoint: str | Path,
    camera_height: float | None = None,
) -> None:
    """Give a predictor the scale that is asked for; print and write down what was measured.

    The camera's height is the one of its file, and counts unless the options give one.
    """
    if options.measures:
        import torch

        from saunet.scale.estimate import estimate_scale, keep_scale
        from saunet.weights.files import read_model

        store_in = options.storable(checkpoint)

        def depth(image: Any) -> Any:
            return 1 / torch.from_numpy(predictor.disparity(image.numpy()))[:, None]

        pose, offsets = None, tuple[int, ...]()
        if options.method == "speed":
            model = read_model(checkpoint)
            pose = model.networks()[1]
            if pose is not None:
                pose, offsets = pose.eval(), model.record.offsets
        with _batches(options, predictor, source, camera, offsets) as batches:
            height = camera_height if options.camera_height is None else options.camera_height
            estimate = estimate_scale(options.method, batches, depth, pose, height)
        predictor.scale = keep_scale(estimate, store_in, folder)
    predictor.scale = options.chosen(predictor.scale)


@contextlib.contextmanager
def _batches(
    options: ScaleOptions, predictor: ImagePredictor, source: Input, camera: Camera | None, offsets: Sequence[int]
) -> Iterator[Iterator[TrainBatch]]:
    from saunet.io.speeds import read_speeds
    from saunet.scale.recorded import clip_batches

    method, more = options.method, dict[str, Any]()
    if live_source(source) is not None:
        raise ConfigError(
            f"scale.method={method} measures over a whole recording and a live camera cannot be looked at beforehand; "
            "measure with scale.store=true on recorded frames, then leave scale.method out"
        )
    if method != "speed":
        K = _needed(method, "camera", camera, "fx,fy,cx,cy in pixels of the images")
        more["intrinsics"] = lambda height, width: K.resized(height, width).K
    with contextlib.ExitStack() as stack:
        recording, times = stack.enter_context(contextlib.closing(Recording(source))), list[float | None]()

        def pictures() -> Iterator[Any]:
            for frame in recording:
                times.append(frame.time)
                yield frame.read()

        if method == "speed":
            table = read_speeds(
                _needed(method, "scale.speeds", options.speeds, "a CSV file with the columns frame,speed")
            )
            table.check_drives([])
            clock = times if recording.timed and options.fps is None else None
            fps = options.fps or recording.fps
            more["distance"] = lambda first, second: table.distance("", first, second, fps, clock)
        if method == "stereo":
            partner = _needed(method, "scale.partner", options.partner, "the other camera's images")
            baseline = _needed(method, "scale.baseline", options.baseline, "meters to the right camera")
            other = stack.enter_context(contextlib.closing(Recording(partner)))
            more |= {"partner": (frame.read() for frame in other), "baseline": baseline}
        size = (predictor.height, predictor.width)
        yield clip_batches(pictures(), *size, offsets=offsets, most=options.frames, count=recording.declared, **more)


def _needed(method: str, key: str, value: Any, what: str) -> Any:
    if value is None:
        raise ConfigError(f"scale.method={method} needs {key}: {what}")
    return value
