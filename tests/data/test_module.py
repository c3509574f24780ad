from __future__ import annotations

import pytest
import torch
from drives import NumberDrive

from saunet.data.loading.module import DepthDataModule
from saunet.data.loading.windows import Selection
from saunet.errors import ConfigError, DataError
from saunet.threads import available_cores


class Drives(DepthDataModule):
    """Two drives to train on, one for the rest."""

    def select(self, split):
        names = {"train": ["a l", "b l"]}.get(split, [f"{split} l"])
        return [Selection(NumberDrive(name), range(8)) for name in names]


def module(**options):
    return Drives(**{"height": 10, "width": 15, "batch_size": 4, "workers": 0, **options})


def batches(data, loader):
    return [data.on_after_batch_transfer(batch, 0) for batch in loader]


def test_training_batches():
    data = module(crop_margin=0.2, target_depth=True, with_pose=True)
    data.setup("fit")
    assert set(data.datasets) == {"train", "val"}
    (first, *rest) = batches(data, data.train_dataloader())
    assert len(rest) == 2  # twelve windows
    assert first["target"].shape == (4, 3, 10, 15)
    assert first["sources"].shape == (4, 2, 3, 10, 15)
    assert first["target_depth"].shape == (4, 1, 10, 15)
    assert first["T_src_tgt"].shape == (4, 2, 4, 4)
    assert first["K"].dtype == torch.float32


@pytest.mark.parametrize("workers", [0, 2])
def test_batches_are_the_same_whatever_the_workers(workers):
    one, other = module(), module(workers=workers)
    for data in (one, other):
        data.setup("fit")
    for a, b in zip(batches(one, one.train_dataloader()), batches(other, other.train_dataloader()), strict=True):
        assert a["name"] == b["name"]
        assert torch.equal(a["target"], b["target"])
        assert torch.equal(a["K"], b["K"])


def test_any_data_set_gives_the_way_traveled():
    data = module(with_speed=True)
    data.setup("fit")
    batch = batches(data, data.train_dataloader())[0]
    torch.testing.assert_close(batch["distance"], torch.full((4, 2), 1.01**0.5))  # frames are (0.1, 0, 1) m apart


def test_the_way_traveled_is_refused_where_nothing_knows_it(monkeypatch):
    data = module(with_speed=True)
    monkeypatch.setattr(NumberDrive, "pose", lambda self, index: None)
    with pytest.raises(DataError, match=r"with_speed is true but no training frame of Drives has a speed .*set data"):
        data.setup("fit")
    module().setup("fit")


def test_another_seed_gives_other_batches():
    names = []
    for seed in (0, 1):
        data = module(seed=seed)
        data.setup("fit")
        names.append([batch["name"] for batch in data.train_dataloader()])
    assert names[0] != names[1]


@pytest.mark.parametrize(("stage", "split", "frames", "sources"), [("validate", "val", 6, 2), ("test", "test", 8, 0)])
def test_evaluation_batches_hold_every_frame_once_with_truth(stage, split, frames, sources):
    data = module()
    data.setup(stage)
    loaded = batches(data, getattr(data, f"{split}_dataloader")())
    names = [name for batch in loaded for name in batch["name"]]
    assert names == sorted(set(names))
    assert len(names) == frames
    assert loaded[0]["sources"].shape[1] == sources
    assert loaded[0]["depth"].shape[1:] == (1, 20, 30)
    assert loaded[0]["depth_size"].tolist()[0] == [20, 30]


def test_prediction_needs_no_truth():
    data = module()
    data.setup("predict")
    (batch, _) = batches(data, data.predict_dataloader())
    assert "depth" not in batch


def test_summary_says_what_is_used_and_left_out():
    data = module()
    data.setup("fit")
    assert data.summary("train").startswith(
        "train (2 of 2 drives): 12 frames used; left out: 4 without neighbor; sha256 "
    )
    assert "a l: 6 frames used; left out: 2 without neighbor" in data.summary("train")
    assert len(data.fingerprints()["train"]) == 64


def test_no_usable_frame_is_an_error():
    data = module(offsets=(-20, 20))
    with pytest.raises(DataError, match=r"split 'train' has no usable frame .*need neighbors at \[-20, 20\]"):
        data.setup("fit")


def test_a_loader_before_setup_is_an_error():
    with pytest.raises(ConfigError, match=r"'train' split is not set up"):
        module().train_dataloader()


@pytest.mark.parametrize(
    "option",
    [{"height": 0}, {"batch_size": -1}, {"workers": -1}, {"crop_margin": 2.0}, {"flip_prob": 2.0}, {"offsets": (0,)}],
)
def test_impossible_settings_are_refused(option):
    with pytest.raises(ConfigError, match=next(iter(option))):
        module(**option)


class Broken(NumberDrive):
    def image(self, index):
        if index == 3:
            raise DataError("frame 3 is broken")
        return super().image(index)


@pytest.mark.parametrize("workers", [0, 1])
def test_a_bad_file_is_one_sentence_even_from_a_loader_process(workers):
    data = module(workers=workers)
    data.select = lambda split: [Selection(Broken(), range(8))]
    data.setup("fit")
    for loader in (data.train_dataloader(), data.val_dataloader()):
        with pytest.raises(DataError, match=r"^frame 3 is broken$"):
            list(loader)


def test_nothing_held_out_means_no_validation():
    data = module()
    data.select = lambda split: [] if split == "val" else [Selection(NumberDrive(), range(8))]
    data.setup("fit")
    assert data.val_dataloader() == []
    assert len(list(data.train_dataloader())) == 1
    assert set(data.fingerprints()) == {"train"}


def test_no_more_loader_processes_than_cores(recwarn):
    data = module(workers=available_cores() + 3)
    data.setup("fit")
    assert data.train_dataloader().num_workers == data.val_dataloader().num_workers == available_cores()
    assert not [str(each.message) for each in recwarn if "worker" in str(each.message)]
