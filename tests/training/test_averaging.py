"""The moving average of the weights: its formula, and that it is what is validated and saved."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import tiny
import torch
from lightning import Callback, LightningModule, Trainer

from saunet.training.callbacks import LastCheckpoint
from saunet.training.optim import Recipe


def test_it_follows_its_formula_from_the_first_step_and_copies_counters(tmp_path: Path) -> None:
    """The warm-up: the decay is (1 + n) / (10 + n) after n steps, until it reaches the one that was asked for."""

    class Follow(Callback):
        def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
            self.expected = pl_module.pose.layer.weight.detach().clone()  # type: ignore[union-attr, operator]

        def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
            steps = trainer.global_step - 1
            decay = min(0.25, (1 + steps) / (10 + steps))
            decays.append(decay)
            live = pl_module.pose.layer.weight.detach()  # type: ignore[union-attr, operator]
            self.expected = decay * self.expected + (1 - decay) * live

    decays: list[float] = []
    follow, model = Follow(), tiny.tiny_model(Recipe(lr=1e-1, ema=0.25))
    tiny.tiny_trainer(tmp_path, max_epochs=2, limit_val_batches=0, callbacks=[follow]).fit(model, tiny.tiny_walls())
    assert decays == pytest.approx([1 / 10, 2 / 11, 3 / 12, 0.25, 0.25, 0.25])
    assert model.average is not None
    torch.testing.assert_close(model.average.values["pose.layer.weight"], follow.expected)
    assert int(model.average.values["depth.encoder.1.num_batches_tracked"]) == 6


def test_a_training_without_an_average_takes_up_the_weights_that_were_trained(tmp_path: Path) -> None:
    last = str(tmp_path / "last.ckpt")
    first = tiny.tiny_trainer(tmp_path, max_epochs=1, callbacks=[LastCheckpoint(str(tmp_path))])
    first.fit(tiny.tiny_model(Recipe(lr=1e-2, ema=0.9)), tiny.tiny_walls())
    stored = torch.load(last, weights_only=True)
    again, model = tiny.tiny_trainer(tmp_path, max_epochs=1), tiny.tiny_model(Recipe(lr=1e-2))
    again.fit(model, tiny.tiny_walls(), ckpt_path=last, weights_only=True)  # done already: nothing is trained
    trained = stored["current_model_state"]["pose.layer.weight"]
    assert torch.equal(model.pose.layer.weight.detach(), trained)  # type: ignore[union-attr, arg-type]
    assert not torch.equal(trained, stored["state_dict"]["pose.layer.weight"])


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
    assert torch.equal(stored["current_model_state"]["pose.layer.weight"], trained)  # type: ignore[arg-type]


def test_frozen_parts_stay_as_they_are_statistics_included(tmp_path: Path) -> None:
    model = tiny.tiny_model(Recipe(lr=1e-2, freeze=["depth.encoder"]))
    before = {name: value.clone() for name, value in model.state_dict().items()}
    tiny.tiny_trainer(tmp_path, max_epochs=1, limit_val_batches=0).fit(model, tiny.tiny_walls())
    changed = {name for name, value in model.state_dict().items() if not torch.equal(value, before[name])}
    assert changed == {"depth.decoder.weight", "depth.decoder.bias", "pose.layer.weight", "pose.layer.bias"}


def test_fixed_statistics_stay_while_the_weights_around_them_learn(tmp_path: Path) -> None:
    model = tiny.tiny_model(Recipe(lr=1e-2, freeze_statistics=["depth"]))
    before = {name: value.clone() for name, value in model.state_dict().items()}
    tiny.tiny_trainer(tmp_path, max_epochs=1, limit_val_batches=0).fit(model, tiny.tiny_walls())
    changed = {name for name, value in model.state_dict().items() if not torch.equal(value, before[name])}
    statistics = {name for name in before if "running_" in name or "num_batches" in name}
    assert len(statistics) == 3
    assert changed == before.keys() - statistics


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
