"""``saunet-prepare``: work done once before training: dense depth, a teacher's depth, smaller copies of recordings."""

from __future__ import annotations

import sys
from typing import Any

from omegaconf import DictConfig

from saunet import config
from saunet.cli._app import run
from saunet.errors import suggest

JOBS = ("densify", "teacher", "cache")


def prepare(cfg: DictConfig) -> None:
    """Do one job and say what was done."""
    from saunet.registry import Spec
    from saunet.tools.prepare.tool import PrepareOptions, prepare

    options: dict[str, Any] = config.plain(cfg)
    done = prepare(PrepareOptions(**{**options, "data": Spec(options["data"]) if options["data"] else None}))
    print(done)
    for failure in done.failures:
        print(f"saunet-prepare: skipped: {failure}", file=sys.stderr)


def main() -> None:
    """Entry point of ``saunet-prepare``."""
    word = sys.argv[1] if len(sys.argv) > 1 else ""
    if word in JOBS:
        sys.argv[1] = f"job={word}"
    elif not word.startswith(("-", "job=")):
        hint = suggest(word, JOBS) or ";"
        sys.exit(f"saunet-prepare: the first word is the job, not '{word}'{hint} jobs: {', '.join(JOBS)}")
    run("prepare", prepare)


if __name__ == "__main__":
    main()
