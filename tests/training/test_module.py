"""The training step, validation and resume, on a training small enough to run to the end."""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import tiny
import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from torch import Tensor, nn
from training_options import train_options

import saunet
from saunet.data.loading.module import DepthDataModule
from saunet.data.loading.windows import Selection
from saunet.errors import ConfigError
from saunet.io.images import read_image
from saunet.runs.checkpoint import read_checkpoint
from saunet.training.callbacks import BestCheckpoint, LastCheckpoint, PicturePanel
from saunet.training.module import SelfSupervisedDepth
from saunet.training.tool import assemble
from saunet.types import EvalBatch


@pytest.fixture
def batch(walls: DepthDataModule) -> EvalBatch:
    walls.setup("fit")
    return walls.on_after_batch_transfer(next(iter(walls.val_dataloader())), 0)  # type: ignore[return-value]


@pytest.mark.usefixtures("unchecked")
def test_a_batch_as_the_loader_gives_it_is_not_trained_on(model: SelfSupervisedDepth, walls: DepthDataModule) -> None:
    walls.setup("fit")
    raw = next(iter(walls.train_dataloader()))
    with pytest.raises(ConfigError, match=r"no target: .* data\.on_after_batch_transfer\(batch, 0\)"):
        model.step(raw)
    assert model.step(walls.on_after_batch_transfer(raw, 0))[-1].total.isfinite()


def test_a_step_trains_every_parameter(model: SelfSupervisedDepth, batch: EvalBatch) -> None:
    _, _, views, terms = model.step(batch)
    terms.total.backward()
    assert len(views) == 4
    assert all(view.image.shape == batch["loss_sources"].shape for view in views)
    missing = [name for name, parameter in model.named_parameters() if parameter.grad is None]
    assert missing == []


def test_what_is_logged_is_what_is_optimized(model: SelfSupervisedDepth, batch: EvalBatch) -> None:
    terms = model.step(batch)[-1]
    named = terms.named("train")
    torch.testing.assert_close(named["train/loss"], terms.total.detach())
    assert set(named) == {"train/loss", "train/photometric", "train/gradient"}
    weighted = 10 * named["train/photometric"] + 0.1 * named["train/gradient"]
    torch.testing.assert_close(named["train/loss"], weighted)


def test_training_brings_the_loss_down(
    model: SelfSupervisedDepth, walls: DepthDataModule, make_trainer: Callable[..., Trainer]
) -> None:
    trainer = make_trainer(max_epochs=1, limit_val_batches=1)
    trainer.validate(model, walls, verbose=False)
    before = float(trainer.callback_metrics["val/loss"])
    trainer = make_trainer(max_epochs=8, check_val_every_n_epoch=8)
    trainer.fit(model, walls)
    assert float(trainer.callback_metrics["val/loss"]) < 0.8 * before
    assert float(trainer.callback_metrics["val/images"]) == 6


def test_a_checkpoint_predicts_what_the_model_predicted(
    model: SelfSupervisedDepth, walls: DepthDataModule, make_trainer: Callable[..., Trainer], tmp_path: Path
) -> None:
    trainer = make_trainer(max_epochs=1, limit_train_batches=1, limit_val_batches=0)
    trainer.fit(model, walls)
    trainer.save_checkpoint(tmp_path / "a.ckpt")
    image = walls.datasets["val"].drives[0].image(3)
    predicted = saunet.load(tmp_path / "a.ckpt").predict(image)
    model.eval()
    with torch.inference_mode():
        expected = model(torch.from_numpy(image).permute(2, 0, 1)[None] / 255).depth[0][0, 0]
    torch.testing.assert_close(torch.from_numpy(predicted.depth), expected, rtol=1e-4, atol=1e-5)


class StopAfterTwoEpochs(Callback):
    """What an interruption leaves: a checkpoint of the second epoch and nothing after it."""

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        trainer.should_stop = trainer.current_epoch == 1


def _weights(model: nn.Module) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in model.state_dict().items()}


def test_a_resumed_training_equals_the_uninterrupted_one_bit_for_bit(
    config: dict[str, Any], walls: DepthDataModule, make_trainer: Callable[..., Trainer], tmp_path: Path
) -> None:
    torch.manual_seed(0)
    model = assemble(train_options(config), walls)
    twin = copy.deepcopy(model)
    make_trainer = partial(make_trainer, max_epochs=3, limit_train_batches=2, limit_val_batches=1)
    make_trainer().fit(model, walls)

    stop = [ModelCheckpoint(tmp_path, save_last=True), StopAfterTwoEpochs()]
    make_trainer(callbacks=stop, enable_checkpointing=True).fit(twin, copy.deepcopy(walls))
    torch.manual_seed(99)  # what happened in between must not matter
    resumed = assemble(train_options(config), walls)
    make_trainer().fit(resumed, copy.deepcopy(walls), ckpt_path=tmp_path / "last.ckpt", weights_only=True)
    expected, got = _weights(model), _weights(resumed)
    assert expected.keys() == got.keys()
    assert all(torch.equal(expected[name], got[name]) for name in expected)


def test_last_is_the_last_and_best_is_the_best(
    config: dict[str, Any], walls: DepthDataModule, make_trainer: Callable[..., Trainer], tmp_path: Path
) -> None:
    class Worsening(Callback):
        def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
            pl_module.log("score", {0: 0.5, 1: 0.1, 2: 0.3}.get(trainer.current_epoch, 0.2))

    def fit(folder: Path, epochs: int, resume: Path | None = None, validated: int = 1) -> None:
        callbacks = [Worsening(), LastCheckpoint(str(folder)), BestCheckpoint(str(folder), "score")]
        batches = {"limit_train_batches": 1, "limit_val_batches": validated}
        trainer = make_trainer(max_epochs=epochs, **batches, callbacks=callbacks)
        trainer.fit(assemble(train_options(config), walls), copy.deepcopy(walls), ckpt_path=resume, weights_only=True)

    make_trainer = partial(make_trainer, enable_checkpointing=True)
    fit(tmp_path / "a", 3)
    assert read_checkpoint(tmp_path / "a" / "last.ckpt").epoch == 2
    assert read_checkpoint(tmp_path / "a" / "best.ckpt").epoch == 1
    fit(tmp_path / "b", 4, resume=tmp_path / "a" / "last.ckpt")  # scores 0.2: not better than the 0.1 of before
    assert read_checkpoint(tmp_path / "b" / "last.ckpt").epoch == 3
    assert read_checkpoint(tmp_path / "b" / "best.ckpt").epoch == 1
    fit(tmp_path / "c", 4, resume=tmp_path / "a" / "last.ckpt", validated=0)  # the loss of training decides less
    assert read_checkpoint(tmp_path / "c" / "best.ckpt").epoch == 1


def test_best_falls_back_to_the_loss_where_nothing_has_ground_truth(
    config: dict[str, Any], walls: DepthDataModule, make_trainer: Callable[..., Trainer], tmp_path: Path
) -> None:
    best = BestCheckpoint(str(tmp_path), "val/nothing")
    trainer = make_trainer(max_epochs=1, limit_train_batches=1, callbacks=[best], enable_checkpointing=True)
    trainer.fit(assemble(train_options(config), walls), walls)
    assert best.monitor == "val/loss"
    assert (tmp_path / "best.ckpt").is_file()


def test_validation_without_ground_truth_says_nothing_of_metrics(tmp_path: Path) -> None:
    class Plain(tiny.Wall):
        def depth(self, index: int) -> None:  # type: ignore[override]
            return None

    class PlainWalls(tiny.TinyWalls):
        def select(self, split: str) -> list[Selection]:
            return [Selection(Plain(f"{split} 1"), range(8))]

    model, data = tiny.tiny_model(), PlainWalls(height=32, width=48, batch_size=4, workers=0)
    trainer = tiny.tiny_trainer(tmp_path, max_epochs=1)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=r".*was called before the ``update``.*")
        trainer.fit(model, data)
    assert "val/loss" in trainer.callback_metrics
    assert "val/abs_rel" not in trainer.callback_metrics


def test_where_more_is_better_the_highest_is_kept(
    config: dict[str, Any], walls: DepthDataModule, make_trainer: Callable[..., Trainer], tmp_path: Path
) -> None:
    class Best(BestCheckpoint):
        def _monitor_candidates(self, trainer: Trainer) -> dict[str, torch.Tensor]:
            value = torch.tensor((0.5, 0.9, 0.7)[trainer.current_epoch])
            return {**super()._monitor_candidates(trainer), "val/a1": value}

    best = Best(str(tmp_path), "val/a1")
    make_trainer = partial(make_trainer, enable_checkpointing=True, limit_train_batches=1, limit_val_batches=1)
    make_trainer(max_epochs=3, callbacks=[best]).fit(assemble(train_options(config), walls), walls)
    assert read_checkpoint(tmp_path / "best.ckpt").epoch == 1
    assert best.cost == pytest.approx(-0.9)


@pytest.mark.parametrize(
    ("states", "chosen", "cost"),
    [
        ([(0.5, 0.01), (0.4, 0.3), (0.1, 0.005)], 1, 0.4),
        ([(0.5, 0.01), (0.1, 0.005), (0.3, 0.01)], 1, math.inf),
        ([(0.5, 0.3), (0.4, 0.3), (0.6, 0.3)], 1, 0.4),
    ],
)
def test_a_loss_of_few_pixels_does_not_choose_the_best_while_there_is_another(
    states: list[tuple[float, float]],
    chosen: int,
    cost: float,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr("saunet.training.callbacks.FEW", 1)

    class Best(BestCheckpoint):
        def _monitor_candidates(self, trainer: Trainer) -> dict[str, torch.Tensor]:
            loss, automask = map(torch.tensor, states[trainer.current_epoch])
            found = {**super()._monitor_candidates(trainer), "val/loss": loss, "val/automask": automask}
            return {**found, "val/rotation": torch.tensor(0.0)}

    def fit(folder: Path, epochs: int, resume: Path | None = None) -> BestCheckpoint:
        callbacks = [best := Best(str(folder), "val/loss"), LastCheckpoint(str(folder))]
        trainer = tiny.tiny_trainer(folder, max_epochs=epochs, limit_train_batches=1, callbacks=callbacks)
        with caplog.at_level("INFO"):
            trainer.fit(tiny.tiny_model(), tiny.tiny_walls(), ckpt_path=resume, weights_only=True)
        return best

    def kept(folder: Path) -> int:
        return int(torch.load(folder / "best.ckpt", weights_only=True)["epoch"])

    assert fit(tmp_path / "a", 3).cost == pytest.approx(cost)
    assert kept(tmp_path / "a") == chosen
    doubted = any(automask < 0.05 for _, automask in states)
    assert caplog.text.count("the loss says little about this checkpoint: it covers only") == doubted
    fit(tmp_path / "b", 1)
    assert fit(tmp_path / "b", 3, tmp_path / "b" / "last.ckpt").cost == pytest.approx(cost)  # stopped and resumed
    assert kept(tmp_path / "b") == chosen


def test_the_auto_mask_of_the_validation_is_measured(tmp_path: Path) -> None:
    trainer = tiny.tiny_trainer(tmp_path, max_epochs=1, limit_train_batches=1)
    trainer.fit(tiny.tiny_model(), tiny.tiny_walls())
    assert 0 <= trainer.callback_metrics["val/automask"] <= 1
    assert trainer.callback_metrics["val/rotation"] >= 0


def test_without_validation_the_mean_loss_of_the_epoch_decides(
    config: dict[str, Any],
    walls: DepthDataModule,
    make_trainer: Callable[..., Trainer],
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    losses = []

    class Watch(Callback):
        def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, outputs: Any, *_: Any) -> None:
            losses.append(float(outputs["loss"]))

    best = BestCheckpoint(str(tmp_path), "val/a1")
    trainer = make_trainer(
        max_epochs=2, limit_train_batches=2, limit_val_batches=0, callbacks=[Watch(), best], enable_checkpointing=True
    )
    with caplog.at_level("INFO"):
        trainer.fit(assemble(train_options(config), walls), walls)
    assert best.cost == pytest.approx(min(sum(losses[:2]), sum(losses[2:])) / 2, rel=1e-4)
    said = [each.getMessage() for each in caplog.records if "best.ckpt" in each.getMessage()]
    assert said == ["val/a1 is not measured in this run; best.ckpt is chosen by the epoch's mean train/loss"]


def test_a_picture_is_written_after_every_epoch(
    model: SelfSupervisedDepth, walls: DepthDataModule, make_trainer: Callable[..., Trainer], tmp_path: Path
) -> None:
    make_trainer(max_epochs=2, limit_train_batches=1, callbacks=[PicturePanel(str(tmp_path / "p"))]).fit(model, walls)
    pictures = sorted((tmp_path / "p").iterdir())
    assert [path.name for path in pictures] == ["epoch_000.png", "epoch_001.png"]
    picture = read_image(pictures[1])
    assert picture.shape[1] > 4 * 320  # five tiles a row
    assert picture.std() > 20


def test_parts_that_do_not_fit_are_refused(config: dict[str, Any], walls: DepthDataModule) -> None:
    config["model"]["pose"]["offsets"] = [-2, 2]
    with pytest.raises(ConfigError, match=r"model.pose.offsets is \[-2, 2\] but the data give frames at \[-1, 1\]"):
        assemble(train_options(config), walls)
    config["model"]["pose"]["offsets"] = [-1, 1]
    walls.height = 90
    with pytest.raises(ConfigError, match="nearest valid size is 96x96"):
        assemble(train_options(config), walls)


@pytest.mark.parametrize("parts", [2, 4])
def test_loss_and_gradient_do_not_depend_on_how_a_batch_is_split(parts: int) -> None:
    """Processes, accumulated passes and validation batches: with masks on, only the images count."""
    data = tiny.tiny_walls(batch_size=4)
    data.setup("fit")
    batch = data.on_after_batch_transfer(next(iter(data.train_dataloader())), 0)
    model = tiny.tiny_model(dropout=0.0)
    model.depth.encoder[1] = torch.nn.Identity()  # type: ignore[union-attr, index, operator]
    model.objective.terms["photometric"].noise = 0.0  # type: ignore[union-attr, assignment]

    def gradients(batches: list[Any]) -> tuple[torch.Tensor, list[torch.Tensor]]:
        model.zero_grad()
        results = [model.step(each)[-1] for each in batches]
        loss = torch.stack([result.total for result in results]).mean()
        loss.backward()
        kept.extend(result.maps["automask"].mean((1, 2, 3)) for result in results)
        return loss.detach(), [parameter.grad.clone() for parameter in model.parameters() if parameter.grad is not None]

    kept: list[torch.Tensor] = []
    pieces = [
        {key: value[slice(start, start + 4 // parts)] for key, value in batch.items()}
        for start in range(0, 4, 4 // parts)
    ]
    whole, split = gradients([batch]), gradients(pieces)
    assert kept[0].min() < 0.9 * kept[0].max()  # the masks keep unlike shares of the images
    torch.testing.assert_close(split[0], whole[0], rtol=1e-6, atol=1e-6)
    for one, other in zip(split[1], whole[1], strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6)
