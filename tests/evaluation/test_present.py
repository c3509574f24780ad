"""One model on every data set that is present: two rendered ones in different layouts, by one and by two processes."""

from __future__ import annotations

import csv
import dataclasses
import json
import os
import socket
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from processes import python
from tiny_checkpoint import write_checkpoint

from saunet import plugins
from saunet.errors import ConfigError, DataError
from saunet.evaluation import EvaluateOptions
from saunet.evaluation.present import evaluate_present, run
from saunet.io.images import write_image
from saunet.registry import Spec, datamodules
from saunet.synthetic import SyntheticDrive
from saunet.synthetic.kitti_writer import write_raw

PLUGIN = '''
"""A data set of pictures and depth in files of its own."""
import numpy as np
from typing_extensions import Unpack
from saunet.data.loading.options import Loading
from saunet.data.sets.base import FilesDataModule, FilesDrive, find_root
from saunet.registry import datamodules


class Street(FilesDrive):
    def has_depth(self, index: int) -> bool:
        return True

    def depth(self, index: int):
        return np.load(self.path(index).with_suffix(".depth.npy"))


@datamodules.register("pictured_streets")
class PicturedStreets(FilesDataModule):
    """Pictures beside depth."""

    protocol, ground_truth, root = "synthetic", "exact", "streets"

    def __init__(self, *, root: str = "streets", **loading: Unpack[Loading]) -> None:
        super().__init__(**loading)
        self.root = root

    def drives(self, split: str):
        home = find_root(self.root, "streets.txt", "the folder with streets.txt")
        paths = {int(path.stem): path for path in home.glob("*.png")}
        return [Street("street", paths, np.loadtxt(home / "streets.txt"), home / "streets.txt")]
'''


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a checkpoint and two data sets, of 5 and 3 images."""
    folder = tmp_path_factory.mktemp("present")
    write_checkpoint(folder / "model.ckpt")
    write_raw(folder / "sets" / "somewhere", [SyntheticDrive(seed=1, frames=5, height=64, width=96)])
    drive = SyntheticDrive(seed=2, frames=3, height=64, width=96)
    own = folder / "sets" / "pictured_streets"
    own.mkdir()
    np.savetxt(own / "streets.txt", drive.intrinsics(0))
    for index in drive.indices:
        write_image(own / f"{index}.png", drive.image(index))
        np.save(own / f"{index}.depth.npy", drive.depth(index))
    (folder / "my_sets.py").write_text(PLUGIN)
    if "pictured_streets" not in datamodules.names():
        plugins.load([str(folder / "my_sets.py")])
    return folder


def options(place: Path, **changes: object) -> EvaluateOptions:
    settings = {"kitti": {"split": "all", "test_split": "all", "cameras": ["left"]}}
    data = {"root": str(place / "sets"), "settings": settings, "batch_size": 2, "workers": 0, **changes}
    spec = Spec.of("data", "all_present", **data)
    return EvaluateOptions(data=spec, checkpoint=place / "model.ckpt", device="cpu")


def rows(folder: Path) -> dict[str, dict[str, str]]:
    with (folder / "datasets.csv").open(newline="") as file:
        return {row["data set"]: row for row in csv.DictReader(file)}


def by_torchrun(overrides: list[str]) -> list[subprocess.CompletedProcess[str]]:
    command = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "saunet", "evaluate"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    made = [sys.executable, *command, *overrides]
    return [subprocess.run(made, capture_output=True, text=True, timeout=600, env=environment, check=False)]


def by_hand(overrides: list[str]) -> list[subprocess.CompletedProcess[str]]:
    """Start both processes as torchrun does, without the seconds that imports take."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        known = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(probe.getsockname()[1])}

    def one(rank: int) -> subprocess.CompletedProcess[str]:
        environment = {**os.environ, "OMP_NUM_THREADS": "1", **known, "RANK": str(rank), "LOCAL_RANK": str(rank)}
        return python("-m", "saunet", "evaluate", *overrides, env=environment, timeout=600)

    python("-c", "")  # starts what both are forked from
    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(one, range(2)))


@pytest.mark.parametrize("start", [by_hand, pytest.param(by_torchrun, marks=pytest.mark.slow)])
def test_one_table_of_all_that_is_present_exact_under_two_processes(
    start: Callable[[list[str]], list[subprocess.CompletedProcess[str]]], place: Path, tmp_path: Path
) -> None:
    overrides = [
        f"checkpoint={place / 'model.ckpt'}",
        "data=all_present",
        f"data.root={place / 'sets'}",
        "data.settings={kitti:{split:all,test_split:all,cameras:[left]}}",
        "data.workers=0",
        "data.batch_size=2",
        f"plugins=[{place / 'my_sets.py'}]",
        "device=cpu",
        "buckets=true",
        f"output_dir={tmp_path / 'two'}",
    ]
    started = start(overrides)
    for done in started:
        assert done.returncode == 0, done.stderr[:3000]
    assert sum(done.stdout.count("pictured_streets") for done in started) == 1  # one process speaks

    alone = dataclasses.replace(options(place), output_dir=str(tmp_path / "one"), buckets=True)
    result = run(alone)
    assert set(result.results) == {"kitti", "pictured_streets"}
    one, two = rows(tmp_path / "one"), rows(tmp_path / "two")
    assert list(one) == list(two) == ["kitti", "pictured_streets"]
    assert [row["images"] for row in one.values()] == ["5", "3"]
    assert [row["protocol"] for row in one.values()] == ["eigen_camera_z", "synthetic"]
    for name, row in one.items():
        first, second = (json.loads((tmp_path / f / name / "metrics.json").read_text()) for f in ("one", "two"))
        assert first["images"] == second["images"]
        for mine, theirs in zip(*(each["results"] + each["buckets"] for each in (first, second)), strict=True):
            texts = {key for key, value in mine.items() if isinstance(value, str)}
            assert {key: mine[key] for key in texts} == {key: theirs[key] for key in texts}
            numbers = [{key: value for key, value in each.items() if key not in texts} for each in (mine, theirs)]
            assert numbers[0] == pytest.approx(numbers[1], rel=1e-6, nan_ok=True)
        assert float(row["Abs Rel"]) == pytest.approx(first["results"][0]["abs_rel"])
    assert "kitti" in (tmp_path / "one" / "datasets.md").read_text()


def test_what_is_named_but_not_there_is_said(place: Path) -> None:
    result = evaluate_present(options(place, sets=["pictured_streets"]))
    assert list(result.results) == ["pictured_streets"]
    broken = options(place, root=None, roots={"kitti": str(place / "gone"), "pictured_streets": str(place / "sets")})
    result = evaluate_present(broken)
    assert list(result.results) == ["pictured_streets"]
    assert "gone" in result.left_out["kitti"]
    assert "kitti: left out" in result.table.markdown()


def test_nothing_there_and_options_of_one_data_set_are_refused(place: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match=r"no data set to evaluate below .*looked for"):
        evaluate_present(options(place, root=str(tmp_path / "empty")))
    with pytest.raises(DataError, match="no folder at"):
        evaluate_present(options(place, root=str(tmp_path / "gone")))
    with pytest.raises(ConfigError, match=r"data\.root=FOLDER"):
        evaluate_present(options(place, root=None))
    with pytest.raises(ConfigError, match="data set is 'kiti'"):
        evaluate_present(options(place, sets=["kiti"]))
    with pytest.raises(ConfigError, match="compare applies to a single data set"):
        evaluate_present(EvaluateOptions(data=options(place).data, checkpoint="x", compare=str(tmp_path)))
    with pytest.raises(ConfigError, match="for saunet evaluate"):
        Spec.of("data", "all_present", root=str(tmp_path)).build().setup("fit")
