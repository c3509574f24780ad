"""``saunet predict``: depth of an image, a folder, a pattern, a video or a camera, as pictures, points and videos."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from saunet.cli._app import pick_device, run
from saunet.errors import one_of


def predict(cfg: DictConfig) -> None:
    """Predict the input into the output folder."""
    from saunet.cli._rectify import rectify
    from saunet.cli._scale import scale_predictor
    from saunet.io.video import VIDEO_SUFFIXES
    from saunet.prediction.files import OUTPUTS
    from saunet.prediction.load import load
    from saunet.prediction.video import CLIP_OUTPUTS

    is_camera = cfg.input.isdecimal() and not Path(cfg.input).exists()
    source = int(cfg.input) if is_camera else cfg.input
    is_clip = is_camera or (Path(cfg.input).suffix.lower() in VIDEO_SUFFIXES and not Path(cfg.input).is_dir())
    outputs = list(cfg.outputs if cfg.outputs is not None else ["mp4"] if is_clip else ["color", "png16"])
    for output in outputs:
        one_of("outputs", output, (*OUTPUTS, *CLIP_OUTPUTS))
    predictor = load(cfg.checkpoint, device=pick_device(cfg.device), flip=cfg.flip, keep_aspect=cfg.keep_aspect)
    rectified = rectify(cfg, predictor)
    scale_predictor(cfg, predictor)
    print(f"depth is {predictor.unit}")
    shared = {
        "colormap": cfg.colormap,
        "camera": rectified if cfg.camera is None else list(cfg.camera),
        "max_depth": cfg.max_depth,
        "batch_size": cfg.batch_size,
        "max_frames": cfg.max_frames,
        "overwrite": cfg.overwrite,
    }
    if not is_clip and not set(outputs) & set(CLIP_OUTPUTS):
        _predict_images(cfg, predictor, outputs, shared)
        return
    shown = {key: cfg[key] for key in ("fps", "layout", "memory", "codec")}
    odometer = None
    if "trajectory" in outputs:
        from saunet.prediction.odometer import Odometer

        odometer = Odometer.from_model(cfg.checkpoint, predictor.scale, pick_device(cfg.device), cfg.batch_size)
    each = _predict_clip if is_clip else _predict_recording
    each(cfg, predictor, source, outputs, {**shared, **shown, "odometer": odometer})


def _predict_images(cfg: DictConfig, predictor: Any, outputs: list[str], shared: dict[str, Any]) -> None:
    from saunet.prediction.files import predict_files

    summary = predict_files(predictor, cfg.input, cfg.output, outputs, **shared)
    for failure in summary.failures:
        print(f"saunet predict: {failure}", file=sys.stderr)
    print(f"{len(summary.written)} files written, {summary.skipped} images were finished before: {cfg.output}")
    if summary.failures:
        raise SystemExit(1)


def _predict_recording(cfg: DictConfig, predictor: Any, source: Any, outputs: list[str], how: dict[str, Any]) -> None:
    from saunet.prediction.recording import predict_recording

    done = predict_recording(predictor, source, cfg.output, outputs, **how)
    print(f"{len(done.images.written)} files written, {done.images.skipped} images were finished before: {cfg.output}")
    for paths, what in ((done.paths, f"{done.frames} frames"), (done.skipped, "finished before")):
        if paths:
            print(f"{what}: {', '.join(map(str, paths))}")


def _predict_clip(cfg: DictConfig, predictor: Any, source: Any, outputs: list[str], how: dict[str, Any]) -> None:
    from saunet.prediction.video import predict_clip

    clip = predict_clip(predictor, source, cfg.output, outputs, **how)
    print(f"{clip.frames} frames: {', '.join(map(str, clip.paths))}")
    if clip.missing:
        message = f"{source} ends {clip.missing} frames earlier than it declares: it may be truncated"
        print(f"saunet predict: {message}", file=sys.stderr)
        raise SystemExit(1)


def main() -> None:
    """Entry point of ``saunet predict``."""
    run("predict", predict, kinds=())


if __name__ == "__main__":
    main()
