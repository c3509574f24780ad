"""``saunet report``: one page of tables, curves and pictures from finished runs; with ``compare``, how runs differ."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from saunet import config
from saunet.cli._app import pick_device, run
from saunet.cli._runs import arguments, planned_jobs
from saunet.errors import ConfigError


def report(cfg: DictConfig) -> None:
    """Read the runs and write the page, or, with ``compare=true``, print how they differ."""
    from rich.console import Console

    from saunet.reporting import Options, build, collect, write

    inputs = collect(list(cfg.runs or []), cfg.checkpoint, planned_jobs, strangers=not cfg.compare)
    if cfg.compare:
        from saunet.reporting.compare import print_comparison

        console = Console()
        print_comparison(inputs, list(cfg.labels), console if console.is_terminal else Console(width=160))
        return
    options = Options(
        title=cfg.title,
        labels=list(cfg.labels),
        scenes=scenes(cfg.scenes),
        scenes_limit=cfg.scenes_limit,
        zooms=cfg.zooms,
        figures=cfg.figures,
        device=pick_device(cfg.device),
        flip=cfg.flip,
    )
    err = Console(stderr=True)
    with err.status("reading") as status:
        document = build(inputs, options, status.update)
    files = write(document, Path(cfg.output_dir))
    for missing in document.missing:
        print(f"left out: {missing.what}: {missing.why}", file=sys.stderr)
    print(f"report: {files['report.html']}")


def scenes(node: Any) -> dict[str, Any]:
    """Return the images to show by condition; a list or a single path has no condition of its own.

    Raises:
        ConfigError: if it is something else.
    """
    given = config.plain(node) or {}
    if isinstance(given, str | list):
        return {"scenes": given}
    if not isinstance(given, dict):
        raise ConfigError(f"scenes is {given!r}; give images by condition, such as scenes={{kitti: FOLDER}}")
    return {str(key): value for key, value in given.items()}


def main() -> None:
    """Entry point of ``saunet report``."""
    try:
        sys.argv[1:] = arguments(sys.argv[1:])
    except ConfigError as error:
        sys.exit(f"saunet report: {error}")
    run("report", report)


if __name__ == "__main__":
    main()
