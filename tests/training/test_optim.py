"""The recipe's learning rate against its closed form."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import nn

from saunet.errors import ConfigError
from saunet.training.optim import Recipe


def _rates(recipe: Recipe, steps: int) -> list[float]:
    configured = recipe.configure([torch.nn.Parameter(torch.zeros(1))], steps)
    optimizer, scheduler = configured["optimizer"], configured["lr_scheduler"]["scheduler"]
    rates = []
    for _ in range(steps):
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        scheduler.step()
    return rates


def test_the_papers_schedule_falls_to_a_tenth_after_epoch_60_of_80() -> None:
    rates = _rates(Recipe(), 80)
    assert rates[:60] == [1e-4] * 60
    assert rates[60:] == pytest.approx([1e-5] * 20)


def test_cosine_follows_its_formula() -> None:
    rates = _rates(Recipe(schedule="cosine", lr=1.0), 10)
    assert rates == pytest.approx([0.5 * (1 + math.cos(math.pi * step / 10)) for step in range(10)], abs=1e-6)


def test_warmup_rises_linearly_and_wastes_no_step() -> None:
    rates = _rates(Recipe(schedule="constant", lr=1.0, warmup=0.5), 8)
    assert rates == pytest.approx([0.25, 0.5, 0.75, 1, 1, 1, 1, 1])


def test_the_paper_uses_adam_with_its_betas() -> None:
    optimizer = Recipe().configure([torch.nn.Parameter(torch.zeros(1))], 1)["optimizer"]
    assert type(optimizer) is torch.optim.Adam
    assert optimizer.param_groups[0]["betas"] == (0.9, 0.999)
    assert (
        type(Recipe(optimizer="adamw").configure([torch.nn.Parameter(torch.zeros(1))], 1)["optimizer"])
        is torch.optim.AdamW
    )


def test_its_saved_state_is_plain_and_continues_where_it_was() -> None:
    recipe = Recipe(schedule="cosine", lr=1.0)
    first = recipe.configure([torch.nn.Parameter(torch.zeros(1))], 10)
    for _ in range(4):
        first["optimizer"].step()
        first["lr_scheduler"]["scheduler"].step()
    state = first["lr_scheduler"]["scheduler"].state_dict()
    assert all(isinstance(value, int | float | list | bool | None) for value in state.values())
    second = recipe.configure([torch.nn.Parameter(torch.zeros(1))], 10)
    second["lr_scheduler"]["scheduler"].load_state_dict(state)
    assert second["lr_scheduler"]["scheduler"].get_last_lr() == first["lr_scheduler"]["scheduler"].get_last_lr()
    second["lr_scheduler"]["scheduler"].step()
    assert second["optimizer"].param_groups[0]["lr"] == pytest.approx(0.5)


def test_one_cycle_rises_to_the_rate_and_falls_to_almost_nothing() -> None:
    recipe = Recipe(schedule="one_cycle", lr=1.0, warmup=0.25)
    assert recipe.factor(0.0) == pytest.approx(1 / 25)
    assert recipe.factor(0.125) == pytest.approx((1 + 1 / 25) / 2)
    assert recipe.factor(0.25) == pytest.approx(1)
    assert recipe.factor(0.625) == pytest.approx((1 + 1 / 25e4) / 2)
    assert recipe.factor(1.0) == pytest.approx(1 / 25e4)
    rates = _rates(recipe, 40)
    assert max(rates) == rates[9] == 1
    assert rates[:10] == sorted(rates[:10])
    assert rates[9:] == sorted(rates[9:], reverse=True)


class Network(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.depth = nn.ModuleDict({"encoder": nn.Linear(1, 1), "decoder": nn.Linear(1, 1)})
        self.pose = nn.Linear(1, 1)


def test_the_encoder_can_have_a_rate_of_its_own_which_follows_the_schedule() -> None:
    network = Network()
    recipe = Recipe(lr=1.0, encoder_lr=0.1, schedule="cosine")
    configured = recipe.configure(recipe.groups(network), 2)
    optimizer, scheduler = configured["optimizer"], configured["lr_scheduler"]["scheduler"]
    assert [group["lr"] for group in optimizer.param_groups] == [1.0, 0.1]
    assert [id(each) for each in optimizer.param_groups[1]["params"]] == [
        id(each) for each in network.depth["encoder"].parameters()
    ]
    optimizer.step()
    scheduler.step()
    assert [group["lr"] for group in optimizer.param_groups] == pytest.approx([0.5, 0.05])
    assert len(Recipe().groups(network)) == 1


def test_frozen_parts_are_named_parts_and_something_is_left_to_train() -> None:
    network = Network()
    assert Recipe(freeze=["depth.encoder"]).frozen(network) == [network.depth["encoder"]]
    with pytest.raises(ConfigError, match=r"optim.freeze is 'depth.encodr'; did you mean 'depth.encoder'\?"):
        Recipe(freeze=["depth.encodr"]).frozen(network)
    network.pose = nn.Sequential(nn.Sequential(nn.Linear(1, 1)))
    with pytest.raises(ConfigError, match=r"allowed: depth, depth.encoder, .*pose, pose.0, and parts of these by"):
        Recipe(freeze=["posse"]).frozen(network)  # not every layer's name
    network.requires_grad_(False)
    with pytest.raises(ConfigError, match=r"leaves nothing to train"):
        Recipe(freeze=["depth", "pose"]).groups(network)


def test_the_fused_optimizer_takes_the_same_step() -> None:
    weights = []
    for fused in (False, True, None):
        parameter = nn.Parameter(torch.linspace(-1, 1, 8))
        optimizer = Recipe(lr=0.1, optimizer="adamw", weight_decay=0.1, fused=fused).configure([parameter], 1)[
            "optimizer"
        ]
        parameter.pow(2).sum().backward()
        optimizer.step()
        weights.append(parameter.detach())
    torch.testing.assert_close(weights[0], weights[1])
    assert torch.equal(weights[1], weights[2])  # on a CPU it is fused by default


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"schedule": "one_cycle"}, "optim.schedule=one_cycle rises over optim.warmup, which is 0"),
        ({"ema": 1.0}, "optim.ema is 1, so the average would never move"),
        ({"encoder_lr": -1.0}, "optim.encoder_lr is -1.0"),
        ({"lr": 0.0}, "optim.lr is 0.0; it must be greater than 0"),
        ({"lr": float("nan")}, "optim.lr is nan"),
        ({"betas": (0.9,)}, "optim.betas is"),
        ({"milestones": (60.0,)}, "fractions of the training between 0 and 1"),
        ({"warmup": 1.0}, "optim.warmup is 1.0"),
    ],
)
def test_values_that_make_no_sense_are_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Recipe(**wrong)
