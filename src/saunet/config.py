"""The command-line tools' configuration: where ``conf/`` lies, what Hydra knows, and checks across parts."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf

from saunet import schema
from saunet.errors import ConfigError
from saunet.registry import REGISTRIES
from saunet.roots import ROOTS, ModelConfig, ScaleConfig


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
    from saunet.cli.compose import structured

    store = ConfigStore.instance()
    for root in ROOTS:
        if root in (ModelConfig, ScaleConfig):  # parts of roots
            continue
        store.store(name=f"{root.__name__.removesuffix('Config').lower()}_schema", node=root)
    for kind in kinds:
        registry = REGISTRIES[kind]
        if registry.group is None:
            continue
        for entry in registry:
            store.store(group=registry.group, name=entry.name, node=structured(registry.node(entry.name)))


def register_training_configs() -> None:
    """Add the nodes that need Lightning to be imported: the trainer's own options and the optimization recipe."""
    from lightning import Trainer

    from saunet.cli.compose import structured
    from saunet.training.optim import Recipe
    from saunet.training.speed import Speed

    store = ConfigStore.instance()
    store.store(group="trainer", name="lightning", node=structured(schema.node(Trainer, path="lightning.Trainer")))
    store.store(group="optim", name="recipe", node=structured(schema.node(Recipe)))
    store.store(group="speed", name="switches", node=structured(schema.node(Speed)))


def plain(node: Any) -> Any:
    """Return a config node as plain containers with all references resolved: what components and checkpoints see."""
    return OmegaConf.to_container(node, resolve=True, throw_on_missing=True) if OmegaConf.is_config(node) else node


def check_sweep(cfg: DictConfig) -> None:
    """Check that the jobs of a sweep do not start the whole sweep again in each of their processes.

    Raises:
        ConfigError: if they would.
    """
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode

    if _replays_command_line(cfg) and HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN:
        raise ConfigError(
            "--multirun with several processes per job would replay the whole sweep on every process; use "
            "trainer.devices=1 for its jobs, or start each training with a command of its own: "
            "for seed in 1 2; do saunet-train trainer=ddp seed=$seed; done"
        )


def _replays_command_line(cfg: DictConfig) -> bool:
    """Return whether the trainer will start further processes by running this command again."""
    strategy = str(cfg.trainer.strategy).lower()  # a name, or a node with a _target_
    several = str(cfg.trainer.devices) not in ("1", "[0]", "auto") or cfg.trainer.num_nodes > 1
    return several or any(kind in strategy for kind in ("ddp", "fsdp", "deepspeed"))
