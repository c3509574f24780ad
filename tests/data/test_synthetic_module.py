"""The synthetic data module: splits, batches and truth."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import pytest
import torch

import saunet
from saunet.data.synthetic import SyntheticDataModule
from saunet.errors import ConfigError
from saunet.geometry.warp import synthesize
from saunet.metrics.protocols import protocol
from saunet.registry import datamodules

TINY: dict[str, Any] = {
    "height": 32, "width": 96, "batch_size": 2, "workers": 0, "train_drives": 2, "val_drives": 1, "test_drives": 1,
    "frames_per_drive": 4,
}  # fmt: skip


@pytest.fixture(scope="module")
def module() -> SyntheticDataModule:
    data: SyntheticDataModule = saunet.build("data", "synthetic", **TINY, with_pose=True, target_depth=True)
    data.setup()
    return data


def test_defaults_are_the_demos() -> None:
    data: SyntheticDataModule = saunet.build("data", "synthetic")
    assert (data.height, data.width, data.batch_size, data.counts["train"]) == (64, 192, 8, 8)
    assert not data.datasets
    assert protocol(data.protocol).name == "synthetic"


def test_splits_are_different_streets(module: SyntheticDataModule) -> None:
    seeds = {split: {d.seed for d in module.drives(split)} for split in ("train", "val", "test")}
    other = SyntheticDataModule(**{**TINY, "frames_per_drive": 1}, seed=1)
    seeds["other train"] = {d.seed for d in other.drives("train")}
    everything = [seed for chosen in seeds.values() for seed in chosen]
    assert len(everything) == len(set(everything)) == 6
    assert len(module.datasets["train"]) == 4  # two of four frames have both neighbors, in two drives
    assert len(module.datasets["test"]) == 4


def test_all_frames_are_rendered_before_loading_starts(module: SyntheticDataModule) -> None:
    assert all(drive.rendered for split in ("train", "val", "test") for drive in module.drives(split))


def test_training_batch_carries_motion_and_depth(module: SyntheticDataModule) -> None:
    batch = module.on_after_batch_transfer(next(iter(module.train_dataloader())), 0)
    assert batch["target"].shape == (2, 3, 32, 96)
    assert batch["sources"].shape == (2, 2, 3, 32, 96)
    assert batch["T_src_tgt"].shape == (2, 2, 4, 4)
    assert batch["target_depth"].shape == (2, 1, 32, 96)


def test_truth_survives_augmentation() -> None:
    """Crop and flip keep depth, intrinsics, motion and pictures consistent: warping with them explains the target."""
    changes = {"height": 64, "width": 192, "train_drives": 1, "flip_prob": 0.5, "crop_margin": 0.2}
    data = SyntheticDataModule(**{**TINY, **changes}, target_depth=True, with_pose=True)
    data.setup("fit")
    for raw in data.train_dataloader():
        batch = data.on_after_batch_transfer(raw, 0)
        depth = torch.where(batch["target_depth"] > 0, batch["target_depth"], torch.tensor(1e6))
        view = synthesize(batch["loss_sources"], depth, batch["K"], batch["T_src_tgt"])
        error = (view.image - batch["loss_target"][:, None]).abs().mean(2)
        identity = (batch["loss_sources"] - batch["loss_target"][:, None]).abs().mean(2)
        valid = view.valid[:, :, 0]
        assert error[valid].median() < 0.6 * identity[valid].median()


@pytest.mark.parametrize("split", ["val", "test"])
def test_evaluation_batches_carry_exact_depth(module: SyntheticDataModule, split: str) -> None:
    loader = module.val_dataloader() if split == "val" else module.test_dataloader()
    batch = module.on_after_batch_transfer(next(iter(loader)), 0)
    assert batch["depth"].shape[-2:] == (32, 96)
    assert batch["depth_size"].tolist() == [[32, 96]] * len(batch["depth"])
    assert (batch["depth"] > 0).float().mean() > 0.4


def test_drives_come_from_the_cache(tmp_path: Path) -> None:
    small = {**TINY, "train_drives": 1, "cache": str(tmp_path)}
    first = SyntheticDataModule(**small)
    first.setup("fit")
    files = sorted(tmp_path.iterdir())
    assert len(files) == 2
    second = SyntheticDataModule(**small)
    second.setup("fit")
    assert sorted(tmp_path.iterdir()) == files
    assert second.fingerprints() == first.fingerprints()
    assert second.drives("train")[0].image(1).tobytes() == first.drives("train")[0].image(1).tobytes()


def test_it_is_registered_and_has_a_schema() -> None:
    assert "synthetic" in saunet.available("data")
    keys = {key.name: key.default for key in datamodules.node("synthetic").keys}
    assert (keys["frames_per_drive"], keys["offsets"], keys["height"]) == (60, [-1, 1], 64)


def test_it_pickles(module: SyntheticDataModule) -> None:
    assert len(pickle.loads(pickle.dumps(module.datasets["val"]))) == len(module.datasets["val"])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"train_drives": 0}, "train_drives is 0"),
        ({"test_drives": 20_000}, "test_drives is 20000; at most 10000"),
        ({"frames_per_drive": 0}, "frames_per_drive is 0"),
        ({"camera_height": -1.0}, "camera_height is -1.0"),
    ],
)
def test_impossible_settings_are_one_sentence(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        SyntheticDataModule(**{**TINY, **changes})
