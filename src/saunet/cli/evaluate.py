"""``saunet-evaluate``: score a checkpoint, or predictions made elsewhere, beside predictors that look at no image."""

from __future__ import annotations

from omegaconf import DictConfig

from saunet.cli._app import run
from saunet.cli._options import options_of


def evaluate(cfg: DictConfig) -> None:
    """Score what the config asks for, and print the tables."""
    from saunet import evaluation
    from saunet.scale.options import ScaleOptions

    evaluation.evaluate(options_of(evaluation.EvaluateOptions, cfg, scale=ScaleOptions)).show()


def main() -> None:
    """Entry point of ``saunet-evaluate``."""
    run("evaluate", evaluate)


if __name__ == "__main__":
    main()
