"""One experiment per row of the paper's Tables 1 and 3: each composes, also at smoke size, and says what it is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hydra import compose
from plain import plain
from training_options import train_options

from saunet.cli import table
from saunet.cli.table import TOOLS, config_dir
from saunet.cli.words import read_words
from saunet.errors import ConfigError
from saunet.tools.benchmark.tool import PAPER_METHODS

pytestmark = pytest.mark.usefixtures("hydra")

ROWS = sorted(
    path.relative_to(config_dir() / "experiment").with_suffix("").as_posix()
    for path in (config_dir() / "experiment").glob("table*/*.yaml")
)
TABLE_3 = ["table3/resnet50_unet", "table3/stf_t_aunet", "table3/stf_t_unet"]
SMOKE = ("trainer=smoke", "data=synthetic_tiny")


def resolved(*overrides: str) -> dict[str, Any]:
    cfg = compose("train", overrides=["output_dir=/tmp/x", *overrides])
    train_options({key: plain(cfg[key]) for key in cfg if key != "plugins"})
    return {key: plain(cfg[key]) for key in cfg}


def test_every_row_is_there() -> None:
    assert {row.removeprefix("table1/") for row in ROWS if row.startswith("table1/")} == {*PAPER_METHODS, "lite_mono"}
    assert [row for row in ROWS if row.startswith("table3/")] == TABLE_3


@pytest.mark.parametrize("row", ROWS)
def test_a_row_trains_on_kitti_at_the_papers_size(row: str) -> None:
    cfg = resolved(f"experiment={row}")
    assert cfg["name"] == row
    data = cfg["data"]
    assert (data["_target_"].rpartition(".")[2], data["height"], data["width"]) == ("KittiDataModule", 192, 640)
    assert (data["batch_size"], cfg["trainer"]["max_epochs"]) == (12, 80)


@pytest.mark.parametrize("row", ROWS)
def test_a_row_can_be_tried_at_smoke_size(row: str) -> None:
    cfg = resolved(f"experiment={row}", *SMOKE)
    data = cfg["data"]
    assert (data["_target_"].rpartition(".")[2], data["height"], data["batch_size"]) == ("SyntheticDataModule", 64, 2)
    assert (cfg["trainer"]["max_epochs"], cfg["trainer"]["limit_train_batches"]) == (1, 2)


@pytest.mark.parametrize("row", ["paper", "table1/sau_net", *TABLE_3])
def test_the_papers_own_system_compares_with_interpolated_lidar(row: str) -> None:
    """Eq. (13)'s ground truth is interpolated, wherever SAU-Net is trained; other data still take its place."""
    cfg = resolved(f"experiment={row}")
    assert (cfg["data"]["dense"], cfg["data"]["target_depth"]) == ("linear", True)
    assert cfg["objective"]["gradient"]["target"] == "lidar"
    assert resolved(f"experiment={row}", *SMOKE)["data"]["target_depth"] is True
    assert resolved(f"experiment={row}", "data=kitti")["data"]["dense"] == "none"


def test_rows_of_table_3_differ_in_the_depth_network_only() -> None:
    rows = [resolved(f"experiment={row}") for row in TABLE_3]
    parts = [(row["model"].pop("encoder")["_target_"], row["model"].pop("decoder")["_target_"]) for row in rows]
    classes = [tuple(path.rpartition(".")[2] for path in pair) for pair in parts]
    assert classes == [
        ("ResNet", "UNetDecoder"),
        ("StratifiedTransformer", "AUNetDecoder"),
        ("StratifiedTransformer", "UNetDecoder"),
    ]
    for row in rows:
        row.pop("name")
    assert rows[0] == rows[1] == rows[2]


def read(*given: str, folder: Path | None = None) -> tuple[str, ...]:
    return tuple(read_words(given, TOOLS["train"], table.read(), folder)[1])


def test_a_glob_over_a_table_becomes_its_rows() -> None:
    assert read("-m", "experiment=glob(table3/*)", "seed=1") == (f"experiment={','.join(TABLE_3)}", "seed=1")
    assert read("experiment='glob(table3/stf*)'") == (f"experiment={','.join(TABLE_3[1:])}",)


@pytest.mark.parametrize(
    "argument", ["model/encoder=glob(resnet*)", "experiment=table3/stf_t_unet", "name=glob(x,y/*)"]
)
def test_what_hydra_understands_is_left_to_it(argument: str) -> None:
    assert read(argument) == (argument,)


def test_a_glob_that_matches_nothing_says_what_there_is(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"experiment=glob\(table4/\*\) matches none of: .*table3/stf_t_unet"):
        read("experiment=glob(table4/*)")
    with pytest.raises(ConfigError, match="matches none of: no files"):
        read("experiment=glob(table4/*)", folder=tmp_path)
