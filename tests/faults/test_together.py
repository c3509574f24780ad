"""Several runs at once in one folder, and a clock that goes back."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from prepare_tree import make_tree
from tiny_checkpoint import write_checkpoint

from saunet.io.atomic import partial_name, remove_partial_files
from saunet.io.images import write_image
from saunet.prediction import PredictOptions, predict
from saunet.tools.prepare.tool import PrepareOptions, prepare


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def picture(seed: int) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 255, (40, 60, 3), np.uint8)


@pytest.mark.slow
@pytest.mark.parametrize("job", ["densify", "cache"])
def test_two_preparations_at_once_are_refused_or_correct(job: str, tmp_path: Path) -> None:
    make_tree(tmp_path / "raw")
    size = {"height": 40, "width": 64} if job == "cache" else {}
    how = {"job": job, "root": str(tmp_path / "raw"), "workers": 0, **size}
    prepare(PrepareOptions(**how, folder=str(tmp_path / "one")))  # type: ignore[arg-type]
    words = [job, f"root={how['root']}", "folder=two", "workers=0", *(f"{key}={value}" for key, value in size.items())]
    command = [sys.executable, "-m", "saunet", "prepare", *words]
    both = [subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    said = [each.communicate()[1] for each in both]
    codes = [each.returncode for each in both]
    assert 0 in codes
    assert all(code == 0 or "saunet prepare: " in text for code, text in zip(codes, said, strict=True))
    assert content(tmp_path / "two") == content(tmp_path / "one")


def test_files_of_living_processes_stay(tmp_path: Path) -> None:
    mine = tmp_path / partial_name("a", ".png")
    gone = tmp_path / mine.name.replace(str(os.getpid()), "4194303")
    for path in (mine, gone):
        path.touch()
    assert remove_partial_files(tmp_path) == [gone]
    assert list(tmp_path.iterdir()) == [mine]


def test_predictions_while_the_clock_goes_back(tmp_path: Path) -> None:
    """What was written before then seems to come from the future: it is kept, or made again, but never mixed up."""
    write_checkpoint(tmp_path / "x.ckpt")
    image = tmp_path / "in" / "a.png"
    write_image(image, picture(1))
    options = PredictOptions(
        checkpoint=tmp_path / "x.ckpt", input=tmp_path / "in", output=tmp_path / "out", device="cpu"
    )
    predict(options)
    assert "1 images were finished before" in str(predict(options))
    for path in [image, *(tmp_path / "out").iterdir()]:
        os.utime(path, (time.time() + 7200, time.time() + 7200))
    write_image(image, picture(2))  # its time is now before that of its results
    predict(options)
    changed = content(tmp_path / "out")
    predict(PredictOptions(**{**vars(options), "output": tmp_path / "new"}))
    assert changed == content(tmp_path / "new")
