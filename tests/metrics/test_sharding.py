"""Real processes: the metric over one, two or three ranks with uneven batches is the same number."""

from __future__ import annotations

import multiprocessing
import os
from pathlib import Path

import pytest
import torch

from saunet.metrics.depth import DepthMetrics

SIZES = [(37, 62), (40, 60), (38, 61), (40, 62), (36, 62), (37, 60), (39, 59), (1, 1)]
"""The last image has no ground truth."""


def samples():
    generator = torch.Generator().manual_seed(3)
    disparity = torch.rand(len(SIZES), 1, 12, 20, generator=generator) * 0.3 + 0.02
    depth = torch.zeros(len(SIZES), 1, 40, 62)
    for truth, (height, width) in zip(depth[:-1], SIZES, strict=False):
        known = torch.rand(height, width, generator=generator) > 0.7
        truth[0, :height, :width] = torch.rand(height, width, generator=generator) * 85 * known
    return disparity, depth, torch.tensor(SIZES)


def score(places, batch_size):
    metric = DepthMetrics()
    tensors = samples()
    for batch in torch.tensor(places).split(batch_size):
        metric.update(*(tensor[batch] for tensor in tensors))
    return {name: value.item() for name, value in metric.compute().items()}


def one_rank(rank, shards, batch_size, meeting, answers):
    torch.set_num_threads(1)
    torch.distributed.init_process_group("gloo", init_method=meeting, rank=rank, world_size=len(shards))
    answers.put((rank, score(shards[rank], batch_size)))
    torch.distributed.destroy_process_group()


@pytest.mark.ddp
@pytest.mark.parametrize(
    ("shards", "batch_size"),
    [
        ([[0, 2, 4, 6], [1, 3, 5, 7]], 3),
        ([[0, 1, 2, 3, 4], [5, 6, 7]], 2),
        ([[0, 3, 6], [1, 4, 7], [2, 5]], 2),
        ([[7], [0, 1, 2, 3, 4, 5], [6]], 4),  # a rank whose only image has no ground truth
    ],
)
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork to start processes quickly")
@pytest.mark.filterwarnings("ignore:.*use of fork.*:DeprecationWarning")
def test_ranks_agree_with_one_process(tmp_path: Path, shards: list[list[int]], batch_size: int) -> None:
    context = multiprocessing.get_context("fork")
    answers = context.SimpleQueue()
    meeting = f"file://{tmp_path / 'meeting'}"
    ranks = [
        context.Process(target=one_rank, args=(rank, shards, batch_size, meeting, answers), daemon=True)
        for rank in range(len(shards))
    ]
    for process in ranks:
        process.start()
    for process in ranks:
        process.join(600)
        assert process.exitcode == 0
    found = dict(answers.get() for _ in ranks)
    expected = score(list(range(len(SIZES))), 8)
    assert expected["images"] == 7
    assert expected["images_without_truth"] == 1
    for values in found.values():
        assert values == pytest.approx(expected, rel=1e-12)
    assert all(values == found[0] for values in found.values())  # to the last bit on all ranks
