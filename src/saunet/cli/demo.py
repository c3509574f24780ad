"""The README's demo: train on rendered video, evaluate on an unseen drive, and draw depth pictures and a video."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

import saunet
from saunet.data.drive import Drive
from saunet.evaluation import write_results
from saunet.evaluation.tool import evaluate_network
from saunet.io.images import write_image
from saunet.prediction.panel import depth_panel
from saunet.prediction.predictor import Predictor
from saunet.prediction.tool import PredictOptions, predict
from saunet.tables import show
from saunet.training.tool import TrainOptions, train

PICTURES = 3
"""Test frames shown in the panel, evenly spread over the drive."""


def demo(
    options: TrainOptions,
    *,
    choices: Mapping[str, str | None],
    overrides: Sequence[str],
    describe: Callable[[Exception], str | None],
) -> None:
    """Train, evaluate, draw; print where everything is."""
    data = train(options, choices=choices, overrides=overrides, describe=describe).data
    folder = Path(options.output_dir)
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


def draw(predictor: Predictor, drive: Drive, folder: Path) -> None:
    """Write ``depth.png`` (a few frames with truth and error) and ``depth.mp4`` (the whole drive, which has depth)."""
    frames, panels = list(drive.indices), []
    for place in np.linspace(0, len(frames) - 1, PICTURES + 2)[1:-1]:
        frame = frames[round(place)]
        prediction = predictor.predict(drive.image(frame))
        panels.append(depth_panel(prediction.image, prediction.disparity, drive.depth(frame), tile_width=384))
    write_image(folder / "depth.png", np.concatenate(panels, axis=1))
    best, images = folder / "checkpoints" / "best.ckpt", (drive.image(frame) for frame in frames)
    options = PredictOptions(checkpoint=best, input=images, output=folder, overwrite=True)
    predict(options, predictor).clips[0].replace(folder / "depth.mp4")
