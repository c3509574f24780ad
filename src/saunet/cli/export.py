"""``saunet export``: a checkpoint as files to deploy or share, each checked against the network it came from."""

from __future__ import annotations

import sys

from omegaconf import DictConfig

from saunet.cli._app import run


def export(cfg: DictConfig) -> None:
    """Export into the output folder and print how the files compare with the network."""
    from rich.console import Console
    from rich.table import Table

    from saunet.exporting.export import export_model

    if cfg.images is None:
        print("saunet export: images is not set, so only random images are compared", file=sys.stderr)
    reports = export_model(
        cfg.checkpoint,
        cfg.output,
        list(cfg.formats),
        images=() if cfg.images is None else cfg.images,
        batch=cfg.batch,
        evaluation=cfg.evaluation,
        overwrite=cfg.overwrite,
    )
    table = Table("file", "MB", "batch", "differs by", "random", "real", "eager ms", "this ms", box=None)
    for report in reports:
        table.add_row(
            report.file,
            f"{report.megabytes:.1f}",
            report.batch,
            f"{report.difference:.1e}",
            str(report.random),
            str(report.real),
            f"{report.eager_ms:.1f}",
            f"{report.exported_ms:.1f}",
        )
    Console().print(table)
    print("differs by: largest difference in disparity over all images, as a share of its range")
    print(f"exported, with report.json and a model card: {cfg.output}")


def main() -> None:
    """Entry point of ``saunet export``."""
    run("export", export, kinds=())


if __name__ == "__main__":
    main()
