"""Constructor signature -> typed config node."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pytest
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from typing_extensions import TypedDict, Unpack

from saunet import schema
from saunet.cli.compose import structured


class Inner:
    """Nested."""

    def __init__(self, weight: float = 1.0) -> None:
        self.weight = weight


class Outer:
    """All the kinds of parameter that a component may have."""

    def __init__(
        self,
        features: Sequence[int],
        size: int,
        depths: Sequence[int] = (2, 2),
        window: tuple[int, ...] | None = None,
        rate: float = 0.5,
        mode: Literal["a", "b"] = "a",
        flag: bool = True,
        root: Path = Path("data"),
        note: str | None = None,
        either: int | Sequence[int] = 3,
        weights: Mapping[str, float] | None = None,
        inner: Inner | None = None,
        extra: Mapping[str, Any] | None = None,
    ) -> None: ...


@pytest.fixture
def config() -> Any:
    return OmegaConf.structured(structured(schema.node(Outer, preset={"rate": 0.1}, late=("features",))))


def test_defaults_presets_and_late_parameters(config: Any) -> None:
    assert "features" not in config
    assert config._partial_ is True
    assert config.rate == 0.1
    assert config.depths == [2, 2]
    assert config.inner == {"_target_": f"{__name__}.Inner", "_convert_": "all", "weight": 1.0}
    assert OmegaConf.is_missing(config, "size")


@pytest.mark.parametrize(
    "wrong",
    [
        {"dephts": [1]},
        {"depths": ["x"]},
        {"depths": 3},
        {"rate": "fast"},
        {"flag": "perhaps"},
        {"window": ["x"]},
        {"inner": {"wieght": 2}},
        {"weights": {"a": "much"}},
    ],
)
def test_a_wrong_key_or_type_fails_while_composing(config: Any, wrong: dict[str, Any]) -> None:
    with pytest.raises(OmegaConfBaseException):
        OmegaConf.merge(config, wrong)


def test_right_values_pass(config: Any) -> None:
    merged = OmegaConf.merge(
        config,
        {"size": 3, "depths": [1], "window": [7], "either": [1], "weights": {"a": 1}, "extra": {"k": {"deep": 1}}},
    )
    assert merged.window == [7]
    assert merged.either == [1]


def test_nodes_do_not_share_mutable_defaults() -> None:
    made = structured(schema.node(Outer))
    first, second = made(), made()
    first.depths.append(9)
    assert second.depths == [2, 2]


@dataclass(frozen=True, kw_only=True)
class Options:
    """Settings of several components.

    Args:
        size: How large.
    """

    size: int = 8
    name: Literal["a", "b"] = "a"


class Keywords(TypedDict, total=False):
    """The fields of `Options`."""

    size: int
    name: Literal["a", "b"]


class Component:
    """Takes the settings beside its own.

    Args:
        root: Where.
        **more: As in `Options`.
    """

    def __init__(self, *, root: str = "x", **more: Unpack[Keywords]) -> None:
        self.root, self.options = root, Options(**more)


def test_keywords_of_an_options_class_are_flat_keys() -> None:
    schema.unpacked(Keywords, Options)
    described = schema.node(Component, {"size": 4})
    assert [(key.name, key.help) for key in described.keys] == [
        ("root", "Where."),
        ("size", "How large."),
        ("name", ""),
    ]
    node = OmegaConf.structured(structured(described))
    assert {key: node[key] for key in ("root", "size", "name")} == {"root": "x", "size": 4, "name": "a"}
    with pytest.raises(OmegaConfBaseException):
        node["size"] = "many"
