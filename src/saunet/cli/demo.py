"""The README's demo: train on rendered video, evaluate on an unseen drive, and draw depth pictures and a video."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

import saunet
from saunet.data.drive import Drive
from saunet.data.synthetic import SyntheticDataModule
from saunet.evaluation import write_results
from saunet.evaluation.predictors import NetworkPredictor, PredictorNetwork
from saunet.evaluation.scoring import Shapes
from saunet.evaluation.tool import evaluate_network
from saunet.io.images import write_image
from saunet.prediction.panel import depth_panel
from saunet.prediction.predictor import Predictor
from saunet.prediction.tool import PredictOptions, predict
from saunet.tables import show
from saunet.training.tool import TrainOptions, train

SHIPPED = "street"
"""The model that comes with saunet, shown beside the one that the demo trains."""
PICTURES = 3
"""Test frames shown in the panel, evenly spread over the drive."""
WIDTH = 640
"""Of the pictures in pixels; rendered frames are rendered anew at this width, and the networks reduce them."""


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
    # The last weights, not those of the lowest validation loss: at the end of a falling rate they differ little, and
    # the lowest of noisy values is luck.
    checkpoint = folder / "checkpoints" / "last.ckpt"
    trained, shipped = saunet.load(checkpoint), saunet.load(SHIPPED)
    others = {SHIPPED: NetworkPredictor(PredictorNetwork(shipped))}
    result = evaluate_network(trained.network, data, others, Shapes(boundaries=True))
    write_results(result, folder)
    drive = large = data.datasets["test"].drives[0]
    if isinstance(data, SyntheticDataModule):
        rendered = data.drives("test")[0]
        large = replace(rendered, height=round(data.height * WIDTH / data.width), width=WIDTH, cache=None)
    draw(trained, shipped, drive, large, folder)
    show(result.tables())
    print("The camera moved through a street that neither network had seen; 'model' was trained without any depth.")
    print(f"pictures  {folder / 'depth.png'}")
    print(f"video     {folder / 'depth.mp4'}")
    print(f"metrics   {folder / 'metrics.md'}, metrics.json, per_image.csv")
    print(f"model     {checkpoint}")


def draw(trained: Predictor, shipped: Predictor, drive: Drive, large: Drive, folder: Path) -> None:
    """Write ``depth.png`` (a few large frames with truth and error) and ``depth.mp4`` (the whole drive)."""
    frames, panels = list(drive.indices), []
    for place in np.linspace(0, len(frames) - 1, PICTURES + 2)[1:-1]:
        frame = frames[round(place)]
        image, truth = large.image(frame), large.depth(frame)
        others = {f"{SHIPPED}, as shipped": shipped.predict(image).disparity}
        note, disparity = "of the model trained here", trained.predict(image).disparity
        panels.append(depth_panel(image, disparity, truth, tile_width=WIDTH, note=note, others=others))
    write_image(folder / "depth.png", np.concatenate(panels, axis=1))
    checkpoint, images = folder / "checkpoints" / "last.ckpt", (drive.image(frame) for frame in frames)
    options = PredictOptions(checkpoint=checkpoint, input=images, output=folder, overwrite=True)
    predict(options, trained).clips[0].replace(folder / "depth.mp4")
