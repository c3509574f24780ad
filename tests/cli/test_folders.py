"""A command that fails leaves the user's folders as they were."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

Tool = Callable[..., Any]


def content(folder: Path) -> dict[str, bytes | None]:
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


@pytest.mark.parametrize("key", ["hydra.run.dir", "output_dir"])
def test_a_folder_that_was_there_stays_as_it_was(tool: Tool, tmp_path: Path, key: str) -> None:
    (tmp_path / "d" / "slurm").mkdir(parents=True)
    (tmp_path / "d" / "notes.log").write_text("important")
    (tmp_path / "d" / "train.log").write_text("of an earlier run")
    before = content(tmp_path)
    tool("train", "experiment=smoke", f"{key}=d", "data.height=90").says("nearest valid size is 96x96")
    assert content(tmp_path) == before


def test_the_config_of_an_earlier_run_is_put_back(tool: Tool, tmp_path: Path) -> None:
    (tmp_path / "d" / ".hydra").mkdir(parents=True)
    (tmp_path / "d" / ".hydra" / "overrides.yaml").write_text("- earlier=run\n")
    (tmp_path / "d" / "run.json").write_text("{}")
    tool("evaluate", "hydra.run.dir=d", "checkpoint=nowhere.ckpt").says("nowhere.ckpt")
    assert (tmp_path / "d" / ".hydra" / "overrides.yaml").read_text() == "- earlier=run\n"
    assert (tmp_path / "d" / "run.json").read_text() == "{}"


def test_an_empty_folder_that_was_there_stays(tool: Tool, tmp_path: Path) -> None:
    (tmp_path / "d").mkdir()
    tool("train", "experiment=smoke", "hydra.run.dir=d", "data.height=90").says("96x96")
    assert content(tmp_path) == {"d": None}
