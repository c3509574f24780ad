"""A NaN or infinite loss or gradient: the batch is kept with its names, the run stops, or the step leaves no trace."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import pytest
import tiny
import torch
from lightning import Callback, LightningModule, Trainer
from processes import python

from saunet.errors import SaunetError
from saunet.training.callbacks import LastCheckpoint
from saunet.training.nonfinite import NonFinite
from saunet.training.stopping import GracefulStop


class Spoil(Callback):
    """Put NaN into the images of some batches."""

    def __init__(self, *batches: int) -> None:
        self.batches = batches

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        if trainer.fit_loop.total_batch_idx + 1 in self.batches:
            batch["target"].fill_(torch.nan)


def fit(folder: Path, *callbacks: Callback, epochs: int = 2, batch_size: int = 4, **trainer_settings: Any) -> Any:
    model = tiny.tiny_model()
    saved = LastCheckpoint(str(folder), every_n_steps=1)
    settings = {"max_epochs": epochs, "limit_val_batches": 0, **trainer_settings}
    tiny.tiny_trainer(folder, callbacks=[*callbacks, saved], **settings).fit(
        model, tiny.tiny_walls(batch_size=batch_size)
    )
    return model


def finite(folder: Path) -> int:
    """Check that ``last.ckpt`` holds numbers only, and return the step after which it was saved."""
    stored = torch.load(folder / "last.ckpt", weights_only=True)
    assert all(value.isfinite().all() for value in stored["state_dict"].values())
    return int(stored["global_step"])


def test_the_run_stops_with_the_names_and_keeps_the_batch(tmp_path: Path) -> None:
    with pytest.raises(
        SaunetError, match=r"NaN or infinite at step 3 \(batch: train \d .*; kept as (.*)\); check the"
    ) as e:
        fit(tmp_path, Spoil(3), NonFinite(str(tmp_path / "bad")))
    assert "\n" not in str(e.value)
    (file,) = (tmp_path / "bad").iterdir()
    kept = torch.load(file, weights_only=True)
    assert (kept["step"], kept["epoch"]) == (3, 0)
    assert kept["batch"]["target"].isnan().all()
    assert all(name.startswith("train") for name in kept["batch"]["name"])
    assert finite(tmp_path) == 2  # of the step before: not overwritten by NaN


def test_a_stop_that_is_asked_for_in_the_bad_step_saves_no_nan(tmp_path: Path) -> None:
    class Ask(Callback):
        def on_train_batch_start(self, trainer: Trainer, *_: Any) -> None:
            if trainer.fit_loop.total_batch_idx + 1 == 3:
                os.kill(os.getpid(), signal.SIGTERM)

    order = [Spoil(3), Ask(), GracefulStop(str(tmp_path)), NonFinite(str(tmp_path / "bad"))]
    with pytest.raises(SaunetError, match=r"NaN or infinite at step 3"):
        fit(tmp_path, *order)
    assert finite(tmp_path) == 2


class Overflow(Callback):
    """Put infinity into a gradient in some optimizer steps."""

    def __init__(self, *steps: int) -> None:
        self.steps = steps
        self.names: list[str] = []

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        if trainer.global_step + 1 in self.steps:
            self.names.extend(batch["name"])

    def on_after_backward(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.global_step + 1 in self.steps:
            gradient = next(pl_module.parameters()).grad
            assert gradient is not None
            gradient.fill_(torch.inf)


@pytest.mark.parametrize("step", [4, 6])  # in the midst, and in the last step of the training
def test_an_infinite_gradient_of_a_finite_loss_is_not_saved_either(step: int, tmp_path: Path) -> None:
    overflow = Overflow(step)
    with pytest.raises(SaunetError, match=rf"finite, but its gradient became NaN or infinite at step {step} ") as e:
        fit(tmp_path, overflow, NonFinite(str(tmp_path / "bad")))
    assert f"(batch: {', '.join(overflow.names)}; kept as" in str(e.value)
    (file,) = (tmp_path / "bad").iterdir()
    assert torch.load(file, weights_only=True)["batch"]["name"] == overflow.names
    assert finite(tmp_path) == step - 1


def test_what_a_loss_scaler_leaves_out_is_no_reason_to_stop(tmp_path: Path) -> None:
    class Seen(Callback):
        def on_before_optimizer_step(self, trainer: Trainer, *_: Any) -> None:
            trainer.precision_plugin.scaler = object()  # type: ignore[attr-defined]

        def on_train_batch_end(self, trainer: Trainer, *_: Any) -> None:
            steps.append(trainer.global_step)

    class Undone(Callback):
        def on_before_optimizer_step(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
            for parameter in pl_module.parameters():
                if parameter.grad is not None:
                    parameter.grad.nan_to_num_(0, 0, 0)  # the scaler's part

    steps: list[int] = []
    fit(tmp_path, Seen(), Overflow(2), NonFinite(str(tmp_path / "bad")), Undone())
    assert steps[-1] == 6


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


@pytest.mark.parametrize("action", ["stop", "skip"])
@pytest.mark.parametrize("spoiled", [4, 5])
def test_of_accumulated_batches_the_spoiled_one_is_named(
    action: Any, spoiled: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    class Notice(Callback):
        def on_train_batch_end(
            self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, _: Any
        ) -> None:
            names.append(batch["name"])
            states.append({name: value.clone() for name, value in pl_module.state_dict().items()})

    names: list[list[str]] = []
    states: list[dict[str, torch.Tensor]] = []
    callbacks = [Spoil(spoiled), Notice(), NonFinite(str(tmp_path / "bad"), action=action)]
    settings = {"epochs": 2, "batch_size": 2, "accumulate_grad_batches": 3}
    with caplog.at_level("INFO"):
        if action == "stop":
            with pytest.raises(SaunetError) as e:
                fit(tmp_path, *callbacks, **settings)
            said = [str(e.value)]
            assert finite(tmp_path) == 1
        else:
            fit(tmp_path, *callbacks, **settings)
            said = [record.getMessage() for record in caplog.records if "NaN" in record.getMessage()]
            assert all(torch.equal(before, states[5][name]) for name, before in states[2].items())
            assert finite(tmp_path) == 4
    assert len(said) == 1
    assert f"the loss became NaN or infinite at step 2 (batch: {', '.join(names[spoiled - 1])}; kept as" in said[0]
    (file,) = (tmp_path / "bad").iterdir()
    assert torch.load(file, weights_only=True)["batch"]["target"].isnan().all()


@pytest.mark.ddp
@pytest.mark.parametrize("action", ["stop", "skip"])
def test_of_two_processes_the_spoiled_one_is_named_and_nothing_broken_is_saved(action: str, tmp_path: Path) -> None:
    script = Path(__file__).parents[1] / "helpers" / "ddp_nonfinite.py"
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = python(str(script), str(tmp_path), action, env=environment)
    innocent, spoiled = ((tmp_path / f"names_{rank}").read_text() for rank in (0, 1))
    assert innocent != spoiled
    named = f"the loss became NaN or infinite at step 3 (batch of process 1: {spoiled}; kept as "
    if action == "stop":
        assert done.returncode == 1, done.stderr[-3000:]
        assert (tmp_path / "end_0").read_text().startswith(named)  # the first process, whose record it is, knows too
        assert finite(tmp_path) == 2
    else:
        assert done.returncode == 0, done.stderr[-3000:]
        assert done.stderr.count(named) == 1
        assert finite(tmp_path) == 6
    assert [file.name for file in (tmp_path / "bad").iterdir()] == ["step_3_process_1.pt"]


def test_skipping_does_not_go_on_for_ever(tmp_path: Path) -> None:
    with pytest.raises(SaunetError, match=r"3 steps in a row were skipped, so the run ends"):
        fit(tmp_path, Spoil(*range(2, 9)), NonFinite(str(tmp_path / "bad"), action="skip", patience=3), epochs=3)


def test_where_the_batch_cannot_be_kept_the_sentence_says_so(tmp_path: Path) -> None:
    (tmp_path / "bad").write_text("in the way")
    with pytest.raises(SaunetError, match=r"NaN or infinite at step 1 .*cannot write"):
        fit(tmp_path, Spoil(1), NonFinite(str(tmp_path / "bad")))
