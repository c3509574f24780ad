"""``saunet report`` from the command line, on a run that was really trained."""

from __future__ import annotations

import contextlib
import io
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from saunet.cli._app import run
from saunet.cli._runs import arguments, planned_jobs
from saunet.cli.report import report
from saunet.errors import ConfigError
from saunet.reporting import collect


def tool(*given: str) -> tuple[int, str, str]:
    """Run ``saunet report`` here; return its exit code and what it said."""
    out, err, code, before = io.StringIO(), io.StringIO(), 0, sys.argv
    sys.argv = ["saunet report", *arguments(given)]
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            run("report", report)
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
    assert "left out: Fig. 10" in err
    assert "<title>Smoke</title>" in (tmp_path / "page" / "report.html").read_text()
    code, _, err = tool("compare", str(smoke_run))
    assert code == 1
    assert err.strip().endswith("name two or more: saunet report compare A B")
    assert {path.name for path in tmp_path.iterdir()} <= {"page", "outputs"}


def test_a_run_with_a_folder_of_its_own_is_one_run_that_knows_itself(tool: Any, tmp_path: Path) -> None:
    outcome = tool(
        "train",
        *("experiment=smoke", "logger=default", "callbacks.pictures=null", "model/encoder=resnet18"),
        *("model/pose=posecnn", "output_dir=runs/mine"),
    )
    assert outcome.code == 0, outcome.err
    (read,) = collect([tmp_path / "outputs", tmp_path / "runs" / "mine"], jobs=planned_jobs).runs
    assert (read.path, read.component("model/encoder"), read.overrides["model/pose"]) == (
        tmp_path / "runs" / "mine", "resnet18", "posecnn",
    )  # fmt: skip
    (score,) = read.scores
    assert (score.data, score.protocol) == ("synthetic_tiny, validation split", "synthetic")
    assert len(score.fingerprint) == 64


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (("gone",), "there is nothing at gone"),
        ((), "runs is not set"),
        (("scenes=3", "."), "give images by condition"),
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


def test_plain_folders_become_runs(tmp_path: Path) -> None:
    odd = tmp_path / "it's=odd"
    odd.mkdir()
    quoted = str(odd).replace("'", "\\'")
    assert arguments([str(odd), "flip=true"]) == ["flip=true", f"runs=['{quoted}']"]
    assert arguments(["--cfg", "job", "-cd", str(tmp_path), "runs=[a]"]) == [
        "--cfg",
        "job",
        "-cd",
        str(tmp_path),
        "runs=[a]",
    ]
    assert arguments(["compare", "a", "b"])[0] == "compare=true"
    with pytest.raises(ConfigError, match="named twice"):
        arguments(["a", "runs=[b]"])


def test_the_jobs_of_a_sweep_are_known_from_its_config(tmp_path: Path) -> None:
    hydra = {
        "sweeper": {"_target_": "hydra._internal.core_plugins.basic_sweeper.BasicSweeper", "params": {"loss": "a,b"}},
        "overrides": {"task": ["seed=1,2", "experiment=smoke"]},
    }
    (tmp_path / "multirun.yaml").write_text(yaml.safe_dump({"hydra": hydra}))
    jobs = planned_jobs(tmp_path)
    assert jobs is not None
    assert jobs[1] == ["loss=a", "seed=2", "experiment=smoke"]
    assert len(jobs) == 4
    hydra["sweeper"]["_target_"] = "optuna"  # type: ignore[index]
    (tmp_path / "multirun.yaml").write_text(yaml.safe_dump({"hydra": hydra}))
    assert planned_jobs(tmp_path) is None
    assert planned_jobs(tmp_path / "gone") is None
