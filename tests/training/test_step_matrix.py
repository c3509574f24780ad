"""The training step with any encoder, decoder, pose network and objective: each name in one, and all as slow tests."""

from __future__ import annotations

from itertools import cycle, islice, product
from typing import Any

import pytest
import torch
from networks import buildable_encoders
from torch import nn

import saunet
from saunet.models.depth import DepthNet
from saunet.registry import decoders, encoders, objectives, poses
from saunet.training.module import SelfSupervisedDepth

HEIGHT, WIDTH = 32, 64
FAMILIES = ("stratified_nano", "swin_tiny", "resnet18", "packnet", "lite_mono_tiny", "efficientnet_lite0")
"""One encoder of each family; the sisters are the same class with other numbers."""
SMALLER = {"packnet": {"channels": (16, 16, 16, 16, 16), "blocks": (1, 1, 1, 1)}}
"""The registered one has 120 million numbers; the slow tests train it."""


def pose_names() -> list[str]:
    """Every pose network, and the triplet input of one that has it."""
    return [*saunet.available("pose"), "resnet18 triplet"]


def build_pose(name: str) -> nn.Module:
    base, _, kind = name.partition(" ")
    return poses.build(base, **({"input": kind} if kind else {}))


def batch() -> dict[str, Any]:
    images = torch.rand(3, 2, 3, HEIGHT, WIDTH)
    K = torch.tensor([[60.0, 0, WIDTH / 2], [0, 60.0, HEIGHT / 2], [0, 0, 1]]).expand(2, 3, 3)
    sources = torch.stack([images[1], images[2]], 1)
    return {
        "target": images[0],
        "sources": sources,
        "loss_target": images[0],
        "loss_sources": sources,
        "K": K,
        "name": ["a", "b"],
    }


def check(depth: nn.Module, pose: nn.Module, objective: str) -> None:
    model = SelfSupervisedDepth(depth, pose, objectives.build(objective)).train()
    model.zero_grad(set_to_none=True)
    pyramid, _, views, terms = model.step(batch())
    assert terms.total.isfinite()
    assert len(views) == len(pyramid.depth)
    terms.total.backward()
    for part in (depth, pose):
        without = [name for name, p in part.named_parameters() if p.grad is None or not p.grad.isfinite().all()]
        assert without == []


def few() -> list[tuple[str, str, str, str]]:
    """Combinations in which each family of encoders, and every decoder, pose network and objective, occurs."""
    kinds = (FAMILIES, saunet.available("decoder"), pose_names(), saunet.available("objective"))
    return list(islice(zip(*(cycle(names) for names in kinds), strict=False), max(len(names) for names in kinds)))


def test_every_family_is_among_them() -> None:
    assert {encoders.entry(name).target for name in FAMILIES} == {
        encoders.entry(name).target for name in buildable_encoders()
    }


@pytest.mark.parametrize(("encoder", "decoder", "pose", "objective"), few())
def test_every_name_trains_in_some_combination(encoder: str, decoder: str, pose: str, objective: str) -> None:
    depth = DepthNet(encoders.build(encoder, **SMALLER.get(encoder, {})), decoders.partial(decoder))
    check(depth, build_pose(pose), objective)


@pytest.mark.slow
@pytest.mark.parametrize("encoder", buildable_encoders())
def test_all_combinations_train(encoder: str) -> None:
    backbone = encoders.build(encoder)
    for pose_name in pose_names():
        pose = build_pose(pose_name)
        for decoder, objective in product(saunet.available("decoder"), saunet.available("objective")):
            try:
                check(DepthNet(backbone, decoders.partial(decoder)), pose, objective)
            except AssertionError as reason:
                raise AssertionError(f"{encoder} + {decoder} + {pose_name} + {objective}: {reason}") from reason
