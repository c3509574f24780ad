"""``saunet export``: files that are the model, a report and a card; and what is refused."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import saunet
from saunet.cli import app


@pytest.fixture
def export(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> Callable[..., tuple[int, str, str]]:
    """Run the tool in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def run(*overrides: str) -> tuple[int, str, str]:
        code = 0
        try:
            app.run("export", overrides)
        except SystemExit as exit_:
            code = int(exit_.code or 0)
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run


def test_a_trained_model_becomes_a_folder(
    export: Callable[..., tuple[int, str, str]], smoke_run: Path, tmp_path: Path
) -> None:
    checkpoint = smoke_run / "checkpoints" / "best.ckpt"
    arguments = (f"checkpoint={checkpoint}", "output=model", "formats=[safetensors]")
    code, out, err = export(*arguments)
    assert code == 0, err
    assert "so only random images were compared" in err
    steps = ["making model.safetensors", "checking it", r"differs by 0\.0e\+00 of its range; \d+\.\d s", "timing"]
    assert re.search(".*\n.*".join(steps), err), err  # a line each, in a pipe
    assert re.search(r"model\.safetensors +\d+\.\d +any +0\.0e\+00 +2 +0 +\d+\.\d +\d+\.\d", out), out
    assert saunet.load(tmp_path / "model").fingerprint == saunet.load(checkpoint).fingerprint
    assert json.loads((tmp_path / "model" / "report.json").read_text())["files"][0]["difference"] == 0
    card = (tmp_path / "model" / "README.md").read_text()
    assert "synthetic" in card
    splits = json.loads((smoke_run / "run.json").read_text())["splits"]
    assert f"frames of split 'train': `{splits['train']}`" in card
    assert [path.name for path in tmp_path.iterdir() if path.name != "model"] == []  # no run folder, no log
    code, _, err = export(*arguments)
    assert code == 1
    assert "model already has config.json; choose another output folder, or set overwrite=true" in err


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("formats=[onx]", "formats is 'onx'; did you mean 'onnx'"),
        ("batch=two", "batch is 'two', allowed: auto, any, one"),
        ("images=nothing/", "no file or folder at nothing"),
        ("evaluation=nothing", "cannot read nothing"),
        ("foramts=[onnx]", "unknown key 'foramts'; did you mean 'formats'"),
    ],
)
def test_refused(export: Callable[..., tuple[int, str, str]], smoke_run: Path, override: str, words: str) -> None:
    code, _, err = export(f"checkpoint={smoke_run / 'checkpoints' / 'best.ckpt'}", "output=model", override)
    assert code == 1
    assert words in err
    assert not Path("model").exists()


def test_not_a_checkpoint(export: Callable[..., tuple[int, str, str]], tmp_path: Path) -> None:
    (tmp_path / "x.ckpt").write_bytes(b"hello")
    code, _, err = export("checkpoint=x.ckpt", "output=model")
    assert code == 1
    assert err.strip().splitlines()[-1].startswith("saunet export: x.ckpt")
