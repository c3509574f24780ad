"""``saunet-train``: train a depth network on driving video."""

from __future__ import annotations

from typing import Any

from omegaconf import DictConfig

from saunet import config
from saunet.cli._app import run, sentence


def train(cfg: DictConfig) -> float | None:
    """Train, print where the results are, and return what a search minimizes."""
    cost: float | None = fit(cfg).cost
    return cost


def fit(cfg: DictConfig) -> Any:
    """Turn the composed config into options, once, and train."""
    from hydra.core.hydra_config import HydraConfig

    from saunet.training.tool import TrainOptions
    from saunet.training.tool import train as train_

    config.check_sweep(cfg)
    hydra = HydraConfig.get()
    return train_(
        TrainOptions.from_plain(config.plain(cfg)),
        choices=config.plain(hydra.runtime.choices),
        overrides=list(hydra.overrides.task),
        describe=sentence,
    )


def main() -> None:
    """Entry point of ``saunet-train``."""
    config.register_training_configs()
    run("train", train)


if __name__ == "__main__":
    main()
