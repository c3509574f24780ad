"""The command-line tools' configuration: where ``conf/`` lies, what Hydra knows, and checks across parts."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf

from saunet import schema
from saunet.errors import ConfigError, in_range, one_of, positive
from saunet.registry import REGISTRIES
from saunet.roots import ROOTS, ModelConfig, ScaleConfig

PRECISIONS = ("32-true", "32", "16-mixed", "16", "bf16-mixed", "bf16")
"""Precisions in which a training runs: images and losses stay in float32."""


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


def check(cfg: DictConfig) -> None:
    """Check what no single part can know.

    Raises:
        ConfigError: if the parts of a training configuration do not fit together.
    """
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode

    in_range("seed", positive("seed", cfg.seed, allow_zero=True), 0, 2**32 - 1)
    _check_trainer(cfg.trainer)
    if cfg.optim.fused and str(cfg.trainer.precision).startswith("16") and cfg.trainer.gradient_clip_val:
        raise ConfigError(
            "optim.fused=true, trainer.precision=16-mixed and trainer.gradient_clip_val do not go together: the fused "
            "optimizer unscales gradients after they would have been clipped; use trainer.precision=bf16-mixed, or "
            "leave one out"
        )
    if cfg.trainer.max_epochs == -1 and cfg.trainer.max_steps == -1:
        raise ConfigError(
            "trainer.max_epochs is -1: a training without end has no schedule; set it, or trainer.max_steps"
        )
    if cfg.trainer.enable_progress_bar is False and cfg.callbacks.get("progress"):
        raise ConfigError(
            "trainer.enable_progress_bar is false, but callbacks.progress draws a bar; "
            "set callbacks.progress=null instead"
        )
    if _replays_command_line(cfg) and HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN:
        raise ConfigError(
            "--multirun with several processes per job would replay the whole sweep on every process; "
            "use trainer=ddp_spawn, or one process per job through a Hydra launcher"
        )
    objective = plain(cfg.objective)
    gradient = objective.get("gradient") or {}
    has_lidar = cfg.data.get("target_depth", False) or cfg.data.get("dense", "none") != "none"
    if gradient.get("target") == "lidar" and not has_lidar:
        raise ConfigError(
            "objective.gradient.target=lidar needs LiDAR depth in the training batches; "
            "set data.target_depth=true, or use objective.gradient.target=image"
        )


def _check_trainer(trainer: Any) -> None:
    """Check what Lightning's trainer takes in silence and stumbles over later.

    Raises:
        ConfigError: for a value with which no training can run.
    """
    for key in ("accumulate_grad_batches", "check_val_every_n_epoch", "val_check_interval"):
        value = trainer.get(key)
        if isinstance(value, int | float):
            positive(f"trainer.{key}", value)
    if trainer.precision is not None:
        one_of("trainer.precision", str(trainer.precision), PRECISIONS)
    if trainer.overfit_batches:
        raise ConfigError(
            f"trainer.overfit_batches is {trainer.overfit_batches}, which takes the place in the data order away that "
            "a training keeps; use trainer.limit_train_batches with few frames instead"
        )


def _replays_command_line(cfg: DictConfig) -> bool:
    """Tell whether the trainer will start further processes by running this command again."""
    strategy = str(cfg.trainer.strategy).lower()  # a name, or a node with a _target_
    if "spawn" in strategy or "fork" in strategy:
        return False
    several = str(cfg.trainer.devices) not in ("1", "[0]", "auto") or cfg.trainer.num_nodes > 1
    return several or any(kind in strategy for kind in ("ddp", "fsdp", "deepspeed"))
