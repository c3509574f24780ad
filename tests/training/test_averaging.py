"""The moving average of the weights: its formula, and that it is what is validated and saved."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import tiny
import torch
from lightning import Callback, LightningModule, Trainer
from torch import nn

from saunet.training.averaging import WeightAverage
from saunet.training.callbacks import LastCheckpoint
from saunet.training.optim import Recipe


def test_it_follows_its_formula_and_copies_counters() -> None:
    network = nn.BatchNorm1d(1)
    average = WeightAverage(network, 0.5)
    expected = 1.0
    for step in range(1, 30):
        with torch.no_grad():
            network.weight.fill_(step)
            assert network.num_batches_tracked is not None
            network.num_batches_tracked.fill_(step)
        average.update(step)
        decay = min(0.5, (1 + step) / (10 + step))
        expected = decay * expected + (1 - decay) * step
    assert float(average.values["weight"]) == pytest.approx(expected)
    assert int(average.values["num_batches_tracked"]) == 29


def test_it_stands_in_and_gives_back() -> None:
    network = nn.Linear(1, 1)
    average = WeightAverage(network, 0.9, {"weight": torch.tensor([[7.0]])})
    own = network.weight.detach().clone()
    average.put_in()
    assert float(network.weight) == 7
    assert torch.equal(average.training_weights()["weight"], own)
    average.put_back()
    assert torch.equal(network.weight.detach(), own)
    average.put_back()  # nothing to give back: nothing happens
    assert torch.equal(network.weight.detach(), own)


def test_the_average_is_validated_and_saved_and_the_weights_are_trained(tmp_path: Path) -> None:
    class Look(Callback):
        def on_validation_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
            validated.append(pl_module.pose.layer.weight.detach().clone())  # type: ignore[union-attr]

    validated: list[torch.Tensor] = []
    model = tiny.tiny_model(Recipe(lr=1e-2, ema=0.9))
    trainer = tiny.tiny_trainer(tmp_path, max_epochs=1, callbacks=[Look(), LastCheckpoint(str(tmp_path))])
    trainer.fit(model, tiny.tiny_walls())
    assert model.average is not None
    averaged, trained = model.average.values["pose.layer.weight"], model.pose.layer.weight.detach()  # type: ignore[union-attr]
    assert not torch.equal(averaged, trained)  # type: ignore[arg-type]
    assert torch.equal(validated[0], averaged)
    stored = torch.load(tmp_path / "last.ckpt", weights_only=True)
    assert torch.equal(stored["state_dict"]["pose.layer.weight"], averaged)
    assert torch.equal(stored["saunet_training"]["weights"]["pose.layer.weight"], trained)  # type: ignore[arg-type]


def test_frozen_parts_stay_as_they_are_statistics_included(tmp_path: Path) -> None:
    model = tiny.tiny_model(Recipe(lr=1e-2, freeze=["depth.encoder"]))
    before = {name: value.clone() for name, value in model.state_dict().items()}
    tiny.tiny_trainer(tmp_path, max_epochs=1, limit_val_batches=0).fit(model, tiny.tiny_walls())
    changed = {name for name, value in model.state_dict().items() if not torch.equal(value, before[name])}
    assert changed == {"depth.decoder.weight", "depth.decoder.bias", "pose.layer.weight", "pose.layer.bias"}


def test_accumulated_batches_draw_different_noise_and_a_step_alone_draws_what_it_always_did(tmp_path: Path) -> None:
    class Draw(Callback):
        def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
            torch.manual_seed(torch.initial_seed())
            drawn.append(torch.initial_seed())

    seeds = []
    for accumulate in (1, 3):
        drawn: list[int] = []
        trainer = tiny.tiny_trainer(
            tmp_path, max_epochs=1, limit_val_batches=0, accumulate_grad_batches=accumulate, callbacks=[Draw()]
        )
        trainer.fit(tiny.tiny_model(), tiny.tiny_walls())
        seeds.append(drawn)
    alone, accumulated = seeds
    assert len(set(accumulated)) == len(accumulated) == 3
    assert alone[0] == accumulated[0]
