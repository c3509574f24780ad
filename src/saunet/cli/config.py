"""Where the YAML files lie, and their use without a command line: in tests, benchmarks and notebooks."""

from __future__ import annotations

from pathlib import Path

from saunet.errors import ConfigError


def config_dir() -> Path:
    """Return the folder of the YAML files: inside the installed package, or ``conf/`` of a source checkout.

    Raises:
        ConfigError: if neither exists (a broken installation).
    """
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "conf", package.parents[1] / "conf"):
        if (folder / "train.yaml").is_file():
            return folder
    raise ConfigError(f"no configuration files beside {package}; reinstall saunet")


def register_configs() -> None:
    """Give Hydra the typed keys of all tools and components, for ``hydra.compose``."""
    from saunet.cli import app, compose

    compose.register(app.table(), {tool.config or name: name for name, tool in app.TOOLS.items() if tool.options})


def plain(node: object) -> object:
    """Return a config node as plain containers with all references resolved; what is no node as it is."""
    from omegaconf import OmegaConf

    return OmegaConf.to_container(node, resolve=True, throw_on_missing=True) if OmegaConf.is_config(node) else node
