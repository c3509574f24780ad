"""The numbers that the SAU-Net paper prints (Tables 1 to 3, Fig. 10), from ``published.json`` beside this file."""

from __future__ import annotations

import functools
import json
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources


@dataclass(frozen=True, slots=True)
class Result:
    """One printed row of Table 1 or 3."""

    method: str
    errors: Sequence[float | None]
    """In the order of `saunet.metrics.functional.ERROR_NAMES`; None where the paper prints a dash."""
    pattern: str = ""
    """Table 1: D for depth as supervision, M for monocular video, S for stereo pairs."""
    stratified: bool = False
    """Table 3: with the stratified transformer as encoder."""
    attention: bool = False
    """Table 3: with the attention decoder."""


@dataclass(frozen=True, slots=True)
class Size:
    """One row of Table 2."""

    method: str
    megaparameters: float
    """Of depth and pose network together; the paper's "Mb"."""


@dataclass(frozen=True, slots=True)
class Speed:
    """One point of Fig. 10 that the text gives in numbers."""

    method: str
    a1: float
    seconds: float
    device: str


@dataclass(frozen=True, slots=True)
class Published:
    """All of it."""

    table1: tuple[Result, ...]
    table2: tuple[Size, ...]
    table3: tuple[Result, ...]
    figure10: tuple[Speed, ...]


@functools.cache
def published() -> Published:
    """Return the paper's numbers."""
    content = json.loads(resources.files("saunet").joinpath("published.json").read_text(encoding="utf-8"))
    kinds = {"table1": Result, "table2": Size, "table3": Result, "figure10": Speed}
    return Published(**{name: tuple(kind(**row) for row in content[name]) for name, kind in kinds.items()})
