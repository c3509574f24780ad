"""The tutorials' commands as the pages print them, one after the other, with a reader's files at hand.

Each is only made short, by settings that the pages explain. ``nox -s first_hour`` runs them in an environment of their
own, in which the wheel and nothing else is installed; SAUNET_FIRST_HOUR is its Python.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import board_views
import numpy as np
import pytest
from pages import blocks, commands
from processes import python
from tiny_checkpoint import component_node
from videos import write_video

from saunet.io.images import write_image
from saunet.runs.checkpoint import atomic_save, build_networks
from saunet.synthetic import SyntheticDrive
from saunet.synthetic.kitti_writer import write_raw
from saunet.tools.calibrate.solve import Board
from saunet.tools.prepare.targets import densify
from saunet.tools.prepare.tool import kitti_recordings
from saunet.weights.files import read_model

PYTHON = os.environ.get("SAUNET_FIRST_HOUR", "")
SHORT = {
    "train": "model=sau_net_nano model.encoder.weights=null model.pose.weights=null epochs=1 batch=2 size=64x96 "
    "data.workers=0 trainer.limit_train_batches=1 trainer.limit_val_batches=1",
    "evaluate": "data.workers=0",
}
"""Tool -> settings that make it short."""
KITTI = "split=all val_drives=[2011_09_26_drive_0002_sync]"
"""The frames of a KITTI that has two drives."""
TUTORIALS = ["README.md", "your_camera.md", "kitti.md", "scale.md", "add_dataset.md"]
ALIGNED = "needs a longer drive with stops: tests/cli/test_scale.py, tests/data/test_clock.py"
ELSEWHERE = {
    "saunet train trainer=ddp data=kitti data.root=/data/kitti": "tests/training/test_ddp.py starts two processes",
    "saunet train -m 'experiment=glob(table3/*)' data.root=/data/kitti": "networks.md trains them on rendered frames",
    "saunet calibrate video=drive.mp4 output=camera.yaml": "test_driving.py has a drive with turns",
    "saunet predict checkpoint=last.ckpt input=image_02/data output=depth/ scale.method=camera_height": "measured once",
    "saunet train experiment=scratch data.stereo=true": "measured once",
    "saunet predict checkpoint=best.ckpt input=drive.mp4 output=depth/ scale.method=speed scale.speeds=obd": ALIGNED,
    "saunet train experiment=selfsup data=video data.root=clips data.with_speed=true data.align_speeds=true": ALIGNED,
}
"""Beginnings of commands that are not run here -> where they are, or why they are not."""


def tutorial(page: str) -> list[str]:
    """Return the commands of a page that are run here, in order."""
    return [
        " ".join(command.split())
        for where, command in commands("bash", "")
        if where == page and not " ".join(command.split()).startswith(tuple(ELSEWHERE))
    ]


def shortened(command: str) -> list[str]:
    """Return the words of a command after ``saunet``, with the files that are there and short settings."""
    _, tool, *words = shlex.split(command)
    said = " ".join(words)
    if re.search(r"data=kitti\b|experiment=(paper|table1)", said):
        words += [f"data.{each}" for each in KITTI.split()]
    if "sources.town=kitti" in said:
        words += [f"data.sources.town.{each}" for each in KITTI.split()]
    given = {word.partition("=")[0] for word in words}
    words += [word for word in SHORT.get(tool, "").split() if word.partition("=")[0] not in given]
    if {"experiment=quick", "experiment=scratch"} & set(words):  # their pose network has no public weights to leave out
        words = [word for word in words if not word.startswith("model.pose.weights=")]
    fitting = [("/data/", "data/"), ("/fast/", "fast/"), ("trainer=gpu", "trainer=cpu"), (".../best.ckpt", "best.ckpt")]
    for printed, here in fitting:
        words = [word.replace(printed, here) for word in words]
    return [tool, *words]


def test_what_is_not_run_here_is_a_command_of_the_pages() -> None:
    printed = [" ".join(command.split()) for page, command in commands("bash", "") if page in TUTORIALS]
    assert [each for each in ELSEWHERE if not any(command.startswith(each) for command in printed)] == []


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a reader has: a filmed board, clips, a picture, KITTI, a checkpoint; all of it rendered."""
    folder = tmp_path_factory.mktemp("files")
    drives = [SyntheticDrive(seed=seed, frames=30, height=128, width=384) for seed in (1, 2)]
    write_raw(folder / "data" / "kitti", drives, right=[drive.stereo() for drive in drives], ground_truth=True)
    densify(kitti_recordings(folder / "data" / "kitti"), ["linear"])  # what experiment=paper trains on
    (folder / "clips").mkdir()
    for name, drive in (("drive.mp4", 0), ("clips/2024-05-03_lab.mp4", 0), ("clips/2024-05-04_lab.mp4", 1)):
        write_video(folder / name, [drives[drive].image(index) for index in drives[drive].indices], fps=10)
    write_video(folder / "board.mp4", np.repeat(board_views.views(Board(), count=24, spread=2), 3, axis=0))
    write_image(folder / "road.png", drives[0].image(0))
    for name, drive in (("frames", drives[0]), ("left", drives[0]), ("right", drives[0].stereo())):
        for index in drive.indices:
            write_image(folder / name / f"{index:06d}.png", drive.image(index))
    K = drives[0].intrinsics(0)
    (folder / "camera.yaml").write_text(
        f"image_size: [384, 128]\nK: [{K[0, 0]}, {K[1, 1]}, {K[0, 2]}, {K[1, 2]}]\ncamera_height: 1.65\nfps: 10\n"
    )
    (folder / "speeds.csv").write_text("frame,speed\n0,8\n29,8\n")
    model = read_model("street")  # with a pose network, which a training on video has and speed needs
    record = replace(model.record, pose=component_node("pose", "posecnn"))
    pose = build_networks(record)[1]
    assert pose is not None
    state = {**model.state, **{f"pose.{key}": value for key, value in pose.state_dict().items()}}
    atomic_save({"state_dict": state, "saunet": record.to_plain()}, folder / "best.ckpt")
    return folder


def run(words: list[str], folder: Path, cache: Path) -> subprocess.CompletedProcess[str]:
    """Run ``saunet WORDS`` in the environment that is tried."""
    env = {**os.environ, "XDG_CACHE_HOME": str(cache)}
    if not PYTHON:
        return python("-m", "saunet", *words, cwd=folder, env=env)
    command = [str(Path(PYTHON).with_name("saunet")), *words]
    return subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, timeout=900, check=False)


@pytest.mark.slow
@pytest.mark.parametrize("page", TUTORIALS)
def test_a_tutorials_commands_work_one_after_the_other(page: str, files: Path, tmp_path: Path) -> None:
    here = tmp_path / "here"
    shutil.copytree(files, here)
    if page == "your_camera.md":  # which makes one
        (here / "camera.yaml").unlink()
    for plugin in {name for command in tutorial(page) for name in re.findall(r"plugins=\[(\w+\.py)\]", command)}:
        texts = [block.text for block in blocks("python") if block.page == page]
        last = max(place for place, text in enumerate(texts) if ".register(" in text)
        (here / plugin).write_text("".join(texts[: last + 1]))
        done = python("-c", "".join(texts), cwd=here)  # makes the files that the page reads
        assert done.returncode == 0, done.stderr[-3000:]
    wrong = []
    for command in tutorial(page):
        words = shortened(command)
        for place, word in enumerate(words):
            if "..." in word:  # the newest of what an earlier command left
                pattern = word.partition("=")[2].replace("...", "*")
                words[place] = f"{word.partition('=')[0]}={max(here.glob(pattern)).relative_to(here)}"
        for word in words:
            if words[0] == "predict" and word.startswith("output="):  # alternatives, which a page puts into one folder
                shutil.rmtree(here / word.removeprefix("output="), ignore_errors=True)
        done = run(words, here, files.with_name("cache"))
        if done.returncode != 0:
            wrong.append(f"saunet {' '.join(words)}\n{done.stdout[-1500:]}\n{done.stderr[-1500:]}")
        if words[:2] == ["calibrate", "board.mp4"]:
            shutil.copy(files / "camera.yaml", here / "clips")  # of these clips, which another camera filmed
    assert not wrong, "\n\n".join(wrong)
