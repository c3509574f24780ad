"""The recipe's learning rate against its closed form."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

from saunet.checks import ConfigError
from saunet.lit.optim import Recipe


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


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
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
