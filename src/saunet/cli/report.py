"""``saunet-report``: one page of tables, curves and pictures from finished runs; with ``compare``, how runs differ."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from saunet import config
from saunet.checks import ConfigError
from saunet.cli._app import pick_device, run

HYDRA = (
    "--config-dir",
    "-cd",
    "--config-path",
    "-cp",
    "--config-name",
    "-cn",
    "--package",
    "-p",
    "--cfg",
    "-c",
    "--info",
)
"""Hydra's own options that are followed by a word."""


def report(cfg: DictConfig) -> None:
    """Read the runs and write the page, or, with ``compare=true``, print how they differ."""
    from rich.console import Console

    from saunet.report import Options, build, collect, write

    inputs = collect(list(cfg.runs or []), cfg.checkpoint, planned_jobs)
    if cfg.compare:
        from saunet.report.compare import print_comparison

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


def planned_jobs(sweep: Path) -> list[list[str]] | None:
    """Return the overrides of every job that a multirun folder was to hold; None if another sweeper chose them."""
    from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    try:
        hydra = OmegaConf.load(sweep / "multirun.yaml").hydra
        if "BasicSweeper" not in hydra.sweeper._target_:
            return None
        params = [f"{key}={value}" for key, value in (hydra.sweeper.params or {}).items()]
        parsed = OverridesParser.create().parse_overrides([*params, *hydra.overrides.task])
        return [job for batch in BasicSweeper.split_arguments(parsed, None) for job in batch]
    except (OSError, AttributeError, HydraException):
        return None


def arguments(given: Sequence[str]) -> list[str]:
    """Turn plain folders and files into ``runs=[...]``, and the word ``compare`` in front into ``compare=true``.

    Raises:
        ConfigError: if runs are named both ways.
    """
    words = list(given)
    extra = []
    if words[:1] == ["compare"]:  # it prints, and leaves no folder behind
        words = words[1:]
        extra = [
            "compare=true",
            "hydra.run.dir=.",
            "hydra.output_subdir=null",
            "hydra.job_logging.root.handlers=[console]",
        ]
    plain = [
        word
        for before, word in zip(["", *words], words, strict=False)
        if word[:1] not in ("-", "~", "+") and before not in HYDRA and ("=" not in word or Path(word).exists())
    ]
    if plain and any(word.startswith("runs=") for word in words):
        raise ConfigError(f"runs are named twice, as runs=... and as {plain[0]}; name them in one way")
    quoted = ",".join("'" + word.replace("\\", "\\\\").replace("'", "\\'") + "'" for word in plain)
    return [*(word for word in words if word not in plain), *extra, *([f"runs=[{quoted}]"] if plain else [])]


def main() -> None:
    """Entry point of ``saunet-report``."""
    try:
        sys.argv[1:] = arguments(sys.argv[1:])
    except ConfigError as error:
        sys.exit(f"saunet-report: {error}")
    run("report", report)


if __name__ == "__main__":
    main()
