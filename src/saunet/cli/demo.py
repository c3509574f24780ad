"""The README's demo: train on rendered video, score on its streets and a new one, draw pictures and a video."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

import saunet
from saunet.data.drive import Drive
from saunet.data.loading.module import DepthDataModule
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
"""Frames shown in a panel: evenly spread over a single street, or one from each of several."""
STREETS = {
    "driven": "Streets that the camera drove through: 'model' has learned from their video, not from their depth.",
    "unseen": "A street that neither network has seen; 'model' was trained without any depth.",
}
"""The scored streets, by the name of their files."""
WIDTH = 640
"""Width of the pictures in pixels; frames are rendered again at this width, and the networks resize them."""


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
    scored = {"unseen": data}
    if isinstance(data, SyntheticDataModule):
        scored = {"driven": data.driven(), **scored}
    for place, each in scored.items():
        result = evaluate_network(trained.network, each, others, Shapes(boundaries=True))
        write_results(result, folder / place)
        draw(trained, shipped, drawn(each), folder / f"{place}.png")
        print(STREETS[place])
        show(result.tables())
    film(trained, data.datasets["test"].drives[0], folder)
    for place in scored:
        print(f"{place:9} {folder / f'{place}.png'}, {folder / place}/metrics.md, metrics.json, per_image.csv")
    print(f"video     {folder / 'depth.mp4'}, of the unseen street")
    print(f"model     {checkpoint}")


def drawn(data: DepthDataModule) -> Sequence[Drive]:
    """Return the test drives, rendered ones at the width of the pictures."""
    if not isinstance(data, SyntheticDataModule):
        return data.datasets["test"].drives
    height = round(data.height * WIDTH / data.width)
    return [replace(drive, height=height, width=WIDTH, cache=None) for drive in data.drives("test")]


def draw(trained: Predictor, shipped: Predictor, drives: Sequence[Drive], file: Path) -> None:
    """Write a panel of a few frames with both predictions, truth and error."""
    several, panels = len(drives) >= PICTURES, []
    for number, share in enumerate(np.linspace(0, 1, PICTURES + 2)[1:-1]):
        drive = drives[number if several else 0]
        frame = list(drive.indices)[round((len(drive.indices) - 1) * share)]
        image, truth = drive.image(frame), drive.depth(frame)
        others = {f"{SHIPPED}, as shipped": shipped.predict(image).disparity}
        note, disparity = "of the model trained here", trained.predict(image).disparity
        panels.append(depth_panel(image, disparity, truth, tile_width=WIDTH, note=note, others=others))
    write_image(file, np.concatenate(panels, axis=1))


def film(trained: Predictor, drive: Drive, folder: Path) -> None:
    """Write ``depth.mp4``, a whole drive beside its depth."""
    checkpoint, images = folder / "checkpoints" / "last.ckpt", (drive.image(frame) for frame in drive.indices)
    options = PredictOptions(checkpoint=checkpoint, input=images, output=folder, overwrite=True)
    predict(options, trained).clips[0].replace(folder / "depth.mp4")
