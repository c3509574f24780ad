"""``saunet-predict``: depth pictures of an image, a folder or a video."""

from __future__ import annotations

import sys
from pathlib import Path

from omegaconf import DictConfig

from saunet.cli._app import pick_device, run


def predict(cfg: DictConfig) -> None:
    """Predict the input into the output folder; a video becomes a side-by-side video."""
    from saunet.infer.files import predict_files
    from saunet.infer.predictor import Predictor
    from saunet.infer.video import VIDEO_SUFFIXES, render_video

    predictor = Predictor.from_checkpoint(cfg.checkpoint, pick_device(cfg.device), flip=cfg.flip)
    print(f"depth is {predictor.unit}")
    source = Path(cfg.input)
    if source.suffix.lower() in VIDEO_SUFFIXES:
        video = render_video(predictor, source, Path(cfg.output) / f"{source.stem}_disparity.mp4")
        print(f"{video.frames} frames: {video.path}")
        if video.missing:
            print(f"saunet-predict: {source} ends {video.missing} frames early: it is truncated", file=sys.stderr)
        return
    summary = predict_files(
        predictor, cfg.input, cfg.output, tuple(cfg.outputs), overwrite=cfg.overwrite, batch_size=cfg.batch_size
    )
    for failure in summary.failures:
        print(f"saunet-predict: {failure}", file=sys.stderr)
    print(f"{len(summary.written)} files written, {summary.skipped} images were finished before: {cfg.output}")
    if summary.failures:
        raise SystemExit(1)


def main() -> None:
    """Entry point of ``saunet-predict``."""
    run("predict", predict)


if __name__ == "__main__":
    main()
