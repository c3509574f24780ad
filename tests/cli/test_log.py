"""The log of a run's folder."""

from __future__ import annotations

import logging
from pathlib import Path

from saunet.cli.log import RunLog


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
