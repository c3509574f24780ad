"""Errors, and checks that say what was wrong, what was given, what is allowed, and how to fix it."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch


class SaunetError(Exception):
    """An error that a user can act on; command-line tools print it as one sentence, without a traceback.

    Examples:
        >>> try:
        ...     saunet.build("encoder", "resnet19")
        ... except saunet.SaunetError as error:
        ...     print(error)
        unknown encoder 'resnet19'; did you mean 'resnet18'? available: ...
    """


class ConfigError(SaunetError, ValueError):
    """A parameter, name or combination of parameters that cannot work.

    Examples:
        >>> saunet.Spec.of("encoder", "resnet18", wieghts="imagenet")
        Traceback (most recent call last):
        saunet.errors.ConfigError: encoder 'resnet18' has no parameter 'wieghts'; did you mean 'weights'? ...
    """


class DataError(SaunetError, ValueError):
    """A file or data set that is missing, broken or does not fit.

    Examples:
        >>> saunet.build("data", "kitti", root="/nowhere").setup()
        Traceback (most recent call last):
        saunet.errors.DataError: no data root at /nowhere...
    """


class UnreadableError(DataError):
    """A file that is there and cannot be read: empty, truncated, or not what its name says."""


class CheckpointError(SaunetError, ValueError):
    """A checkpoint that cannot be read or does not belong to the model at hand.

    Examples:
        >>> saunet.load("nowhere.ckpt")
        Traceback (most recent call last):
        saunet.errors.CheckpointError: no ... nowhere.ckpt...
    """


def suggest(name: str, allowed: Iterable[str]) -> str:
    """Return ``"; did you mean 'x'?"`` for the nearest allowed name, or an empty string when nothing is near."""
    near = difflib.get_close_matches(name, list(allowed), n=1, cutoff=0.6)
    return f"; did you mean '{near[0]}'?" if near else ""


def one_of(name: str, value: str, allowed: Iterable[str]) -> str:
    """Return the value of a parameter if it is one of the allowed words; the error names the nearest and lists all."""
    words = list(allowed)
    if value not in words:
        hint = suggest(str(value), words)
        raise ConfigError(f"{name} is '{value}'{hint or ','} allowed: {', '.join(words)}")
    return value


def positive(name: str, value: float | int, *, allow_zero: bool = False) -> float | int:
    """Return the value of a parameter if it is a finite number above zero (or zero, with ``allow_zero``)."""
    if not math.isfinite(value) or value < 0 or (value == 0 and not allow_zero):
        raise ConfigError(f"{name} is {value}; it must be {'at least' if allow_zero else 'greater than'} 0")
    return value


def in_range(name: str, value: float | int, low: float | int, high: float | int) -> float | int:
    """Return the value of a parameter if ``low <= value <= high``, which NaN is not."""
    if not low <= value <= high:
        raise ConfigError(f"{name} is {value}; it must lie between {low} and {high}")
    return value


def divisible(height: int, width: int, divisor: int, *, what: str = "image", by: str = "the encoder stride") -> None:
    """Check that what has this size, in pixels, is a positive multiple of ``divisor`` in both directions.

    ``by`` says where the divisor comes from; the error names the nearest valid size.
    """
    if height > 0 and width > 0 and height % divisor == 0 and width % divisor == 0:
        return
    valid = [max(divisor, divisor * round(side / divisor)) for side in (height, width)]
    raise ConfigError(
        f"{what} {height}x{width} (height x width) is not divisible by {by} {divisor}; "
        f"the nearest valid size is {valid[0]}x{valid[1]}"
    )


def require_matplotlib(what: str, without: str) -> None:
    """Check that pictures can be drawn: ``what`` is such as ``figure=true needs``, ``without`` the setting without."""
    try:
        import matplotlib  # noqa: F401
    except ImportError as reason:
        raise ConfigError(f"{what} matplotlib; run `pip install 'saunet[plot]'` or set {without}") from reason


def usable_device(name: str | torch.device) -> torch.device:
    """Return the device of a name, having tried it; ``auto`` is a GPU if there is one, else the CPU."""
    import torch

    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as reason:
        available = ", ".join(["cpu", *(f"cuda:{index}" for index in range(torch.cuda.device_count()))])
        raise ConfigError(f"device '{name}' cannot be used here; available: {available}") from reason
    return device
