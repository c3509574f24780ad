"""A run that is asked to stop leaves, once it was resumed, the files of one that was not."""

from __future__ import annotations

import csv
import functools
import os
import signal
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import tiny
import torch
from lightning import Callback, Trainer
from lightning.pytorch.demos.boring_classes import BoringModel
from lightning.pytorch.loggers import CSVLogger
from omegaconf import OmegaConf

from saunet.cli.table import config_dir
from saunet.data.loading.windows import Selection
from saunet.runs.folder import Stopped
from saunet.training.callbacks import BestCheckpoint, LastCheckpoint, PicturePanel
from saunet.training.resume import keep_rows
from saunet.training.stopping import GracefulStop
from saunet.training.tool import _ended_early

BATCHES = 6  # an epoch's, of two epochs


class FewWalls(tiny.TinyWalls):
    """Two batches to validate on, not three."""

    def select(self, split: str) -> Sequence[Selection]:
        (*selections,) = super().select(split)
        return [Selection(each.drive, range(1, 5)) for each in selections] if split == "val" else selections


class Ask(Callback):
    """Ask the process to stop during a batch, or during the first validation."""

    def __init__(self, batch: int | None) -> None:
        self.batch = batch

    def on_train_batch_start(self, trainer: Trainer, *_: Any) -> None:
        if trainer.fit_loop.total_batch_idx + 1 == self.batch:
            os.kill(os.getpid(), signal.SIGTERM)


class KilledError(Exception):
    pass


class Kill(Callback):
    """Break off during the validation after a step, or right after it."""

    def __init__(self, step: int, hook: str) -> None:
        self.step = step
        setattr(self, hook, self._strike)

    def _strike(self, trainer: Trainer, *_: Any) -> None:
        if trainer.global_step == self.step:
            raise KilledError


def train(
    folder: Path, asked: int | None = None, resume: bool = False, *more: Callback, every: int = 1000, **settings: Any
) -> Trainer:
    logger = CSVLogger(str(folder), name=None, version="csv", flush_logs_every_n_steps=1)
    last = folder / "last.ckpt"
    if resume:
        stored = torch.load(last, weights_only=True)
        keep_rows(logger, stored)
    callbacks = [
        Ask(asked),
        BestCheckpoint(str(folder)),
        LastCheckpoint(str(folder), every),
        GracefulStop(str(folder)),
        PicturePanel(str(folder / "pictures")),
        *more,
    ]
    trainer = tiny.tiny_trainer(
        folder, max_epochs=2, callbacks=callbacks, logger=logger, log_every_n_steps=1, **settings
    )
    trainer.fit(
        tiny.tiny_model(tiny.RECIPE),
        FewWalls(height=32, width=48, batch_size=2, workers=0),
        ckpt_path=str(last) if resume else None,
        weights_only=True,
    )
    return trainer


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "csv" / "metrics.csv").open() as file:
        return [{key: value for key, value in row.items() if value} for row in csv.DictReader(file)]


def same(left: Path, right: Path) -> None:
    assert rows(left) == rows(right)
    one, other = (torch.load(folder / "best.ckpt", weights_only=True) for folder in (left, right))
    assert one["global_step"] == other["global_step"]
    assert all(torch.equal(value, other["state_dict"][name]) for name, value in one["state_dict"].items())
    pictures = [sorted(file.name for file in (folder / "pictures").iterdir()) for folder in (left, right)]
    assert pictures[0] == pictures[1]


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Return the folder of the uninterrupted training with some settings, which is trained once."""

    @functools.cache
    def trained(**settings: Any) -> Path:
        folder = tmp_path_factory.mktemp("whole")
        train(folder, **settings)
        return folder

    return trained


@pytest.fixture
def whole(uninterrupted: Callable[..., Path]) -> Path:
    return uninterrupted()


@pytest.mark.parametrize(("asked", "after"), [(2, 2), (BATCHES, BATCHES)])
def test_the_log_and_the_best_are_those_of_the_uninterrupted_run(
    asked: int, after: int, whole: Path, tmp_path: Path
) -> None:
    with pytest.raises(Stopped, match=rf"after step {after}, everything is saved"):
        train(tmp_path, asked)
    stopped = rows(tmp_path)
    assert stopped == rows(whole)[: len(stopped)]
    assert sum("train/loss" in row for row in stopped) == after  # the step at which it stopped is in the log
    assert sum("val/abs_rel" in row for row in stopped) == after // BATCHES  # and so is the validation after it
    assert (tmp_path / "best.ckpt").exists() == (after == BATCHES)
    train(tmp_path, resume=True)
    same(whole, tmp_path)


def test_a_killed_run_knows_the_best_of_its_last_epoch_too(tmp_path: Path) -> None:
    """The order of the config's callbacks is that of `train`: last.ckpt holds the best of the epoch that it closes."""
    order = list(OmegaConf.load(config_dir() / "callbacks" / "default.yaml"))
    assert order.index("best") < order.index("last")
    trainer = train(tmp_path)
    stored = torch.load(tmp_path / "last.ckpt", weights_only=True)["callbacks"]["BestCheckpoint"]
    (best,) = (each for each in trainer.checkpoint_callbacks if isinstance(each, BestCheckpoint))
    assert stored["best_model_score"] == best.best_model_score
    assert stored["best_model_path"] == best.best_model_path


def test_asked_in_its_last_step_a_training_is_complete(whole: Path, tmp_path: Path) -> None:
    trainer = train(tmp_path, 2 * BATCHES)
    assert trainer.global_step == 2 * BATCHES
    same(whole, tmp_path)


@pytest.mark.parametrize(("every", "after"), [(3, 4), (1, 4)])
def test_a_validation_in_the_midst_of_an_epoch_is_made_before(
    every: int, after: int, uninterrupted: Callable[..., Path], tmp_path: Path
) -> None:
    whole, stopped = uninterrupted(val_check_interval=every), tmp_path / "stopped"
    with pytest.raises(Stopped, match=rf"after step {after}, everything is saved"):
        train(stopped, 3, val_check_interval=every)
    seen = rows(stopped)
    assert seen == rows(whole)[: len(seen)]
    assert sum("val/abs_rel" in row for row in seen) == after // every
    if every > 1:
        train(stopped, resume=True, val_check_interval=every)
        same(whole, stopped)


@pytest.mark.parametrize("hook", ["on_validation_batch_end", "on_validation_end"])
@pytest.mark.parametrize(
    ("step", "settings"),
    [(BATCHES, {}), (2 * BATCHES, {}), (3, {"val_check_interval": 3}), (BATCHES, {"val_check_interval": 3})],
)
def test_a_validation_that_a_kill_cut_short_is_made_up_for(
    hook: str, step: int, settings: dict[str, Any], uninterrupted: Callable[..., Path], tmp_path: Path
) -> None:
    whole, killed = uninterrupted(every=1, **settings), tmp_path / "killed"
    with pytest.raises(KilledError):
        train(killed, None, False, Kill(step, hook), every=1, **settings)
    with pytest.raises(KilledError):  # and once more
        train(killed, None, True, Kill(step, hook), every=1, **settings)
    train(killed, None, True, every=1, **settings)
    same(whole, killed)
    train(killed, None, True, every=1, **settings)  # a finished one stays as it is
    same(whole, killed)


def test_a_kill_after_a_warning_loses_no_validation_either(whole: Path, tmp_path: Path) -> None:
    with pytest.raises(KilledError):
        train(tmp_path, BATCHES, False, Kill(BATCHES, "on_validation_batch_end"))
    train(tmp_path, resume=True)
    same(whole, tmp_path)


@pytest.mark.parametrize("step", [1, BATCHES - 1, 2 * BATCHES - 1])
def test_a_kill_between_saving_a_step_and_logging_it_loses_no_row(
    step: int, uninterrupted: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, killed = uninterrupted(every=1), tmp_path / "killed"
    log = CSVLogger.log_metrics

    def strike(self: CSVLogger, metrics: Any, **more: Any) -> None:
        if "train/loss" in metrics and more["step"] == step:
            raise KilledError
        log(self, metrics=metrics, **more)

    with monkeypatch.context() as patch:
        patch.setattr(CSVLogger, "log_metrics", strike)
        with pytest.raises(KilledError):
            train(killed, every=1)
    train(killed, resume=True, every=1)
    same(whole, killed)


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        (
            {"limit_train_batches": 4},
            "max_epochs=2 of trainer.limit_train_batches=4 ended it at step 8, before trainer.max",
        ),
        ({"max_steps": 200}, "max_epochs=2 ended it at step 128, before trainer.max_steps=200"),
        ({"limit_train_batches": 5}, ""),
        ({"limit_train_batches": 4, "max_steps": -1}, ""),
    ],
)
def test_the_setting_that_ended_a_training_before_its_steps_is_named(limits: dict[str, int], words: str) -> None:
    quiet = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False, "limit_val_batches": 0}
    trainer = Trainer(accelerator="cpu", **{"max_steps": 10, "max_epochs": 2, **quiet, **limits})
    trainer.fit(BoringModel())  # 64 batches an epoch
    told = _ended_early(trainer)
    assert words in told if words else not told


LAST = [  # what ends two epochs of six batches, after which step, and the steps after which is validated
    ({"max_steps": 9}, 9, [6, 9]),
    ({"max_steps": 4}, 4, [4]),
    ({"max_steps": 8, "val_check_interval": 3}, 8, [3, 6, 8]),
    ({"max_steps": 9, "val_check_interval": 3}, 9, [3, 6, 9]),
    ({"val_check_interval": 5}, 12, [5, 11, 12]),
    ({"check_val_every_n_epoch": 5}, 12, [12]),
    ({"check_val_every_n_epoch": None, "val_check_interval": 7}, 12, [7, 12]),
    ({"accumulate_grad_batches": 2, "max_steps": 4}, 4, [3, 4]),
    ({"limit_val_batches": 0, "max_steps": 4}, 4, []),
]


@pytest.mark.parametrize(("settings", "end", "validated"), LAST)
def test_the_last_weights_are_validated_wherever_a_training_ends(
    settings: dict[str, Any], end: int, validated: list[int], tmp_path: Path
) -> None:
    trainer = train(tmp_path, every=0, **settings)
    assert trainer.global_step == end
    assert [int(row["step"]) + 1 for row in rows(tmp_path) if "val/abs_rel" in row] == validated
    last, best = (torch.load(tmp_path / name, weights_only=True) for name in ("last.ckpt", "best.ckpt"))
    assert last["global_step"] == end
    assert best["global_step"] in (validated or [end])
    assert not last["saunet_training"]["validation_due"]


class Enough(Callback):
    """Ask the trainer to end after a step, as a limit of time or early stopping do."""

    def __init__(self, step: int) -> None:
        self.step = step

    def on_train_batch_end(self, trainer: Trainer, *_: Any) -> None:
        trainer.should_stop = trainer.global_step == self.step


@pytest.mark.parametrize("every", [1, 5])
def test_a_training_that_is_told_to_end_is_validated_first(every: int, tmp_path: Path) -> None:
    train(tmp_path, None, False, Enough(4), check_val_every_n_epoch=every)
    assert [int(row["step"]) + 1 for row in rows(tmp_path) if "val/abs_rel" in row] == [4]
    assert torch.load(tmp_path / "best.ckpt", weights_only=True)["global_step"] == 4


@pytest.mark.parametrize(("steps", "validated"), [(4, [4]), (9, [BATCHES, 9])])
def test_a_training_goes_on_from_the_validation_at_its_end_as_if_there_had_been_none(
    steps: int, validated: list[int], tmp_path: Path
) -> None:
    one, other = tmp_path / "one", tmp_path / "other"
    for folder, batches in ((one, 2), (other, 0)):
        train(folder, max_steps=steps, limit_val_batches=batches)
        train(folder, resume=True)
    more = [row for row in rows(one) if row not in rows(other)]
    assert [int(row["step"]) + 1 for row in more] == validated
    assert all("val/abs_rel" in row for row in more)
    assert [row for row in rows(one) if row not in more] == rows(other)
    states = [torch.load(folder / "last.ckpt", weights_only=True)["state_dict"] for folder in (one, other)]
    assert all(torch.equal(value, states[1][name]) for name, value in states[0].items())
