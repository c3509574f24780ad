"""What tools that take finished runs share: plain folders on the command line, and which jobs a sweep was to have."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import cast

from omegaconf import OmegaConf

from saunet.errors import ConfigError

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


def arguments(given: Sequence[str]) -> list[str]:
    """Turn plain folders and files into ``runs=[...]``, and the word ``compare`` in front into ``compare=true``.

    Raises:
        ConfigError: if runs are named both ways.
    """
    words = list(given)
    extra = []
    if words[:1] == ["compare"]:  # it prints, and leaves no folder behind
        words = words[1:]
        extra = ["compare=true", "hydra.run.dir=.", "hydra.output_subdir=null"]
    plain = [
        word
        for before, word in zip(["", *words], words, strict=False)
        if word[:1] not in ("-", "~", "+") and before not in HYDRA and ("=" not in word or Path(word).exists())
    ]
    if plain and any(word.startswith("runs=") for word in words):
        raise ConfigError(f"runs are named twice, as runs=... and as {plain[0]}; name them in one way")
    quoted = ",".join("'" + word.replace("\\", "\\\\").replace("'", "\\'") + "'" for word in plain)
    return [*(word for word in words if word not in plain), *extra, *([f"runs=[{quoted}]"] if plain else [])]


def planned_jobs(sweep: Path) -> list[list[str]] | None:
    """Return the overrides of every job that a multirun folder was to hold; None if another sweeper chose them."""
    from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    try:
        hydra = OmegaConf.load(sweep / "multirun.yaml").hydra
        if "BasicSweeper" not in hydra.sweeper._target_:
            return None
        # Unresolved: some refer to a job, and there is none now.
        given = cast(
            list[str], OmegaConf.to_container(hydra.overrides.task, resolve=False)
        )  # some refer to a job that is not there now
        params = [f"{key}={value}" for key, value in (hydra.sweeper.params or {}).items()]
        parsed = OverridesParser.create().parse_overrides([*params, *given])
        return [job for batch in BasicSweeper.split_arguments(parsed, None) for job in batch]
    except (OSError, AttributeError, HydraException):
        return None
