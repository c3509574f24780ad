from __future__ import annotations

import pickle

import pytest
import torch
from clip_tree import CAMERA, frames, make_clip
from kitti_tree import make_drive, name

from saunet.errors import ConfigError, DataError
from saunet.registry import datamodules

SIZE = {"height": 20, "width": 40, "batch_size": 4, "workers": 0}


def sources(tmp_path, **options):
    make_drive(tmp_path / "raw", 1, frames=range(12))
    make_clip(tmp_path / "clips", "a", frames(12))
    kitti = datamodules.build(
        "kitti", root=str(tmp_path / "raw"), split="all", cameras=["left"], val_share=0.2, **options
    )
    campus = datamodules.build(
        "video", root=str(tmp_path / "clips"), frames_cache=str(tmp_path / "cache"), static="keep", val_share=0.2
    )
    return {"town": kitti, "campus": campus}


def names(data, split):
    return [data.datasets[split].name(index) for index in range(len(data.datasets[split]))]


def test_two_data_sets_are_one(tmp_path):
    data = datamodules.build("mixed", sources=sources(tmp_path), **SIZE)
    data.setup()
    assert {each.partition("/")[0] for each in names(data, "train")} == {"town", "campus"}
    assert f"town/{name(1)} 0000000003 l" in names(data, "train")
    assert "campus/a 0000000003" in names(data, "train")
    assert (data.ground_truth, data.protocol) == ("camera_z", "eigen_camera_z")
    batches = list(data.train_dataloader())
    assert {batch["frames"].shape[2:] for batch in batches} == {(3, 21, 42)}
    by_name = {each: K for batch in batches for each, K in zip(batch["name"], batch["K"], strict=True)}
    focal = {each.partition("/")[0]: float(K[0, 0]) for each, K in by_name.items()}
    assert focal["town"] == pytest.approx(50 * 42 / 60)
    assert focal["campus"] == pytest.approx(250 * 42 / 320)
    test = next(iter(data.test_dataloader()))
    assert "depth" in test  # KITTI's; campus clips have none, which is counted by the evaluation
    assert test["depth"].shape[0] == len(test["name"])
    drive = data.datasets["train"].drives[0]
    assert pickle.loads(pickle.dumps(drive)).name == drive.name == f"town/{name(1)} l"


def test_one_source_knows_the_way_traveled(tmp_path):
    made = sources(tmp_path, with_speed=True)
    records = tmp_path / "raw" / name(1) / "oxts" / "data"
    records.mkdir(parents=True)
    for frame in range(12):
        (records / f"{frame:010d}.txt").write_text(" ".join(["0"] * 8 + ["8"] + ["0"] * 21))
    data = datamodules.build("mixed", sources=made, **SIZE)
    assert pickle.loads(pickle.dumps(data.odometer)) is not None  # loader processes that are spawned need it
    data.setup("fit")
    found = {
        each: way
        for batch in data.train_dataloader()
        for each, way in zip(batch["name"], batch["distance"], strict=True)
    }
    assert {each.partition("/")[0] for each in found} == {"town", "campus"}
    for each, way in found.items():
        expected = torch.full((2,), 8 * 0.1037 if each.startswith("town/") else torch.nan)
        torch.testing.assert_close(way, expected, equal_nan=True)
    with pytest.raises(DataError, match=r"with_speed is true but no training frame .* has an OXTS record"):
        datamodules.build("mixed", sources=sources(tmp_path / "b", with_speed=True), **SIZE).setup("fit")


def test_sources_can_serve_training_or_test_alone(tmp_path):
    data = datamodules.build("mixed", sources=sources(tmp_path), train=["town"], test=["campus"], **SIZE)
    data.setup()
    assert all(each.startswith("town/") for each in names(data, "train") + names(data, "val"))
    assert all(each.startswith("campus/") for each in names(data, "test"))
    assert (data.ground_truth, data.protocol) == ("none", "campus")


def test_what_does_not_go_together_is_refused(tmp_path):
    made = sources(tmp_path)
    with pytest.raises(ConfigError, match=r"data=mixed has no sources; add them with \+data@data.sources.NAME=kitti"):
        datamodules.build("mixed", **SIZE)
    with pytest.raises(ConfigError, match=r"train is 'twon'; did you mean 'town'\? allowed: town, campus"):
        datamodules.build("mixed", sources=made, train=["twon"], **SIZE)
    with pytest.raises(ConfigError, match=r"data.sources.x is int; it must be a data module"):
        datamodules.build("mixed", sources={"x": 3}, **SIZE)
    exact = datamodules.build("synthetic_tiny")
    assert datamodules.build("mixed", sources={**made, "made": exact}, **SIZE).ground_truth == "camera_z"
    other = datamodules.build("kitti", root=str(tmp_path / "raw"), split="all", depth="lidar_x")
    with pytest.raises(ConfigError, match=r"ground truth of different kinds \(camera_z, lidar_x\)"):
        datamodules.build("mixed", sources={**made, "x": other}, **SIZE)
    dense = datamodules.build("kitti_dense", root=str(tmp_path / "raw"), split="all")
    with pytest.raises(ConfigError, match=r"data.sources.x reads stored maps or a cache of small images, which a mix"):
        datamodules.build("mixed", sources={"x": dense}, **SIZE)


@pytest.mark.parametrize(
    ("key", "value", "ours"),
    [
        *(("height", 96, "20"), ("offsets", [-2, 2], r"\(-1, 1\)"), ("batch_size", 99, "4"), ("workers", 2, "0")),
        *(("crop_margin", 0.2, "0.05"), ("flip_prob", 0.0, "0.5"), ("color_jitter_prob", 0.0, "0.5"), ("seed", 3, "0")),
        *(("target_depth", True, "False"), ("on_error", "skip", "raise")),
    ],
)
def test_what_a_source_is_told_and_the_mixture_decides_is_refused(tmp_path, key, value, ours):
    town = datamodules.build("kitti", root=str(tmp_path), split="all", **{key: value})
    told = rf"data.sources.x.{key} is .* but the mixture's is {ours}; set only data.{key}, which applies to all sources"
    with pytest.raises(ConfigError, match=told):
        datamodules.build("mixed", sources={"x": town}, **SIZE)
    assert datamodules.build("mixed", sources={"x": town}, **{**SIZE, key: value})
    pair = datamodules.build("kitti", root=str(tmp_path), split="all", stereo=True)
    with pytest.raises(ConfigError, match=r"data.sources.x.stereo is True but the mixture's is False; leave it out"):
        datamodules.build("mixed", sources={"x": pair}, **SIZE)


def test_the_camera_height_is_known_where_the_sources_agree(tmp_path):
    made = sources(tmp_path)
    assert datamodules.build("mixed", sources=made, **SIZE).camera_height is None  # 1.65 m and 1.4 m
    assert datamodules.build("mixed", sources=made, train=["town"], test=["town"], **SIZE).camera_height == 1.65
    again = sources(tmp_path / "b")
    (tmp_path / "b" / "clips" / "camera.yaml").write_text(CAMERA.replace("1.4", "1.65"))
    assert datamodules.build("mixed", sources=again, **SIZE).camera_height == 1.65


def test_each_source_brings_its_protocol(tmp_path):
    made = sources(tmp_path)
    assert datamodules.build("mixed", sources=made, **SIZE).protocols == ("eigen_camera_z", "campus")
    assert datamodules.build("mixed", sources=made, test=["town"], **SIZE).protocols == ("eigen_camera_z",)
    assert datamodules.build("mixed", sources=made, test=["campus"], **SIZE).protocols == ("campus",)
