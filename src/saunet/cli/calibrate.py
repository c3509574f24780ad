"""``saunet-calibrate``: ``camera.yaml`` from a video or pictures of a chessboard or ChArUco board."""

from __future__ import annotations

from omegaconf import DictConfig

from saunet import config
from saunet.cli._app import run


def calibrate(cfg: DictConfig) -> None:
    """Calibrate, or print a board, and say how good the result is."""
    from saunet.tools.calibrate.tool import CalibrateOptions, calibrate

    print(calibrate(CalibrateOptions(**config.plain(cfg))))


def main() -> None:
    """Entry point of ``saunet-calibrate``."""
    run("calibrate", calibrate)


if __name__ == "__main__":
    main()
