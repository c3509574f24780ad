"""Geometry and losses in full precision inside autocast.

Half precision has eleven bits: on a 640 pixel wide image that is a coordinate rounded to half a pixel. Functions that
are wrapped here compute in float32 whatever the network around them uses, and in float64 when they are given float64.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

P = ParamSpec("P")
R = TypeVar("R")


def full_precision(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function of tensors: autocast is off inside it and half-precision arguments arrive as float32.

    float32 and float64 arguments pass unchanged, so gradients can be checked in float64.
    """

    @functools.wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        device = "cpu"
        for value in (*args, *kwargs.values()):
            if isinstance(value, Tensor):
                device = value.device.type
                break
        with torch.autocast(device_type=device, enabled=False):
            promoted: Any = [_promote(value) for value in args]
            return function(*promoted, **{key: _promote(value) for key, value in kwargs.items()})

    return wrapper


def _promote(value: Any) -> Any:
    if isinstance(value, Tensor) and value.is_floating_point() and value.element_size() < 4:
        return value.float()
    return value
