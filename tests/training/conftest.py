"""A training set-up small enough to run many times: two textured drives of a few frames, nano networks."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning import Trainer
from omegaconf import OmegaConf
from tiny import TinyWalls
from training_options import train_options

from saunet.cli.compose import structured
from saunet.registry import REGISTRIES
from saunet.training.module import SelfSupervisedDepth
from saunet.training.tool import assemble


class Walls(TinyWalls):
    """Images large enough for the networks that a config names."""

    scale = 2


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
            "encoder": plain_node("encoder", "resnet18", blocks=[1, 1, 1, 1]),
            "decoder": plain_node("decoder", "aunet", width=8, fine=4),
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
    return assemble(train_options(config), walls)


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
