"""``saunet report`` from the command line, on a run that was really trained."""

from __future__ import annotations

import contextlib
import io
import sys
from pathlib import Path
from typing import Any

import pytest
from processes import python

from saunet.cli import app, table
from saunet.cli.table import TOOLS
from saunet.cli.words import read_words
from saunet.errors import ConfigError
from saunet.reporting import collect


def tool(*given: str) -> tuple[int, str, str]:
    """Run ``saunet report`` here; return its exit code and what it said."""
    out, err, code, before = io.StringIO(), io.StringIO(), 0, sys.argv
    sys.argv = ["saunet"]
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            app.main(["report", *given])
    except SystemExit as exit_:
        code = int(exit_.code or 0)
    finally:
        sys.argv = before
    return code, out.getvalue(), err.getvalue()


def test_a_trained_run_becomes_a_page(smoke_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    pictures = smoke_run / "pictures" / "epoch_000.png"
    code, out, err = tool(str(smoke_run), "output_dir=page", f"scenes={{kitti: '{pictures}'}}", "title=Smoke")
    assert code == 0, err
    assert "report: page/report.html" in out
    assert "left out: Accuracy against time" in err
    assert "<title>Smoke</title>" in (tmp_path / "page" / "report.html").read_text()
    code, _, err = tool("compare", str(smoke_run))
    assert code == 1
    assert err.strip().endswith("or saunet report compare street A for the shipped model and a run")
    assert {path.name for path in tmp_path.iterdir()} <= {"page", "outputs"}


def test_a_run_with_a_folder_of_its_own_is_one_run_that_knows_itself(tool: Any, tmp_path: Path) -> None:
    outcome = tool(
        "train",
        *("experiment=smoke", "logger=default", "callbacks.pictures=null", "model/encoder=lite_mono_tiny"),
        *("model/pose=posecnn", "output_dir=runs/mine"),
    )
    assert outcome.code == 0, outcome.err
    assert not (tmp_path / "outputs").exists()
    (read,) = collect([tmp_path / "runs" / "mine"]).runs
    assert (read.path, read.component("model/encoder"), read.overrides["model/pose"]) == (
        tmp_path / "runs" / "mine", "lite_mono_tiny", "posecnn",
    )  # fmt: skip
    (score,) = read.scores
    assert (score.data, score.protocol) == ("synthetic_tiny, validation split", "synthetic")
    assert len(score.fingerprint) == 64


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (("gone",), "there is nothing at gone"),
        ((), "no run given; add folders of runs"),
        (("titel=x",), "did you mean 'title'"),
    ],
)
def test_mistakes_are_one_sentence(
    given: tuple[str, ...], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, _, err = tool(*given)
    assert code == 1
    assert words in err
    assert "Traceback" not in err


def test_scenes_that_are_no_images(tmp_path: Path) -> None:
    """In a process of its own: here the type checker of the tests would speak first."""
    done = python("-m", "saunet", "report", "scenes=3", ".", cwd=tmp_path)
    assert done.returncode == 1
    assert "scenes is 3 (int); it must be str | Sequence[str] | Mapping[str, " in done.stderr
    assert "Traceback" not in done.stderr


def test_plain_folders_become_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def read(*given: str) -> tuple[str, ...]:
        return tuple(read_words(given, TOOLS["report"], table.read())[1])

    monkeypatch.chdir(tmp_path)
    odd = tmp_path / "it's=odd"
    odd.mkdir()
    quoted = str(odd).replace("'", "\\'")
    assert read(str(odd), "flip=true") == ("flip=true", f"runs=['{quoted}']")
    assert read("--cfg", "job", "-cd", str(tmp_path), "runs=[a]") == ("runs=[a]",)
    with pytest.raises(ConfigError, match="given twice"):
        read("a", "runs=[b]")
