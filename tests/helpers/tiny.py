"""A training of a few thousand numbers, and a program that runs it, to be killed and resumed.

``python tiny.py FOLDER EPOCHS`` trains, saves ``last.ckpt`` after every step, and writes the weights to
``FOLDER/end.pt``. It prints every batch and waits for a line of input before it goes on.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from lightning import Callback, LightningModule, Trainer
from numpy.typing import NDArray
from torch import Tensor, nn

from saunet.data.drive import Drive
from saunet.data.loading.module import DepthDataModule
from saunet.data.loading.windows import Selection
from saunet.geometry.depth import disparity_to_depth, sigmoid_to_disparity
from saunet.geometry.pose import pose_matrix
from saunet.registry import objectives
from saunet.training.callbacks import AtomicCheckpointIO, LastCheckpoint
from saunet.training.loop import EpochLoop
from saunet.training.module import SelfSupervisedDepth
from saunet.training.optim import Recipe
from saunet.training.speed import Speed
from saunet.training.stopping import GracefulStop
from saunet.types import DepthPyramid, TrainBatch


class Wall(Drive):
    """A camera that drives towards a textured wall: depth is known in closed form; images of 48x32 times ``scale``."""

    name = ""
    indices = range(0)

    def __init__(self, name: str, frames: int = 8, seed: int = 0, scale: int = 1) -> None:
        self.name, self.scale = name, scale
        self.indices = range(frames)
        noise = np.random.default_rng(seed).integers(0, 255, (20 * scale, 30 * scale, 3), dtype=np.uint8)
        self._texture = cv2.resize(noise, (240 * scale, 160 * scale), interpolation=cv2.INTER_CUBIC)

    def image(self, index: int) -> NDArray[np.uint8]:
        margin, (height, width) = 2 * self.scale * index, self._texture.shape[:2]
        cut = self._texture[margin : height - margin, margin * 3 // 2 : width - margin * 3 // 2]
        size = (48 * self.scale, 32 * self.scale)
        return np.asarray(cv2.resize(cut, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)

    def intrinsics(self, index: int) -> NDArray[np.float64]:
        focal, x, y = 30.0 * self.scale, 24.0 * self.scale - 0.5, 16.0 * self.scale - 0.5
        return np.array([[focal, 0, x], [0, focal, y], [0, 0, 1]])

    def depth(self, index: int) -> NDArray[np.float32]:
        return np.full((32 * self.scale, 48 * self.scale), 20.0 - index, np.float32)

    def pose(self, index: int) -> None:
        return None


class TinyWalls(DepthDataModule):
    """Twelve windows to train on, six to validate on."""

    ground_truth = "exact"
    protocol = "synthetic"
    scale = 1

    def select(self, split: str) -> Sequence[Selection]:
        names = {"train": [1, 2]}.get(split, [3])
        return [Selection(Wall(f"{split} {seed}", seed=seed, scale=self.scale), range(8)) for seed in names]


class TinyDepth(nn.Module):
    """Two convolutions with batch norm and dropout, one scale."""

    max_depth = 100.0

    def __init__(self, dropout: float = 0.1) -> None:
        super().__init__()
        self.encoder = nn.Sequential(nn.Conv2d(3, 8, 3, padding=1), nn.BatchNorm2d(8), nn.ELU(), nn.Dropout(dropout))
        self.decoder = nn.Conv2d(8, 1, 3, padding=1)

    def forward(self, image: Tensor) -> DepthPyramid:
        sigmoid = self.decoder(self.encoder(image)).sigmoid()
        disparity = sigmoid_to_disparity(sigmoid, 0.1, 100.0)
        return DepthPyramid((sigmoid,), (disparity,), (disparity_to_depth(disparity),))


class TinyPose(nn.Module):
    """Six numbers a source from the mean colors."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(6, 6)

    def forward(self, target: Tensor, sources: Tensor) -> Tensor:
        means = sources.mean((-2, -1))
        pairs = torch.cat([target.mean((-2, -1))[:, None].expand_as(means), means], -1)
        motion = 0.01 * self.layer(pairs)
        return pose_matrix(motion[..., :3], motion[..., 3:])


def tiny_walls(**kwargs: Any) -> TinyWalls:
    return TinyWalls(**{"height": 32, "width": 48, "batch_size": 4, "workers": 0, **kwargs})


def tiny_model(recipe: Recipe | None = None, speed: Speed | None = None, dropout: float = 0.1) -> SelfSupervisedDepth:
    torch.manual_seed(0)
    recipe = recipe or Recipe(lr=1e-2, schedule="cosine", warmup=0.2)
    return SelfSupervisedDepth(TinyDepth(dropout), TinyPose(), objectives.build("saunet"), recipe, speed=speed)


def train_on(batch: TrainBatch) -> None:
    """Learn from one batch: the loss must be finite and move the weights."""
    model = tiny_model()
    before = model.depth.decoder.weight.detach().clone()  # type: ignore[union-attr]
    loss = model.step(batch)[3].total
    loss.backward()
    torch.optim.SGD(model.parameters(), lr=1.0).step()
    assert loss.isfinite()
    assert loss > 0
    assert not torch.equal(model.depth.decoder.weight, before)  # type: ignore[union-attr]


def tiny_trainer(folder: Path, **kwargs: Any) -> Trainer:
    quiet: dict[str, Any] = {
        "accelerator": "cpu",
        "devices": 1,
        "logger": False,
        "enable_checkpointing": any("Checkpoint" in type(each).__name__ for each in kwargs.get("callbacks", [])),
        "enable_progress_bar": False,
        "enable_model_summary": False,
        "num_sanity_val_steps": 0,
        "use_distributed_sampler": False,
        "plugins": [AtomicCheckpointIO()],
        "default_root_dir": folder,
    }
    return EpochLoop.install(Trainer(**{**quiet, **kwargs}))


class Ask(Callback):
    """Print every batch and wait for an answer, so that whoever watches can choose when to strike."""

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        print(f"batch {trainer.fit_loop.total_batch_idx}", flush=True)
        sys.stdin.readline()


RECIPE = Recipe(lr=1e-2, schedule="one_cycle", warmup=0.3, encoder_lr=5e-3, ema=0.9)


def main(folder: Path, epochs: int, resume: str | None = None, asking: Sequence[Callback] = ()) -> None:
    torch.manual_seed(99 if resume else 1)  # nothing may depend on what the generator happened to be
    model = tiny_model(RECIPE)
    if resume:
        torch.nn.init.zeros_(model.pose.layer.weight)  # type: ignore[union-attr, arg-type]
    trainer = tiny_trainer(
        folder,
        max_epochs=epochs,
        accumulate_grad_batches=2,
        gradient_clip_val=1.0,
        callbacks=[*asking, LastCheckpoint(str(folder), every_n_steps=1), GracefulStop(str(folder))],
    )
    trainer.fit(model, tiny_walls(batch_size=2), ckpt_path=resume, weights_only=True)
    assert model.average is not None
    optimizer = trainer.optimizers[0].state_dict()
    moments = {f"{key} {name}": value for key, state in optimizer["state"].items() for name, value in state.items()}
    rates = torch.tensor([group["lr"] for group in trainer.optimizers[0].param_groups])
    average = {f"average {name}": value for name, value in model.average.values.items()}
    torch.save({**model.state_dict(), **average, **moments, "rates": rates}, folder / "end.pt")


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), asking=[Ask()])
