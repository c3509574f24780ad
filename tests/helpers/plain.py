"""A composed configuration as plain containers."""

from __future__ import annotations

from omegaconf import OmegaConf


def plain(node: object) -> object:
    """Return a config node as plain containers with all references resolved; what is no node as it is."""
    return OmegaConf.to_container(node, resolve=True, throw_on_missing=True) if OmegaConf.is_config(node) else node
