"""A tool that returns the options it was given, for tests of the command line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from saunet.errors import ConfigError
from saunet.registry import Spec


@dataclass(frozen=True, kw_only=True)
class Inner:
    """Nested.

    Args:
        factor: How much.
    """

    factor: float = 1.0
    note: str | None = None


@dataclass(frozen=True, kw_only=True)
class EchoOptions:
    """What is echoed."""

    data: Spec | None = None
    input: str | None = None
    """A file."""
    output_dir: str | Path = "out"
    names: tuple[str, ...] = ()
    numbers: Sequence[float] | None = None
    mode: Literal["a", "b"] = "a"
    flag: bool = False
    count: int = 3
    extra: Mapping[str, Any] = field(default_factory=dict)
    inner: Inner = field(default_factory=Inner)

    def __post_init__(self) -> None:
        if self.count < 0:
            raise ConfigError(f"count is {self.count}; it must be at least 0")


@dataclass(frozen=True)
class Echo:
    """The options as text."""

    options: EchoOptions
    failures: tuple[str, ...] = ()

    def __str__(self) -> str:
        return repr(self.options)


ECHOED: list[EchoOptions] = []


def echo(options: EchoOptions) -> Echo:
    """Return what was given."""
    ECHOED.append(options)
    return Echo(options)
