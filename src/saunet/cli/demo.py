"""The README's demo: train on rendered video, score on its streets and a new one, draw pictures and a video."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

import saunet
from saunet.cli import compose
from saunet.cli.table import TOOLS, read
from saunet.data.drive import Drive
from saunet.data.loading.module import DepthDataModule
from saunet.data.synthetic import SyntheticDataModule
from saunet.errors import ConfigError
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
NANO = "sau_net_nano"
"""The paper's kind of network, trained beside it from random weights for four times the steps."""
NANO_WORDS = (
    f"model={NANO}",
    "model/pose=posecnn",
    "init_from=null",
    "data.height=64",
    "data.width=192",
    "optim.lr=4e-4",
    "optim.ema=0.99",
    "optim.freeze_statistics=[]",
    "name=demo_nano",
)
"""What its training changes: a size at which two minutes are enough steps, and the rate of `experiment=scratch`."""
NANO_STEPS = 4
"""Its optimizer steps for each one of the demo's: together they take somewhat longer."""
PICTURES = 4
"""Frames shown in a panel: evenly spread over a single street, or one from each of several."""
STREETS = {
    "driven": "Streets that the camera drove through: 'model' has learned from their video, not from their depth.",
    "unseen": "A street that no network has seen; 'model' was trained without any depth.",
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
    folder = Path(options.output_dir)
    beside, record = nano_options(options, overrides)  # before two minutes of training, in case a word does not fit it
    data = train(options, choices=choices, overrides=overrides, describe=describe).data
    print(f"Now {NANO} from random weights, on the same video for four times the steps.")
    train(beside, choices=record.choices, overrides=record.overrides, describe=describe)
    # The last weights, not those of the lowest validation loss: at the end of a falling rate they differ little, and
    # the lowest of noisy values is luck.
    checkpoint = folder / "checkpoints" / "last.ckpt"
    trained, shipped = saunet.load(checkpoint), saunet.load(SHIPPED)
    nano = saunet.load(Path(beside.output_dir) / "checkpoints" / "last.ckpt")
    others = {name: NetworkPredictor(PredictorNetwork(each)) for name, each in ((SHIPPED, shipped), (NANO, nano))}
    drawn_beside = {"SAU-Net nano, from random weights": nano, f"{SHIPPED}, as shipped": shipped}
    scored = {"unseen": data}
    if isinstance(data, SyntheticDataModule):
        scored = {"driven": data.driven(), **scored}
    for place, each in scored.items():
        result = evaluate_network(trained.network, each, others, Shapes(boundaries=True))
        write_results(result, folder / place)
        draw(trained, drawn_beside, drawn(each), folder / f"{place}.png")
        print(STREETS[place])
        show(result.tables())
    film(trained, data.datasets["test"].drives[0], folder)
    for place in scored:
        print(f"{place:9} {folder / f'{place}.png'}, {folder / place}/metrics.md, metrics.json, per_image.csv")
    print(f"video     {folder / 'depth.mp4'}, of the unseen street")
    print(f"model     {checkpoint}")


def nano_options(options: TrainOptions, overrides: Sequence[str]) -> tuple[TrainOptions, compose.Composed]:
    """Return the training of the small SAU-Net: the demo's words about data and length, other networks."""
    words = [
        word for word in overrides if not word.lstrip("+~").startswith(("model", "init_from", "optim", "output_dir"))
    ]
    steps = options.trainer.get("max_steps", -1)
    length = [f"trainer.max_steps={NANO_STEPS * steps}"] if steps > 0 else []
    folder = f"hydra.run.dir='{Path(options.output_dir) / 'nano'}'"
    table = read()
    with compose.hydra(TOOLS["train"], table) as hydra:
        composed = compose.single(hydra, "train", [*words, *NANO_WORDS, *length, folder])
    if composed is None:
        raise ConfigError("the demo is one training; a sweep is for `saunet train`")
    return compose.options(TrainOptions, composed, table), composed


def drawn(data: DepthDataModule) -> Sequence[Drive]:
    """Return the test drives, rendered ones at the width of the pictures."""
    if not isinstance(data, SyntheticDataModule):
        return data.datasets["test"].drives
    height = round(data.height * WIDTH / data.width)
    return [replace(drive, height=height, width=WIDTH, cache=None) for drive in data.drives("test")]


def draw(trained: Predictor, beside: Mapping[str, Predictor], drives: Sequence[Drive], file: Path) -> None:
    """Write a panel of a few frames with all predictions, truth and error."""
    several, panels = len(drives) >= PICTURES, []
    for number, share in enumerate(np.linspace(0, 1, PICTURES + 2)[1:-1]):
        drive = drives[number if several else 0]
        frame = list(drive.indices)[round((len(drive.indices) - 1) * share)]
        image, truth = drive.image(frame), drive.depth(frame)
        others = {name: each.predict(image).disparity for name, each in beside.items()}
        note, disparity = f"of {SHIPPED}, trained on this video", trained.predict(image).disparity
        panels.append(depth_panel(image, disparity, truth, tile_width=WIDTH, note=note, others=others))
    write_image(file, np.concatenate(panels, axis=1))


def film(trained: Predictor, drive: Drive, folder: Path) -> None:
    """Write ``depth.mp4``, a whole drive beside its depth."""
    checkpoint, images = folder / "checkpoints" / "last.ckpt", (drive.image(frame) for frame in drive.indices)
    options = PredictOptions(checkpoint=checkpoint, input=images, output=folder, overwrite=True)
    predict(options, trained).clips[0].replace(folder / "depth.mp4")
