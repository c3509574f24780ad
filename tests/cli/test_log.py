"""The log of a run's folder."""

from __future__ import annotations

import logging
import os
import warnings
from pathlib import Path

import pytest

from saunet.cli.log import RunLog, quiet
from saunet.io.said import PRINTED, say


def _said(text: str) -> logging.LogRecord:
    return logging.LogRecord("saunet", logging.INFO, __file__, 1, text, None, None)


def test_what_was_said_before_the_folder_existed_is_in_the_log(tmp_path: Path) -> None:
    """A tool may say nothing more once it has made its folder."""
    log = RunLog(str(tmp_path / "run" / "evaluate.log"))
    log.emit(_said("6 frames used"))
    (tmp_path / "run").mkdir()
    log.close()
    assert "6 frames used" in (tmp_path / "run" / "evaluate.log").read_text()


def test_a_tool_that_makes_no_folder_leaves_none(tmp_path: Path) -> None:
    log = RunLog(str(tmp_path / "run" / "evaluate.log"))
    log.emit(_said("6 frames used"))
    log.close()
    assert not (tmp_path / "run").exists()


def test_a_tool_that_is_refused_adds_no_line_to_the_log_of_an_earlier_run(tmp_path: Path) -> None:
    file = tmp_path / "train.log"
    file.write_text("of an earlier run\n")
    os.utime(tmp_path, (0, 0))
    log = RunLog(str(file))
    log.emit(_said("6 frames used"))
    log.close()
    assert file.read_text() == "of an earlier run\n"
    log = RunLog(str(file))
    log.emit(_said("6 frames used"))
    (tmp_path / "run.json").touch()  # the checks have passed
    log.emit(_said("epoch 1"))
    assert file.read_text().splitlines() == ["of an earlier run", "6 frames used", "epoch 1"]


def test_what_is_printed_and_warned_of_is_in_the_log_and_once_on_the_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(warnings, "formatwarning", warnings.formatwarning)  # put back afterwards
    log = RunLog(str(tmp_path / "run" / "train.log"))
    (tmp_path / "run").mkdir()
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.showwarning = lambda message, *_: print(f"on the terminal: {message}")
        quiet()
        quiet()  # before each job of a sweep
        say("resuming from last.ckpt")
        warnings.warn_explicit("the frame rate is unknown", UserWarning, "/x/saunet/module.py", 3)
    log.close()
    kept = (tmp_path / "run" / "train.log").read_text()
    shown = capsys.readouterr().out
    for line in ("resuming from last.ckpt", "the frame rate is unknown"):
        assert kept.count(line) == shown.count(line) == 1
    assert log not in PRINTED.handlers


def test_a_warning_is_one_line_without_its_place_in_the_code(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warnings, "formatwarning", warnings.formatwarning)  # put back afterwards
    quiet()
    said = warnings.formatwarning("the frame rate is unknown", UserWarning, "/x/saunet/data/video/module.py", 419)
    assert said == "warning: the frame rate is unknown\n"
    assert "torch/nn.py:3" in warnings.formatwarning("soon gone", FutureWarning, "/x/torch/nn.py", 3)
