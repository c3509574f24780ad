from __future__ import annotations

import multiprocessing
import os
import signal

import numpy as np
import pytest
import torch
from drives import NumberDrive
from torch.utils.data import DataLoader

from saunet.data.loading.sampling import EvalBatches, Loader, ResumableLoader, TrainBatches, evenly, processes
from saunet.data.loading.windows import WindowDataset, collate
from saunet.errors import ConfigError


class Numbers(list, torch.utils.data.Dataset):
    pass


@pytest.mark.parametrize("world_size", [2, 3, 4])
def test_training_is_the_same_on_any_number_of_devices(world_size):
    data = Numbers(range(53))
    single = TrainBatches(data, 12, seed=3)
    parts = [TrainBatches(data, 12, 3, rank, world_size) for rank in range(world_size)]
    for sampler in (single, *parts):
        sampler.set_epoch(4)
    joined = [[item for part in shares for item in part] for shares in zip(*parts, strict=True)]
    assert joined == list(single)
    assert len(single) == len(parts[0]) == 4


def test_each_epoch_has_its_own_order_and_no_sample_twice():
    sampler = TrainBatches(Numbers(range(20)), 5)
    first = [item for batch in sampler for item in batch]
    sampler.set_epoch(1)
    second = [item for batch in sampler for item in batch]
    assert sorted(item.sample for item in first) == list(range(20))
    assert [item.sample for item in first] != [item.sample for item in second]
    assert {item.seed for item in first}.isdisjoint(item.seed for item in second)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 7, 10, 11, 12, 29])
@pytest.mark.parametrize("world_size", [1, 2, 3])
@pytest.mark.parametrize("batch_size", [1, 2, 5])
def test_evaluation_sees_each_sample_once_in_equally_many_batches(count, world_size, batch_size):
    data = Numbers(range(count))
    if count < world_size:
        with pytest.raises(ConfigError, match="cannot be evaluated on"):
            EvalBatches(data, batch_size, 0, world_size)
        return
    parts = [list(EvalBatches(data, batch_size, rank, world_size)) for rank in range(world_size)]
    assert sorted(index for part in parts for batch in part for index in batch) == list(range(count))
    assert len({len(part) for part in parts}) == 1
    sizes = [len(batch) for part in parts for batch in part]
    assert min(sizes) >= 1
    assert max(sizes) <= batch_size + 1
    if world_size == 1:
        assert max(sizes) <= batch_size


def test_a_batch_that_the_devices_do_not_divide_is_refused():
    with pytest.raises(ConfigError, match=r"batch_size is 10; it is the total over all 4 devices .* such as 8"):
        TrainBatches(Numbers(range(99)), 10, 0, 0, 4)


def test_fewer_samples_than_a_batch_are_refused():
    with pytest.raises(ConfigError, match=r"only 5 training samples; use data.batch_size=4 or less"):
        TrainBatches(Numbers(range(5)), 8, 0, 0, 2)


@pytest.mark.parametrize("workers", [0, 2])
def test_loader_goes_on_where_it_was_saved(workers):
    data = WindowDataset([NumberDrive()], [(0, i) for i in range(8)], offsets=(), height=20, width=30)

    def loader():
        made = ResumableLoader(
            data, sampler=TrainBatches(data, 2), batch_size=None, collate_fn=collate, num_workers=workers
        )
        made.sampler.set_epoch(2)
        return made

    whole = [batch["name"] for batch in loader()]
    cut = loader()
    batches = iter(cut)
    seen = [next(batches)["name"], next(batches)["name"]]
    state = cut.state_dict()
    assert state == {"batches": 2, "epoch": 2}
    again = loader()
    again.load_state_dict(state)
    assert seen + [batch["name"] for batch in again] == whole
    assert again.state_dict()["batches"] == 0
    assert [batch["name"] for batch in again] == whole
    assert len(again) == 4
    assert np.shape(whole) == (4, 2)


def test_a_loader_process_that_is_asked_to_end_gives_what_is_under_way_and_no_alarm(monkeypatch):
    """With the whole process group: torch's alarm would end the first process before it has saved."""
    monkeypatch.setattr("saunet.data.loading.sampling.GRACE", 2)
    data = WindowDataset([NumberDrive()], [(0, i) for i in range(8)], offsets=(), height=20, width=30)
    loader = Loader(data, batch_size=None, **processes(1))
    batches = DataLoader.__iter__(loader)
    next(batches)
    (worker,) = batches._workers
    other = multiprocessing.get_context("fork").Process(target=os.kill, args=(worker.pid, signal.SIGTERM))
    other.start()  # not from here: torch's processes end well when their own parent asks them
    other.join(30)
    assert len(list(batches)) == 7
    worker.join(30)
    assert worker.exitcode == 0


def test_a_loader_process_leaves_ctrl_c_to_the_first_process_and_ends_at_the_second():
    """A terminal sends it to the whole group, and the first process still needs what is under way."""
    heard = multiprocessing.get_context("fork").SimpleQueue()
    data = WindowDataset([NumberDrive()], [(0, i) for i in range(8)], offsets=(), height=20, width=30)
    before = signal.signal(signal.SIGINT, lambda *_: heard.put(os.getpid()))  # which the fork inherits
    try:
        batches = DataLoader.__iter__(Loader(data, batch_size=None, **processes(1)))
        next(batches)
        (worker,) = batches._workers
        _press_ctrl_c(worker.pid)
        assert len(list(batches)) == 7
        assert worker.is_alive()
        assert heard.empty()
        _press_ctrl_c(worker.pid)
        worker.join(30)
        assert worker.exitcode == 0
    finally:
        signal.signal(signal.SIGINT, before)


def _press_ctrl_c(process):
    """From another process: torch's processes end well when their own parent asks them."""
    other = multiprocessing.get_context("fork").Process(target=os.kill, args=(process, signal.SIGINT))
    other.start()
    other.join(30)


@pytest.mark.parametrize(
    ("count", "most", "places"), [(5, 9, [0, 1, 2, 3, 4]), (9, 3, [0, 4, 8]), (7, 1, [0]), (0, 4, [])]
)
def test_places_are_spread_evenly_from_first_to_last(count, most, places):
    assert evenly(count, most) == places
