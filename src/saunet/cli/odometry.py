"""``saunet-odometry``: the path of the camera through whole sequences, its errors, its files and its picture."""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig

from saunet import config
from saunet.checks import ConfigError, require_matplotlib
from saunet.cli._app import pick_device, run


def odometry(cfg: DictConfig) -> None:
    """Predict the path through each test sequence and compare it with the true one where that is known."""
    from rich.console import Console

    from saunet.checkpoint import read_checkpoint
    from saunet.evaluation.foreign import file_stem
    from saunet.evaluation.motion import predict_trajectory
    from saunet.evaluation.odometry import path_errors, path_of, path_table, write_errors, write_path
    from saunet.evaluation.plot import draw_path
    from saunet.registry import instantiate

    if cfg.figure:
        require_matplotlib("figure=true needs", "figure=false")
    checkpoint = read_checkpoint(cfg.checkpoint)
    record, device, output = checkpoint.record, pick_device(cfg.device), Path(cfg.output_dir)
    pose = checkpoint.networks()[1]
    if pose is None:
        raise ConfigError(f"{cfg.checkpoint} has no pose network (it was trained on stereo pairs); a path needs one")
    fixed = {"height": record.height, "width": record.width, "offsets": list(record.offsets)}
    data = instantiate({**config.plain(cfg.data), **fixed})
    data.setup("test")
    errors = []
    for drive in data.datasets["test"].drives:
        predicted = predict_trajectory(
            pose.to(device),
            drive,
            offsets=record.offsets,
            height=record.height,
            width=record.width,
            device=device,
            batch_size=cfg.batch_size,
        )
        if record.scale is not None:
            predicted[:, :3, 3] *= record.scale.factor
        path = path_of(drive, predicted)
        folder = output / file_stem(drive.name)
        write_path(path, folder)
        if cfg.figure:
            draw_path(path, folder / "path.png")
        if path.true is None:
            print(f"{drive.name}: no true poses, so the path is written and not compared")
        else:
            errors.append(path_errors(path, cfg.snippet, list(cfg.lengths) if cfg.lengths else None))
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
