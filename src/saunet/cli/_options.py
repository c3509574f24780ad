"""From a composed config to the options of a tool: the one conversion, after which nothing knows of Hydra."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import Any, TypeVar

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from saunet import config
from saunet.registry import Spec

Options = TypeVar("Options")


def options_of(cls: Callable[..., Options], cfg: DictConfig, **made: Any) -> Options:
    """Return the options that a config describes.

    Args:
        cls: The options' dataclass.
        cfg: The root of the tool's config.
        made: Values in place of the config's, by their key; classes are made of the config's.
    """
    plain: dict[str, Any] = config.plain(cfg)
    values: dict[str, Any] = {}
    for name in (each.name for each in fields(cls) if each.name in plain):  # type: ignore[arg-type]
        value = plain[name]
        if name in made:
            value = made[name](**value) if isinstance(made[name], type) else made[name]
        elif name == "data":
            value = Spec(value, HydraConfig.get().runtime.choices.get("data"))
        values[name] = tuple(value) if isinstance(value, list) else value
    return cls(**values)
