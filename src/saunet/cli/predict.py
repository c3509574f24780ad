"""``saunet-predict``: depth pictures of an image, a folder or a video."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from saunet.checks import ConfigError
from saunet.cli._app import pick_device, run
from saunet.config import PredictConfig


def predict(cfg: DictConfig) -> None:
    """Predict the input into the output folder; a video becomes a side-by-side video."""
    from saunet.infer.predictor import Predictor
    from saunet.infer.video import VIDEO_SUFFIXES

    is_video = Path(cfg.input).suffix.lower() in VIDEO_SUFFIXES and not Path(cfg.input).is_dir()
    if is_video:
        _check_video(cfg)
    predictor = Predictor.from_checkpoint(cfg.checkpoint, pick_device(cfg.device), cfg.flip, cfg.keep_aspect)
    print(f"depth is {predictor.unit}")
    (_predict_video if is_video else _predict_images)(cfg, predictor)


def _predict_images(cfg: DictConfig, predictor: Any) -> None:
    from saunet.infer.files import predict_files

    summary = predict_files(
        predictor,
        cfg.input,
        cfg.output,
        tuple(cfg.outputs),
        palette=cfg.palette,
        camera=None if cfg.camera is None else list(cfg.camera),
        overwrite=cfg.overwrite,
        batch_size=cfg.batch_size,
    )
    for failure in summary.failures:
        print(f"saunet-predict: {failure}", file=sys.stderr)
    print(f"{len(summary.written)} files written, {summary.skipped} images were finished before: {cfg.output}")
    if summary.failures:
        raise SystemExit(1)


def _predict_video(cfg: DictConfig, predictor: Any) -> None:
    from saunet.infer.video import render_video

    video = render_video(predictor, cfg.input, _video_path(cfg), palette=cfg.palette)
    print(f"{video.frames} frames: {video.path}")
    if video.missing:
        print(f"saunet-predict: {cfg.input} ends {video.missing} frames early: it is truncated", file=sys.stderr)


def _video_path(cfg: DictConfig) -> Path:
    return Path(cfg.output) / f"{Path(cfg.input).stem}_disparity.mp4"


def _check_video(cfg: DictConfig) -> None:
    default = PredictConfig()
    for key in ("outputs", "camera", "batch_size"):
        if cfg[key] != getattr(default, key):
            raise ConfigError(f"{key} is for images and the input {cfg.input} is a video; leave {key} out")
    if _video_path(cfg).exists() and not cfg.overwrite:
        raise ConfigError(f"{_video_path(cfg)} exists; choose another output folder, or set overwrite=true")


def main() -> None:
    """Entry point of ``saunet-predict``."""
    run("predict", predict)


if __name__ == "__main__":
    main()
