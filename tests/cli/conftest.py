"""Running the command-line tools inside the test process, and one small training that several tests look at."""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import pytest
from rendered import share_renderings

from saunet.cli import app
from saunet.synthetic import SyntheticDrive
from saunet.synthetic.kitti_writer import write_raw


@dataclass(frozen=True)
class Outcome:
    """What a tool said and how it ended."""

    code: int
    out: str
    err: str

    def says(self, *words: str) -> None:
        """Check that it failed with one sentence of ours, which holds these words."""
        assert self.code == 1
        assert "Traceback" not in self.err
        assert "Error executing job" not in self.err  # Hydra's own words before ours
        sentence = self.err.strip().splitlines()[-1]
        assert sentence.startswith("saunet")
        for word in words:
            assert word in sentence


Tool = Callable[..., Outcome]
SMOKE = ("experiment=smoke", "model/pose=posecnn")


def run_tool(name: str, *overrides: str, folder: Path) -> Outcome:
    """Run ``saunet <name>`` in ``folder``."""
    out, err, code = io.StringIO(), io.StringIO(), 0
    before, arguments = Path.cwd(), sys.argv
    os.chdir(folder)
    sys.argv = ["saunet"]
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), mock.patch.dict(os.environ):
            app.run(name, overrides)  # a training leaves its seed in the environment
    except SystemExit as exit_:
        code = int(exit_.code or 0)
    finally:
        os.chdir(before)
        sys.argv = arguments
    return Outcome(code, out.getvalue(), err.getvalue())


@pytest.fixture(scope="session", autouse=True)
def _rendered_once() -> Iterator[None]:
    """Let equal synthetic drives share their worlds and frames: each tool renders what one before it has rendered."""
    with share_renderings():
        yield


@pytest.fixture
def tool(tmp_path: Path) -> Tool:
    """Run a tool in an empty folder: ``tool("train", "experiment=smoke").code``."""

    def run_here(name: str, *overrides: str) -> Outcome:
        return run_tool(name, *overrides, folder=tmp_path)

    return run_here


@pytest.fixture(scope="session")
def smoke_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of one finished smoke experiment, with a pose network whose checkpoint is soon written."""
    folder = tmp_path_factory.mktemp("smoke")
    outcome = run_tool("train", *SMOKE, folder=folder)
    assert outcome.code == 0, outcome.err
    return next((folder / "outputs" / "smoke").iterdir())


@pytest.fixture(scope="session")
def written_raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("written") / "raw"
    write_raw(root, [SyntheticDrive(seed=seed, frames=6, height=64, width=96) for seed in (1, 2)])
    return root


@pytest.fixture
def raw_root(written_raw: Path, tmp_path: Path) -> Path:
    """Two short synthetic drives on disk in KITTI's raw layout, which the test may spoil."""
    shutil.copytree(written_raw, tmp_path / "raw")
    return tmp_path / "raw"
