"""Camera geometry as pure functions on tensors, in full precision inside autocast."""

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

    Half precision has eleven bits: on a 640 pixel wide image, that rounds a coordinate to half a pixel. float32 and
    float64 arguments pass unchanged, so gradients can be checked in float64.
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
    half = isinstance(value, Tensor) and value.is_floating_point() and value.element_size() < 4
    return value.float() if half else value
