"""``saunet-odometry``: the path of the camera through whole sequences, its errors, its files and its picture."""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig

from saunet import config
from saunet.cli._app import pick_device, run
from saunet.errors import positive, require_matplotlib


def odometry(cfg: DictConfig) -> None:
    """Predict the path through each test sequence and compare it with the true one where that is known."""
    from rich.console import Console

    from saunet.evaluation.foreign import file_stem
    from saunet.evaluation.odometry import (
        path_errors,
        path_of,
        path_table,
        straight_ahead,
        write_errors,
        write_path,
    )
    from saunet.evaluation.plot import draw_path
    from saunet.metrics.odometry import check_lengths, check_snippet
    from saunet.prediction.odometer import Odometer, follow
    from saunet.registry import instantiate
    from saunet.weights.files import read_model
    from saunet.weights.locate import locate

    lengths = list(cfg.lengths) if cfg.lengths else None
    check_snippet(cfg.snippet)
    check_lengths(lengths or ())
    positive("batch_size", cfg.batch_size)
    if cfg.figure:
        require_matplotlib("figure=true needs", "figure=false")
    source, output = locate(cfg.checkpoint), Path(cfg.output_dir)
    record = read_model(source).record
    odometer = Odometer.from_model(source, device=pick_device(cfg.device), batch_size=cfg.batch_size)
    fixed = {"height": record.height, "width": record.width, "offsets": list(record.offsets)}
    data = instantiate({**config.plain(cfg.data), **fixed})
    data.setup("test")
    errors = []
    for drive in data.datasets["test"].drives:
        predicted = follow(odometer, drive)
        path = path_of(drive, predicted)
        folder = output / file_stem(drive.name)
        write_path(path, folder)
        if path.true is None:
            print(f"{drive.name}: no true poses, so the path is written and not compared")
        else:
            errors += [path_errors(each, cfg.snippet, lengths) for each in (path, straight_ahead(path))]
        if cfg.figure:
            draw_path(path, folder / "path.png", errors[-2:] if path.true is not None else ())
    scale = None if record.scale is None else {"factor": record.scale.factor, "source": record.scale.source}
    write_errors(errors, output, {"checkpoint": str(cfg.checkpoint), "scale": scale})
    if errors:
        Console().print(path_table(errors))
    print(f"results: {output}")


def main() -> None:
    """Entry point of ``saunet-odometry``."""
    run("odometry", odometry)


if __name__ == "__main__":
    main()
