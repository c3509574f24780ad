"""``saunet report``: one page of tables, curves and pictures from finished runs; with ``compare``, how runs differ."""

from __future__ import annotations

import sys

from omegaconf import DictConfig

from saunet.cli._app import run
from saunet.cli._options import options_of
from saunet.cli._runs import arguments
from saunet.errors import ConfigError


def report(cfg: DictConfig) -> None:
    """Make the page, or say how the runs differ."""
    from saunet import reporting

    reporting.report(options_of(reporting.ReportOptions, cfg)).show()


def main() -> None:
    """Entry point of ``saunet report``."""
    try:
        sys.argv[1:] = arguments(sys.argv[1:])
    except ConfigError as error:
        sys.exit(f"saunet report: {error}")
    run("report", report)


if __name__ == "__main__":
    main()
