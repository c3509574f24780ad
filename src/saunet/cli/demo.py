"""The README's demo: train on rendered video, evaluate on an unseen drive, and draw depth pictures and a video."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig

from saunet import config
from saunet.cli._app import run
from saunet.cli.train import fit

PICTURES = 3
"""Test frames shown in the panel, evenly spread over the drive."""


def demo(cfg: DictConfig) -> None:
    """Train, evaluate, draw; print where everything is."""
    import saunet
    from saunet.evaluation import write_results
    from saunet.evaluation.tool import evaluate_network
    from saunet.tables import show

    data = fit(cfg).data
    folder = Path(cfg.output_dir)
    predictor = saunet.load(folder / "checkpoints" / "best.ckpt")
    result = evaluate_network(predictor.network, data)
    write_results(result, folder)
    drive = data.datasets["test"].drives[0]
    draw(predictor, drive, folder)
    show(result.tables())
    print("The camera moved through a street that the network had never seen; no depth was used in training.")
    print(f"pictures  {folder / 'depth.png'}")
    print(f"video     {folder / 'depth.mp4'}")
    print(f"metrics   {folder / 'metrics.md'}, metrics.json, per_image.csv")
    print(f"model     {folder / 'checkpoints' / 'best.ckpt'}")


def draw(predictor: Any, drive: Any, folder: Path) -> None:
    """Write ``depth.png`` (a few frames with truth and error) and ``depth.mp4`` (the whole drive).

    Args:
        predictor: A `saunet.prediction.predictor.Predictor`.
        drive: A `saunet.data.drive.Drive` with true depth.
        folder: Where the files go.
    """
    from saunet.io.images import write_image
    from saunet.prediction.panel import depth_panel
    from saunet.prediction.video import render_video

    frames = list(drive.indices)
    chosen = [frames[round(place)] for place in np.linspace(0, len(frames) - 1, PICTURES + 2)[1:-1]]
    panels = []
    for frame in chosen:
        prediction = predictor.predict(drive.image(frame))
        panels.append(depth_panel(prediction.image, prediction.disparity, drive.depth(frame), tile_width=384))
    write_image(folder / "depth.png", np.concatenate(panels, axis=1))
    render_video(predictor, (drive.image(frame) for frame in frames), folder / "depth.mp4")


def main() -> None:
    """Entry point of the demo; further arguments are overrides, such as ``trainer.max_epochs=2``."""
    config.register_training_configs()
    sys.argv.insert(1, "experiment=demo")
    run("train", demo)


if __name__ == "__main__":
    main()
