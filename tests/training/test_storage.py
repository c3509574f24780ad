"""Checkpoints through Lightning: the same content, and a failure that costs nothing that was there."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import pytest
import torch
from lightning import Trainer
from lightning.pytorch.plugins.io import TorchCheckpointIO

from saunet.data.loading.module import DepthDataModule
from saunet.errors import CheckpointError, ConfigError
from saunet.runs.checkpoint import read_checkpoint
from saunet.training.callbacks import AtomicCheckpointIO
from saunet.training.module import SelfSupervisedDepth


@pytest.fixture
def trainer(make_trainer: Callable[..., Trainer], model: SelfSupervisedDepth) -> Trainer:
    """A trainer with the plugin that knows a model, as after training."""
    trainer = make_trainer(max_epochs=1, plugins=[AtomicCheckpointIO()])
    trainer.strategy.connect(model)
    return trainer


def same(left: Any, right: Any) -> bool:
    if isinstance(left, dict):
        return left.keys() == right.keys() and all(same(left[key], right[key]) for key in left)
    return torch.equal(left, right) if isinstance(left, torch.Tensor) else bool(left == right)


def test_it_holds_what_lightning_itself_would_write(
    trainer: Trainer, make_trainer: Callable[..., Trainer], model: SelfSupervisedDepth, tmp_path: Path
) -> None:
    trainer.save_checkpoint(tmp_path / "new" / "ours.ckpt")
    plain = make_trainer(max_epochs=1)
    plain.strategy.connect(model)
    plain.save_checkpoint(tmp_path / "theirs.ckpt")
    loaded = [
        TorchCheckpointIO().load_checkpoint(tmp_path / name, weights_only=True)
        for name in ("new/ours.ckpt", "theirs.ckpt")
    ]
    assert same(*loaded)
    depth, _ = read_checkpoint(tmp_path / "new" / "ours.ckpt").networks()
    assert same(dict(depth.state_dict()), dict(model.depth.state_dict()))
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["ours.ckpt"]


def test_training_goes_on_from_it(
    make_trainer: Callable[..., Trainer], model: SelfSupervisedDepth, walls: DepthDataModule, tmp_path: Path
) -> None:
    first = make_trainer(max_epochs=1, limit_train_batches=1, limit_val_batches=0, plugins=[AtomicCheckpointIO()])
    first.fit(model, datamodule=walls)
    first.save_checkpoint(tmp_path / "x.ckpt")
    second = make_trainer(max_epochs=2, limit_train_batches=1, limit_val_batches=0, plugins=[AtomicCheckpointIO()])
    second.fit(model, datamodule=walls, ckpt_path=str(tmp_path / "x.ckpt"), weights_only=True)
    assert second.global_step == 2 * first.global_step > 0


def test_a_full_disk_keeps_the_old_file(trainer: Trainer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "last.ckpt"
    trainer.save_checkpoint(path)
    before = path.read_bytes()

    def full(content: object, stream: BinaryIO) -> None:
        stream.write(before[: len(before) // 2])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(CheckpointError, match=r"cannot write .*last\.ckpt: No space left on device") as error:
        trainer.save_checkpoint(path)
    assert "\n" not in str(error.value)
    assert path.read_bytes() == before
    assert [each.name for each in tmp_path.iterdir()] == ["last.ckpt"]


def test_a_missing_right_is_not_passed_over(trainer: Trainer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "last.ckpt"
    trainer.save_checkpoint(path)
    before = path.read_bytes()

    def refuse(*_: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(CheckpointError, match=r"cannot write .*last\.ckpt: Permission denied"):
        trainer.save_checkpoint(path)
    assert path.read_bytes() == before
    assert [each.name for each in tmp_path.iterdir()] == ["last.ckpt"]


def test_an_address_is_left_to_lightning(tmp_path: Path) -> None:
    AtomicCheckpointIO().save_checkpoint({"a": 1}, "memory://somewhere/x.ckpt")
    assert AtomicCheckpointIO().load_checkpoint("memory://somewhere/x.ckpt", weights_only=True) == {"a": 1}
    assert list(tmp_path.iterdir()) == []


def test_storage_options_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="storage_options is 3"):
        AtomicCheckpointIO().save_checkpoint({}, tmp_path / "x.ckpt", storage_options=3)
