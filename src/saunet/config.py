"""The command-line tools' configuration: where ``conf/`` lies, what Hydra knows, and checks across parts."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from saunet.errors import ConfigError
from saunet.registry import REGISTRIES
from saunet.roots import ROOTS, ModelConfig


def config_dir() -> Path:
    """Return the folder of the YAML files: inside the installed package, or ``conf/`` of a source checkout.

    Raises:
        ConfigError: if neither exists (a broken installation).
    """
    package = Path(__file__).resolve().parent
    for folder in (package / "conf", package.parents[1] / "conf"):
        if (folder / "train.yaml").is_file():
            return folder
    raise ConfigError(f"no configuration files beside {package}; reinstall saunet")


def register_configs(kinds: Collection[str] = tuple(REGISTRIES)) -> None:
    """Put the root schemas and every registered component of these kinds into Hydra's config store.

    Args:
        kinds: Kinds of components, keys of `saunet.registry.REGISTRIES`; all by default. Their packages are imported.
    """
    from saunet.cli import app, compose

    store = ConfigStore.instance()
    for root in ROOTS:
        if root is ModelConfig:  # part of roots
            continue
        store.store(name=f"{root.__name__.removesuffix('Config').lower()}_schema", node=root)
    tools = {tool.config or name: name for name, tool in app.TOOLS.items() if tool.options}
    compose.register(app.table(), tools)


def register_training_configs() -> None:
    """Nothing more is needed."""


def plain(node: Any) -> Any:
    """Return a config node as plain containers with all references resolved: what components and checkpoints see."""
    return OmegaConf.to_container(node, resolve=True, throw_on_missing=True) if OmegaConf.is_config(node) else node
