"""``saunet-odometry``: the path of the camera through whole sequences, its errors, its files and its picture."""

from __future__ import annotations

from omegaconf import DictConfig

from saunet.cli._app import run
from saunet.cli._options import options_of


def odometry(cfg: DictConfig) -> None:
    """Predict the paths that the config asks for, and print their errors."""
    from saunet import evaluation

    evaluation.odometry(options_of(evaluation.OdometryOptions, cfg)).show()


def main() -> None:
    """Entry point of ``saunet-odometry``."""
    run("odometry", odometry)


if __name__ == "__main__":
    main()
