"""The progress bar of training: where it is drawn."""

from __future__ import annotations

from pathlib import Path

import pytest
import tiny

from saunet.training.callbacks import Progress


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
