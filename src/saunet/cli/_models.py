"""Which models ``saunet benchmark`` measures, and the names they go by."""

from __future__ import annotations

import re
from typing import Any

from hydra import compose
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from saunet import config
from saunet.errors import ConfigError

CHANGED = " (changed)"
"""Stands behind the name of a model that the command line has changed: it is not what the paper measured."""


def build(model: DictConfig) -> Any:
    """Build the networks of a ``model`` config node, with random weights."""
    from saunet.models.depth import DepthNet
    from saunet.registry import instantiate
    from saunet.tools.benchmark import Networks

    node = config.plain(model)
    depth = DepthNet(instantiate(node["encoder"]), instantiate(node["decoder"]), node["min_depth"], node["max_depth"])
    return Networks(depth, instantiate(node["pose"]) if node["pose"] else None)


def chosen(cfg: DictConfig) -> dict[str, DictConfig]:
    """Return the ``model`` nodes to measure by the name they are shown under, which a changed model does not share.

    Raises:
        ConfigError: if ``models`` stands beside changes of a model.
    """

    def named(name: str) -> DictConfig:
        return compose("benchmark", overrides=[f"model={name}"]).model  # type: ignore[no-any-return]

    if cfg.models:
        changes = [change for change in HydraConfig.get().overrides.task if re.match(r"[+~]*model[=./@]", change)]
        if changes:
            raise ConfigError(
                f"models= measures each model as it is named, so '{changes[0]}' would change nothing; "
                "leave out one of the two"
            )
        return {name: named(name) for name in cfg.models}
    name = HydraConfig.get().runtime.choices["model"]
    changed = _architecture(cfg.model) != _architecture(named(name))
    return {name + CHANGED * changed: cfg.model}


def _architecture(model: DictConfig) -> Any:
    """Return what decides the cost of a model: all but the weights it starts from."""
    return {
        part: {key: value for key, value in node.items() if key != "weights"} if isinstance(node, dict) else node
        for part, node in config.plain(model).items()
    }
