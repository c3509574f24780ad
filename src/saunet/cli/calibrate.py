"""``saunet-calibrate``: ``camera.yaml`` from a video or pictures of a chessboard or ChArUco board."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

from omegaconf import DictConfig

from saunet.cli._app import run
from saunet.errors import ConfigError, one_of, positive


def calibrate(cfg: DictConfig) -> None:
    """Print a board, or find one, solve for the camera, say how good that is, and write ``camera.yaml``.

    Raises:
        ConfigError: if there is nothing to read, or the output exists.
        DataError: if the calibration cannot be trusted.
    """
    from saunet.data.camera_file import MODELS, write_camera
    from saunet.io.images import write_image
    from saunet.io.progress import bar
    from saunet.tools.calibrate.boards import Board
    from saunet.tools.calibrate.calibrate import calibrate, check_picture

    board = Board(cfg.board, cfg.columns, cfg.rows, cfg.square, cfg.marker, cfg.dictionary)
    if cfg.print_board:
        write_image(cfg.print_board, board.picture())
        print(f"{board}: {cfg.print_board}; print it, glue it to something flat, and measure a square")
        return
    if cfg.input is None:
        raise ConfigError("input is not set; add input=board.mp4 (a video or a folder of pictures), or print_board=...")
    output = Path(cfg.output)
    if output.exists() and not cfg.overwrite:
        raise ConfigError(f"{output} exists; choose another output, or set overwrite=true")
    height = None if cfg.camera_height is None else float(positive("camera_height", cfg.camera_height))
    with bar() as shown:
        task = shown.add_task("looking for the board", total=None)
        result = calibrate(
            cfg.input,
            board,
            model=one_of("lens", cfg.lens, MODELS),
            views=cfg.views,
            max_error=cfg.max_error,
            advance=lambda done, total: shown.update(task, completed=done, total=total),
        )
    camera = replace(result.camera, camera_height=height, condition=cfg.condition)
    note = f"from {len(result.views)} views of a {board} in {Path(cfg.input).name}"
    write_camera(output, camera, f"saunet-calibrate: {note}")
    picture = output.with_name(f"{output.stem}_check.png")
    write_image(picture, check_picture(result))
    K = camera.K
    print(f"{note} ({result.looked_at} looked at, {result.dropped} left out as misfits)")
    known = "" if math.isnan(result.uncertainty) else f"; focal length known to {result.uncertainty:.2%}"
    print(f"reprojection error {result.error:.3f} px{known}")
    print(f"fx {K[0, 0]:.2f}, fy {K[1, 1]:.2f}, cx {K[0, 2]:.2f}, cy {K[1, 2]:.2f}")
    if result.coverage < 0.6:
        print(f"the board was seen in {result.coverage:.0%} of the image only: hold it into the corners too")
    print(f"camera: {output}; look at {picture}: straight lines must be straight on its right side")


def main() -> None:
    """Entry point of ``saunet-calibrate``."""
    run("calibrate", calibrate)


if __name__ == "__main__":
    main()
