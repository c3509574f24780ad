"""Tests of the progress bar: where it is shown, and what it says."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest

from saunet.io import progress
from saunet.io.progress import bar


def test_without_a_terminal_nothing_is_written(capsys: pytest.CaptureFixture[str]) -> None:
    with bar() as shown:
        shown.advance(shown.add_task("work", total=2))
    assert capsys.readouterr() == ("", "")


def test_on_a_terminal_it_counts_on_standard_error(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")  # rich then takes standard error for a terminal
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "200")
    with bar(unit="images", taken=True) as shown:
        shown.advance(shown.add_task("work", total=2))
    written = capsys.readouterr()
    assert written.out == ""
    assert all(part in written.err for part in ("work", "1/2", "images", "-:--:--"))
    assert re.search(r"\d:\d\d:\d\d", written.err)  # the time taken, however long a busy machine takes
    assert "\x1b[2K" in written.err.rpartition("1/2")[2]  # and is wiped away

    with bar() as shown:
        shown.advance(shown.add_task("work", total=2))
    written = capsys.readouterr()
    assert "1/2" in written.err
    assert "images" not in written.err
    assert not re.search(r"\d:\d\d:\d\d", written.err)

    with bar(show=False) as shown:
        shown.advance(shown.add_task("work", total=2))
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("widgets", [True, False])
def test_in_a_notebook_it_needs_widgets(widgets: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    monkeypatch.setattr(progress, "find_spec", lambda name: object() if widgets else None)
    assert bar().disable is not widgets


def test_it_costs_rich_alone() -> None:
    code = (
        "import sys; import saunet.io.progress; print([m for m in ('cv2', 'hydra', 'lightning') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
