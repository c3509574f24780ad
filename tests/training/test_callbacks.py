"""The progress bar of training: where it is drawn."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import tiny

from saunet.training.callbacks import Progress
from saunet.training.loop import EpochLoop


@pytest.mark.parametrize("terminal", [True, False])
def test_the_bar_is_drawn_on_a_terminal_only(
    terminal: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TERM", "xterm")
    if terminal:
        monkeypatch.setenv("FORCE_COLOR", "1")  # rich then takes standard output for a terminal
    else:
        monkeypatch.delenv("FORCE_COLOR", raising=False)
    trainer = tiny.tiny_trainer(tmp_path, max_epochs=1, callbacks=[Progress(refresh_rate=1)], enable_progress_bar=True)
    trainer.fit(tiny.tiny_model(), tiny.tiny_walls())
    written = capsys.readouterr()
    assert ("loss=" in written.out) is terminal
    if not terminal:
        assert "\r" not in written.out + written.err


def test_without_a_terminal_lines_say_where_the_training_is(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    clock = iter(range(0, 1000, 6))  # six seconds between two looks at the clock
    monkeypatch.setattr("saunet.training.callbacks.time.monotonic", lambda: float(next(clock)))
    trainer = tiny.tiny_trainer(tmp_path, max_epochs=2, callbacks=[Progress()], enable_progress_bar=True)
    with caplog.at_level("INFO"):
        trainer.fit(tiny.tiny_model(), tiny.tiny_walls())
    lines = [record.getMessage() for record in caplog.records if record.getMessage().startswith("epoch ")]
    rows = [line for line in lines if "val/loss" in line]
    assert len(lines) > 2
    assert any(line.startswith("epoch 1/2, step 2, loss ") and "time left" in line for line in lines)
    assert any(line.startswith("epoch 1/2, step 3, loss ") and "val/abs_rel" in line for line in rows)
    assert lines[-1].startswith("epoch 2/2, step 6, loss ")
    assert lines[-1].endswith("time left 0:00:00")


@pytest.mark.parametrize("limits", [{"max_epochs": 2}, {"max_epochs": -1, "max_steps": 5}])
def test_every_step_has_one_line_and_the_last_of_an_epoch_the_new_validation(
    limits: dict[str, int], tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    monkeypatch.setattr("saunet.training.callbacks.EVERY", 0.0)
    trainer = tiny.tiny_trainer(tmp_path, **limits, callbacks=[Progress()], enable_progress_bar=True)
    with caplog.at_level("INFO"):
        EpochLoop.install(trainer).fit(tiny.tiny_model(), tiny.tiny_walls())
    lines = [record.getMessage() for record in caplog.records if record.getMessage().startswith("epoch ")]
    steps = [int(re.findall(r"step (\d+)", line)[0]) for line in lines]
    assert steps == list(range(1, limits.get("max_steps", 6) + 1))
    assert f"val/loss {float(trainer.callback_metrics['val/loss']):.4f}" in lines[-1]


def test_the_time_left_ends_with_the_last_step(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    clock = iter(range(0, 1000, 6))
    monkeypatch.setattr("saunet.training.callbacks.time.monotonic", lambda: float(next(clock)))
    for epochs in (80, -1):
        limits = {"max_epochs": epochs, "max_steps": 3}
        trainer = tiny.tiny_trainer(tmp_path, **limits, callbacks=[Progress()], enable_progress_bar=True)
        with caplog.at_level("INFO"):
            trainer.fit(tiny.tiny_model(), tiny.tiny_walls())
        lines = [record.getMessage() for record in caplog.records if record.getMessage().startswith("epoch ")]
        assert lines[-1].endswith("time left 0:00:00")
        caplog.clear()
