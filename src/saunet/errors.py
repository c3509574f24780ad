"""Errors, and checks that say what was wrong, what was given, what is allowed, and how to fix it."""

from __future__ import annotations

import difflib
import functools
import inspect
import math
import numbers
import re
import reprlib
import sys
import types
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import PurePath
from typing import TYPE_CHECKING, Any, Literal, TypeVar, Union

from typing_extensions import Unpack

C = TypeVar("C", bound=Callable[..., Any])
_ENDLESS = re.compile(r"\S{500,}|(?<=')[^']{500,}(?=')")
"""A word or quotation that is longer than what anybody reads, and than the paths of most systems."""

ELSEWHERE = {
    "learning_rate": "lr",
    "gpus": "devices",
    "num_workers": "workers",
    "imgsz": "size",
    "source": "input",
    "model": "checkpoint",
    "weights": "checkpoint",
    "format": "formats",
    "steps": "max_steps",
    "batch": "batch_size",
    "video": "mp4",
    "image": "color",
}
"""What other tools call a setting or an output -> what it is called here."""

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

    def __init__(self, message: str = "") -> None:  # a damaged file may have words of any length
        super().__init__(_ENDLESS.sub(lambda word: f"{word[0][:100]}...", message))


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
    """A file that exists but cannot be read: empty, truncated, or not what its name says."""


class CameraError(DataError):
    """A camera that does not fit its images, whatever their files contain."""


class CheckpointError(SaunetError, ValueError):
    """A checkpoint that cannot be read or does not belong to the model at hand.

    Examples:
        >>> saunet.load("nowhere.ckpt")
        Traceback (most recent call last):
        saunet.errors.CheckpointError: no ... nowhere.ckpt...
    """


def suggest(name: str, allowed: Iterable[str]) -> str:
    """Return ``"; did you mean 'x'?"`` for the nearest allowed name, or an empty string when nothing is near."""
    words, (before, dot, last) = list(allowed), name.rpartition(".")
    elsewhere = f"{before}{dot}{ELSEWHERE.get(last)}"
    near = [elsewhere] if elsewhere in words else difflib.get_close_matches(name, words, n=1, cutoff=0.6)
    return f"; did you mean '{near[0]}'?" if near else ""


def one_of(name: str, value: str, allowed: Iterable[str]) -> str:
    """Return the value of a parameter if it is one of the allowed words; the error suggests the nearest."""
    words = list(allowed)
    if value not in words:
        hint = suggest(str(value), words)
        raise ConfigError(f"{name} is '{value}'{hint or ','} allowed: {', '.join(words)}")
    return value


def positive(name: str, value: float | int, *, allow_zero: bool = False) -> float | int:
    """Return the value of a parameter if it is a finite number above zero (or zero, with ``allow_zero``)."""
    if not 0 <= value < math.inf or (value == 0 and not allow_zero):
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


def checked(target: C) -> C:
    """Make a function, or a class on construction, refuse arguments that its annotations do not allow.

    Shapes are also compared with each other. It takes a few microseconds per call, so use it where users' values enter.
    """
    function: Any = target.__init__ if inspect.isclass(target) else target
    signature = inspect.signature(function)

    @functools.wraps(function)
    def checking(*args: Any, **kwargs: Any) -> Any:
        torch = sys.modules.get("torch")
        if torch is None or not torch.compiler.is_compiling():
            try:
                given = signature.bind(*args, **kwargs).arguments
            except TypeError:  # Python says it better
                return function(*args, **kwargs)
            keywords = next((p.name for p in signature.parameters.values() if p.kind is p.VAR_KEYWORD), "")
            check_arguments(target, {**given, **given.get(keywords, {})}, _hints(function))
        return function(*args, **kwargs)

    if inspect.isclass(target):
        target.__init__ = checking  # type: ignore[method-assign]
        return target
    return checking  # type: ignore[return-value]


def check_arguments(target: Callable[..., Any], given: Mapping[str, Any], hints: Mapping[str, Any]) -> None:
    """Check arguments against annotations, by name; what has none is not checked."""
    from jaxtyping import jaxtyped

    with jaxtyped("context"):  # sizes of one name are equal
        for name, value in given.items():
            if name in hints and not _conforms(value, hints[name]):
                if typing.get_origin(hints[name]) is Literal and isinstance(value, str) and len(value) < 100:
                    one_of(name, value, typing.get_args(hints[name]))  # names the nearest word too
                shape, kind = getattr(value, "shape", None), type(value).__name__
                got = reprlib.repr(value) if shape is None else f"{value.dtype} of shape {tuple(shape)}"
                said = getattr(target, "__annotations__", {}).get(name, hints[name])
                alias = isinstance(said, str) and said.isidentifier() and not inspect.isclass(hints[name])
                allowed = said if isinstance(said, str) and not alias else inspect.formatannotation(hints[name])
                allowed = allowed.replace("typing.", "").replace("collections.abc.", "")
                limits = ", with names of at most 255 bytes" if not can_name(value, 255) else ""
                got = " ".join(got.split())
                example = getattr(hints[name], "example", None)
                fix = f", such as {example}" if isinstance(example, str) else ""
                raise ConfigError(f"{target.__name__}: {name} is {got} ({kind}); it must be {allowed}{limits}{fix}")


@functools.cache
def _hints(function: Callable[..., Any]) -> dict[str, Any]:
    """Return the annotations, without those that name what only a type checker imports."""
    found, plain = {}, inspect.unwrap(function)
    for name, hint in getattr(plain, "__annotations__", {}).items():
        try:
            found[name] = hint = eval(hint, plain.__globals__) if isinstance(hint, str) else hint
        except NameError:
            continue
        if typing.get_origin(hint) is Unpack:
            found |= typing.get_type_hints(typing.get_args(hint)[0])
    return found


def can_name(value: Any, longest: int = 4096) -> bool:
    """Return whether text can be the path of a file, with names of so many bytes; other text is never so long."""
    parts = str(value).encode("utf-8", "surrogatepass").split(b"/") if isinstance(value, str | PurePath) else [b""]
    return max(map(len, parts)) <= longest and len(parts) <= 2000 and not any(b"\0" in part for part in parts)


def _conforms(value: Any, hint: Any) -> bool:
    """Return whether a value is what an annotation says, as far as that can be told without using it up."""
    origin, inside = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any or isinstance(hint, TypeVar):
        return True
    if hint is None:
        return value is None
    if origin in (Union, types.UnionType):
        paths = any(inspect.isclass(each) and issubclass(each, PurePath) for each in inside)
        return any(_conforms(value, each) for each in inside) and (not paths or can_name(value, 255))
    if origin is Literal:
        return any(value is each or (type(value) is type(each) and value == each) for each in inside)
    if origin in (list, tuple, Sequence):
        of = (inside or (Any,))[0]
        return isinstance(value, Sequence) and not isinstance(value, str) and all(_conforms(each, of) for each in value)
    if origin in (dict, Mapping):
        return isinstance(value, Mapping)
    if hint in (int, float):
        endless = isinstance(value, int) and abs(value) >= 1 << 63
        return isinstance(value, numbers.Integral if hint is int else numbers.Real) and not endless
    if not can_name(value):
        return False
    try:
        return isinstance(value, origin or hint)
    except TypeError:  # a protocol, or another annotation that values are not instances of
        return True
