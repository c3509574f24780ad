"""The plain record of a model: all but the weights that using it again needs; reading it needs no torch.

It stands under ``"saunet"`` in every checkpoint and as JSON beside every exported model.
"""

from __future__ import annotations

import itertools
import math
import os
import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from saunet import __version__, plugins
from saunet.errors import CheckpointError, ConfigError, positive
from saunet.registry import find

FORMAT = 1
"""Version of the record's layout; raised when an older reader would misunderstand a newer file."""

MAX_PIXELS = 1 << 24
"""Largest input of a network (4K video has 8.3 million pixels): a file cannot ask for more, and no training either."""
MAX_NUMBER = 1 << 16
"""Largest whole number among the settings of networks; registered ones reach a few thousand."""
LIMIT_FACTOR = "SAUNET_LIMIT_FACTOR"
"""Environment variable with a factor by which these limits, and that of a network's size, are multiplied."""
_VALUES, _DEPTH, _TEXT = 100_000, 64, 10_000
_SLOTS = ("encoder", "decoder", "pose")
_NESTED = (*_SLOTS, "attention")


def limit_factor() -> float:
    """Return the factor by which whoever trusts the files multiplies what a record may ask for; 1 by default."""
    text = os.environ.get(LIMIT_FACTOR, "1")
    try:
        return positive(LIMIT_FACTOR, float(text))
    except ValueError as reason:
        raise ConfigError(f"{LIMIT_FACTOR} is '{text[:60]}'; it must be a number greater than 0") from reason


@dataclass(frozen=True, slots=True)
class Scale:
    """The factor that turns a model's depth into meters, and where it is known from."""

    factor: float
    source: str
    """Such as ``"camera height 1.65 m"`` or ``"median over LiDAR"``."""

    def __post_init__(self) -> None:
        if not 0 < self.factor < math.inf:
            raise CheckpointError(f"scale factor is {self.factor}; it must be a finite number above 0")


def unit_of(scale: Scale | None) -> str:
    """Return in words what one unit of depth is, given the scale that was applied."""
    return f"meters (scale from {scale.source})" if scale else "relative (meters times one unknown factor)"


def scale_sentence(scale: Scale | None) -> str:
    """Return what a model's card says of its scale."""
    if scale is None:
        return "Depth is relative: multiply it by one unknown factor to get meters."
    return f"Network depth x {scale.factor:g} is meters; the factor comes from {scale.source}."


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """The focal lengths that a training found (``model.intrinsics``)."""

    mode: str
    """``refined`` or ``learned``."""
    focals: Mapping[str, tuple[float, float]]
    """Recording -> focal length before and after, in picture widths."""

    def __post_init__(self) -> None:
        if not self.focals or not all(0 < each < math.inf for pair in self.focals.values() for each in pair):
            raise CheckpointError(f"the model record's focal lengths are {_short(self.focals)}; they must be above 0")

    def to_plain(self) -> dict[str, Any]:
        """Return it as plain containers."""
        return {"mode": self.mode, "focals": {name: list(pair) for name, pair in self.focals.items()}}

    @property
    def mean(self) -> tuple[float, float]:
        """The geometric means of the focal lengths before and after."""
        before, after = zip(*self.focals.values(), strict=True)
        return statistics.geometric_mean(before), statistics.geometric_mean(after)

    def focal(self, recording: str, own: float) -> float:
        """Return a recording's focal length; of one that was not trained on, with its ``own``, by the mean of all."""
        if recording in self.focals:
            return self.focals[recording][1]
        before, after = self.mean
        return own * after / before if self.mode == "refined" else after


@dataclass(frozen=True, slots=True)
class ModelRecord:
    """Everything but the weights that prediction needs, as plain data; networks as config nodes with ``_target_``."""

    encoder: Mapping[str, Any]
    decoder: Mapping[str, Any]
    pose: Mapping[str, Any] | None
    min_depth: float
    """Depth at sigmoid 1, meters up to scale; ``max_depth`` is that at sigmoid 0."""
    max_depth: float
    height: int
    """Of the network's input in pixels."""
    width: int
    offsets: tuple[int, ...] = (-1, 1)
    """Time offsets of the sources that the pose network was trained with."""
    scale: Scale | None = None
    data: Mapping[str, Any] = field(default_factory=dict)
    """Facts about the training data, free-form."""
    version: str = __version__
    plugins: tuple[str, ...] = ()
    """Modules outside saunet that register its components."""
    intrinsics: Intrinsics | None = None
    """None if the training took the data's."""

    def __post_init__(self) -> None:
        if not 0 < self.min_depth < self.max_depth < math.inf:
            raise CheckpointError(
                f"the model record's depth range is {self.min_depth} to {self.max_depth}; it must satisfy 0 < min < max"
            )
        if self.height < 1 or self.width < 1:
            raise CheckpointError(f"the model record's size is {self.height}x{self.width}; both must be above 0")
        most = int(MAX_PIXELS * limit_factor())
        if self.height * self.width > most:
            raise CheckpointError(
                f"the model record's size is {self.height}x{self.width}; at most {most:,} pixels are allowed, "
                f"or more with {LIMIT_FACTOR}"
            )

    def to_plain(self) -> dict[str, Any]:
        """Return what stands under ``"saunet"`` in a checkpoint."""
        nodes = {slot: _plain(getattr(self, slot)) for slot in _SLOTS}
        return {
            "format": FORMAT,
            "version": self.version,
            "model": {**nodes, "min_depth": float(self.min_depth), "max_depth": float(self.max_depth)},
            "height": self.height,
            "width": self.width,
            "offsets": list(self.offsets),
            "scale": asdict(self.scale) if self.scale else None,
            "data": _plain(self.data),
            **({"plugins": list(self.plugins)} if self.plugins else {}),
            **({"intrinsics": self.intrinsics.to_plain()} if self.intrinsics else {}),
        }

    @classmethod
    def from_plain(cls, plain: Any) -> ModelRecord:
        """Read a record, checking that no key is missing, every value can work, and this version knows the layout.

        How much it may ask for is bounded first: values, nesting, numbers (`MAX_NUMBER`) and pixels (`MAX_PIXELS`).
        """
        _check_bounds(plain)
        if not isinstance(plain, Mapping) or not isinstance(plain.get("format"), int):
            raise CheckpointError(f"the model record is {_short(plain)}; it must be a mapping with a 'format' number")
        if plain["format"] > FORMAT:
            raise CheckpointError(
                f"the model record has format {plain['format']}, written by saunet {plain.get('version', '?')}; "
                f"this is saunet {__version__}, which reads up to {FORMAT}; upgrade saunet"
            )
        model, scale = _get(plain, "model", Mapping), _get(plain, "scale", Mapping | None)
        found = _get({"intrinsics": None, **plain}, "intrinsics", Mapping | None)
        return cls(
            encoder=_node(model, "encoder"),
            decoder=_node(model, "decoder"),
            pose=_node(model, "pose") if model.get("pose") is not None else None,
            min_depth=_get(model, "min_depth", int | float),
            max_depth=_get(model, "max_depth", int | float),
            height=_get(plain, "height", int),
            width=_get(plain, "width", int),
            offsets=tuple(_get({"offsets": value}, "offsets", int) for value in _get(plain, "offsets", list | tuple)),
            scale=Scale(_get(scale, "factor", int | float), _get(scale, "source", str)) if scale is not None else None,
            data=_get(plain, "data", Mapping),
            version=_get(plain, "version", str),
            plugins=tuple(map(str, _get({"plugins": [], **plain}, "plugins", list))),
            intrinsics=None if found is None else Intrinsics(_get(found, "mode", str), _focals(found)),
        )

    def check_same_training(self, plain: Mapping[str, Any]) -> None:
        """Check that a training with another plain record sees the same images and depths, so that it can resume."""
        new = ModelRecord.from_plain(plain)
        for name in ("height", "width", "offsets", "min_depth", "max_depth"):
            before, now = getattr(self, name), getattr(new, name)
            if before != now:
                raise CheckpointError(
                    f"the checkpoint was trained with {name} {before} but this run has {now}; a resumed run "
                    "continues the same training, so give the same settings, as `saunet resume RUN` does"
                )

    def check_registered(self) -> None:
        """Check that every component is registered, in the place of its kind."""
        for slot in _SLOTS:
            node = getattr(self, slot)
            if node is not None and "_target_" not in node:
                raise CheckpointError(f"the recorded {slot} has no '_target_', so nothing is built")
            for depth, target in enumerate(_targets(node)):
                if find(target, (slot,) if depth == 0 else _NESTED) is None:
                    what = slot if depth == 0 else "part of a model"
                    raise CheckpointError(
                        f"the recorded {slot} asks for '{target}', which is not a registered {what}, "
                        f"so nothing is built; {plugins.asked_for(target, self.plugins)}"
                    )


def _check_bounds(plain: Any) -> None:
    """Check that a record is plain and small, however often it refers to its own parts."""
    level = [("", plain)]  # (key, value) pairs of one level of nesting
    for _ in range(_DEPTH):
        for name, value in level:
            if not isinstance(value, str | int | float | Mapping | list | tuple | None) or not isinstance(name, str):
                raise CheckpointError(
                    f"the model record's '{name}' is a {type(value).__name__}, which is not plain data"
                )
            if isinstance(value, int) and abs(value) >= 1 << 63:
                raise CheckpointError(f"the model record's '{name}' is a number of {value.bit_length()} bits")
            if isinstance(value, str) and len(value) > _TEXT:
                raise CheckpointError(f"the model record's '{name[:60]}' has {len(value):,} characters")
        inside = (
            (key, child)
            for name, each in level
            if isinstance(each, Mapping | list | tuple)
            for key, child in (each.items() if isinstance(each, Mapping) else ((name, child) for child in each))
        )
        level = list(itertools.islice(inside, _VALUES + 1))
        if not level:
            return
        if len(level) > _VALUES:
            raise CheckpointError(f"the model record has more than {_VALUES:,} values; the file is damaged")
    raise CheckpointError(f"the model record has more than {_DEPTH} levels of nesting; the file is damaged")


def _check_numbers(slot: str, node: Any) -> None:
    if isinstance(node, Mapping | list | tuple):
        for value in node.values() if isinstance(node, Mapping) else node:
            _check_numbers(slot, value)
    elif isinstance(node, int) and abs(node) > (most := int(MAX_NUMBER * limit_factor())):
        raise CheckpointError(
            f"the recorded {slot} asks for {node:,}; whole numbers up to {most:,} are allowed, or more with "
            f"{LIMIT_FACTOR}"
        )


def _targets(node: Any) -> Iterator[str]:
    """Yield every ``_target_`` of a node, the outermost first."""
    if isinstance(node, Mapping):
        if "_target_" in node:
            yield str(node["_target_"])
        for value in node.values():
            yield from _targets(value)
    elif isinstance(node, list | tuple):
        for value in node:
            yield from _targets(value)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(item) for item in value]
    if value is None or isinstance(value, str | bool | int | float):
        return value
    raise CheckpointError(f"a checkpoint keeps plain values only, got {_short(value)}; convert it first")


def _get(plain: Mapping[str, Any], key: str, kind: Any) -> Any:
    if key not in plain:
        raise CheckpointError(f"the model record lacks '{key}'; the file is damaged or was edited")
    value = plain[key]
    if not isinstance(value, kind) or isinstance(value, bool):
        raise CheckpointError(f"the model record's {key} is {_short(value)}; the file is damaged or was edited")
    return value


def _focals(found: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
    focals: Mapping[str, Any] = _get(found, "focals", Mapping)
    for name in focals:
        pair = _get(focals, name, list | tuple)
        if len(pair) != 2 or not all(isinstance(each, float) for each in pair):
            raise CheckpointError(
                f"the model record's focal lengths of '{name[:60]}' are {_short(pair)}; they must be two numbers"
            )
    return {name: (pair[0], pair[1]) for name, pair in focals.items()}


def _node(model: Mapping[str, Any], slot: str) -> Mapping[str, Any]:
    node: Mapping[str, Any] = _get(model, slot, Mapping)
    _get(node, "_target_", str)
    _check_numbers(slot, node)
    return node


def _short(value: Any) -> str:
    text = repr(value)
    return f"{type(value).__name__} {text if len(text) <= 60 else text[:57] + '...'}"
