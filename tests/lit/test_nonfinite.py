"""A NaN or infinite loss: the batch is kept with its names, the run stops, or the step leaves no trace."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import tiny
import torch
from lightning import Callback, LightningModule, Trainer

from saunet.checks import SaunetError
from saunet.lit.callbacks import LastCheckpoint
from saunet.lit.nonfinite import NonFinite


class Spoil(Callback):
    """Put NaN into the images of some batches."""

    def __init__(self, *batches: int) -> None:
        self.batches = batches

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        if trainer.fit_loop.total_batch_idx + 1 in self.batches:
            batch["target"].fill_(torch.nan)


def fit(folder: Path, *callbacks: Callback, epochs: int = 2) -> Any:
    model = tiny.tiny_model()
    saved = LastCheckpoint(str(folder), every_n_steps=1)
    trainer = tiny.tiny_trainer(folder, max_epochs=epochs, limit_val_batches=0, callbacks=[*callbacks, saved])
    trainer.fit(model, tiny.tiny_walls())
    return model


def test_the_run_stops_with_the_names_and_keeps_the_batch(tmp_path: Path) -> None:
    with pytest.raises(
        SaunetError, match=r"NaN or infinite at step 3 \(batch: train \d .*; kept as (.*)\); look at"
    ) as e:
        fit(tmp_path, Spoil(3), NonFinite(str(tmp_path / "bad")))
    assert "\n" not in str(e.value)
    (file,) = (tmp_path / "bad").iterdir()
    kept = torch.load(file, weights_only=True)
    assert (kept["step"], kept["epoch"]) == (3, 0)
    assert kept["batch"]["target"].isnan().all()
    assert all(name.startswith("train") for name in kept["batch"]["name"])
    stored = torch.load(tmp_path / "last.ckpt", weights_only=True)  # of the step before: not overwritten by NaN
    assert stored["global_step"] == 2
    assert all(value.isfinite().all() for value in stored["state_dict"].values())


def test_a_skipped_step_leaves_no_trace(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    class Notice(Callback):
        def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
            moments = trainer.optimizers[0].state_dict()["state"]
            weights = {name: value.clone() for name, value in pl_module.state_dict().items()}
            states.append((weights, {key: value["exp_avg"].clone() for key, value in moments.items()}))

    states: list[Any] = []
    with caplog.at_level("INFO"):
        fit(tmp_path, Spoil(3), NonFinite(str(tmp_path / "bad"), action="skip"), Notice())
    (before, moments), (after, moments_after), (later, _) = states[1:4]
    assert all(torch.equal(before[name], after[name]) for name in before)  # batch norm's statistics among them
    assert all(torch.equal(moments[key], moments_after[key]) for key in moments)
    assert not all(torch.equal(after[name], later[name]) for name in later)
    assert all(value.isfinite().all() for value in later.values())
    assert any("the step is skipped" in record.getMessage() for record in caplog.records)
    assert len(list((tmp_path / "bad").iterdir())) == 1


def test_skipping_does_not_go_on_for_ever(tmp_path: Path) -> None:
    with pytest.raises(SaunetError, match=r"3 steps in a row were skipped, so the run ends"):
        fit(tmp_path, Spoil(*range(2, 9)), NonFinite(str(tmp_path / "bad"), action="skip", patience=3), epochs=3)


def test_where_the_batch_cannot_be_kept_the_sentence_says_so(tmp_path: Path) -> None:
    (tmp_path / "bad").write_text("in the way")
    with pytest.raises(SaunetError, match=r"NaN or infinite at step 1 .*cannot write"):
        fit(tmp_path, Spoil(1), NonFinite(str(tmp_path / "bad")))
