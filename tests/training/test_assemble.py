"""Training starts from the public weights that its config names; a resumed one has its own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from training_options import train_options

from saunet.data.loading.module import DepthDataModule
from saunet.errors import CheckpointError, ConfigError
from saunet.models.encoders.resnet import ResNet
from saunet.training.tool import assemble


def test_training_starts_from_the_named_weights(config: dict[str, Any], walls: DepthDataModule, tmp_path: Path) -> None:
    public = ResNet((1, 1, 1, 1))
    torch.save(public.state_dict(), tmp_path / "w.pth")
    config["model"]["encoder"]["weights"] = str(tmp_path / "w.pth")
    model = assemble(train_options(config), walls)
    torch.testing.assert_close(model.depth.encoder.layer3[0].conv2.weight, public.layer3[0].conv2.weight)
    assert model.record["model"]["encoder"]["weights"] == str(tmp_path / "w.pth")  # what it started from stays known


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"monitor": "val/abs_ral"}, "monitor is 'val/abs_ral'; did you mean 'val/abs_rel'"),
        (
            {"callbacks": {"best": {"_target_": "saunet.training.callbacks.BestCheckpoint", "monitor": "a1"}}},
            "callbacks.best.monitor is 'a1'",
        ),
    ],
)
def test_a_monitor_that_nothing_measures_is_refused(
    config: dict[str, Any], walls: DepthDataModule, change: dict[str, Any], words: str
) -> None:
    assemble(train_options({**config, "monitor": "val/photometric"}), walls)
    with pytest.raises(ConfigError, match=words):
        assemble(train_options({**config, **change}), walls)


def test_weights_that_cannot_be_had_stop_it(config: dict[str, Any], walls: DepthDataModule) -> None:
    config["model"]["encoder"]["weights"] = "missing/w.pth"
    with pytest.raises(CheckpointError, match=r"weights is 'missing/w\.pth', but there is no such file"):
        assemble(train_options(config), walls)
    assemble(train_options(config), walls, pretrained=False)  # a resumed training does not need the file any more
