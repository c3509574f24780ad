"""A training set-up small enough to run many times: two textured drives of a few frames, nano networks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from lightning import Trainer
from numpy.typing import NDArray
from omegaconf import OmegaConf

from saunet.cli.compose import structured
from saunet.data.drive import Drive
from saunet.data.loading.module import DepthDataModule
from saunet.data.loading.windows import Selection
from saunet.registry import REGISTRIES
from saunet.training.module import SelfSupervisedDepth
from saunet.training.tool import TrainOptions, assemble


class Wall(Drive):
    """A camera that drives towards a textured wall: depth is known in closed form."""

    name = ""
    indices = range(0)

    def __init__(self, name: str, frames: int = 8, seed: int = 0) -> None:
        self.name = name
        self.indices = range(frames)
        noise = np.random.default_rng(seed).integers(0, 255, (40, 60, 3), dtype=np.uint8)
        self._texture = cv2.resize(noise, (480, 320), interpolation=cv2.INTER_CUBIC)

    def image(self, index: int) -> NDArray[np.uint8]:
        margin = 4 * index
        cut = self._texture[margin : 320 - margin, margin * 3 // 2 : 480 - margin * 3 // 2]
        return np.asarray(cv2.resize(cut, (96, 64), interpolation=cv2.INTER_AREA), dtype=np.uint8)

    def intrinsics(self, index: int) -> NDArray[np.float64]:
        return np.array([[60.0, 0, 47.5], [0, 60.0, 31.5], [0, 0, 1]])

    def depth(self, index: int) -> NDArray[np.float32]:
        return np.full((64, 96), 20.0 - index, np.float32)

    def pose(self, index: int) -> None:
        return None


class Walls(DepthDataModule):
    """Two walls to train on, one to validate and test on."""

    ground_truth = "exact"
    protocol = "synthetic"

    def select(self, split: str) -> Sequence[Selection]:
        names = {"train": [1, 2]}.get(split, [3])
        return [Selection(Wall(f"{split} {seed}", seed=seed), range(8)) for seed in names]


def plain_node(kind: str, name: str, **changes: Any) -> dict[str, Any]:
    """Return a component's config node as plain containers."""
    node = OmegaConf.merge(OmegaConf.structured(structured(REGISTRIES[kind].node(name))), changes)
    return dict(OmegaConf.to_container(node))  # type: ignore[arg-type, call-overload]


@pytest.fixture
def config() -> dict[str, Any]:
    """A resolved training config of tiny parts."""
    return {
        "name": "test",
        "seed": 0,
        "model": {
            "encoder": plain_node("encoder", "resnet18"),
            "decoder": plain_node("decoder", "aunet"),
            "pose": plain_node("pose", "posecnn"),
            "min_depth": 0.1,
            "max_depth": 100.0,
        },
        "objective": plain_node("objective", "saunet"),
        "optim": {"lr": 3e-4},
        "data": {"_target_": "Walls"},
        "protocol": None,
        "output_dir": "unused",
    }


@pytest.fixture
def walls() -> Walls:
    return Walls(height=64, width=96, batch_size=4, workers=0)


@pytest.fixture
def model(config: dict[str, Any], walls: Walls) -> SelfSupervisedDepth:
    torch.manual_seed(0)
    return assemble(TrainOptions.from_plain(config), walls)


@pytest.fixture
def make_trainer(tmp_path: Path) -> Callable[..., Trainer]:
    """Return a quiet CPU trainer."""

    def make(**kwargs: Any) -> Trainer:
        quiet = {
            "accelerator": "cpu",
            "devices": 1,
            "logger": False,
            "enable_checkpointing": False,
            "enable_progress_bar": False,
            "enable_model_summary": False,
            "num_sanity_val_steps": 0,
            "use_distributed_sampler": False,
            "default_root_dir": tmp_path,
        }
        return Trainer(**{**quiet, **kwargs})

    return make
