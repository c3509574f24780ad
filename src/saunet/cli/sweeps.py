"""Sweeps: each job has its folder, one failed job costs no other, and at the end every failure is named."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra._internal.hydra import Hydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from saunet.cli.errors import sentence
from saunet.errors import ConfigError
from saunet.io.atomic import write_json
from saunet.runs import run_record

FILE = "sweep.json"
"""In a sweep's folder: the overrides of every job that it was to have."""


def sweep(hydra: Hydra, name: str, overrides: list[str], task: Callable[[DictConfig], object]) -> int:
    """Run a job for each combination of the values given.

    Args:
        hydra: Hydra.
        name: Of the root config.
        overrides: What the command line says.
        task: What a job does with its configuration.

    Returns:
        The exit code.
    """
    cfg = hydra.compose_config(name, overrides, RunMode.MULTIRUN)
    HydraConfig.instance().set_config(cfg)
    folder = Path(str(OmegaConf.select(cfg, "hydra.sweep.dir"))).absolute()
    planned = _planned(cfg)
    HydraConfig.instance().cfg = None
    failed: Exception | None = None
    reason = ""
    try:
        hydra.multirun(name, task, overrides)
    except KeyboardInterrupt:
        reason = "interrupted"
    except Exception as error:
        failed, reason = error, sentence(error) or ""
    started = [path.parent.parent for path in folder.glob("**/.hydra/overrides.yaml")]
    if not started and failed:
        raise failed
    if planned and started:
        write_json(folder / FILE, {"jobs": planned})
    text, finished = summary(folder, started, planned, not reason)
    print(text, file=sys.stdout if finished else sys.stderr)
    return 0 if finished else 130 if reason == "interrupted" else 1


def _planned(cfg: DictConfig) -> list[list[str]]:
    """Return the overrides of every job; none if another sweeper than Hydra's own chooses them."""
    if "BasicSweeper" not in cfg.hydra.sweeper._target_:
        return []
    params = [f"{key}={value}" for key, value in (cfg.hydra.sweeper.params or {}).items()]
    # Unresolved: some refer to a job, and there is none now.
    given = OmegaConf.to_container(cfg.hydra.overrides.task, resolve=False)
    assert isinstance(given, list)
    parsed = OverridesParser.create().parse_overrides([*params, *map(str, given)])
    return [list(job) for batch in BasicSweeper.split_arguments(parsed, None) for job in batch]


def check_folder(output_dir: object, job: str) -> None:
    """Check that a job of a sweep writes into its own folder: one named for all would hold the last job alone.

    Raises:
        ConfigError: if it would write anywhere else.
    """
    given, own = Path(str(output_dir)).resolve(), Path(job).resolve()
    if own != given and own not in given.parents:
        raise ConfigError(
            f"output_dir is '{output_dir}' and the jobs of a sweep must not share a folder; "
            f"leave it out and set hydra.sweep.dir={output_dir}, below which each job gets its own"
        )


def summary(folder: Path, started: Sequence[Path], planned: Sequence[Sequence[str]], well: bool) -> tuple[str, bool]:
    """Say how the jobs of a sweep ended, one line for each that did not finish; jobs that vanished are marked failed.

    Args:
        folder: The sweep's folder.
        started: Folders of the jobs that began.
        planned: The overrides of every job, where known.
        well: Whether the sweep ended without an error; all that is known of tools that keep no record of a run.

    Returns:
        The text, and whether there were jobs and all of them finished.
    """
    recorded = any((job / run_record.FILE).is_file() for job in started)
    lines, finished = [], 0
    for job in sorted(started, key=_in_order):
        run_record.mark_lost(job)
        content = run_record.read(job) or {"status": "finished" if well and not recorded else "failed"}
        if content.get("status") == "finished":
            finished += 1
        elif recorded:
            reason = content.get("error") or "its record cannot be read"
            said = ", ".join(_overrides(job))
            lines.append(f"  {job.relative_to(folder)} ({said}) {content.get('status', 'failed')}: {reason}")
    before = [_overrides(job) for job in started]
    waiting = [list(job) for job in planned if list(job) not in before]
    lines += [f"  ({', '.join(job)}) not started" for job in waiting]
    count = len(started) + len(waiting)
    head = f"sweep: {finished} of {count} jobs finished; results: {folder}"
    return "\n".join([head, *lines]), 0 < finished == count


def _in_order(path: Path) -> tuple[int, str]:
    return (int(path.name) if path.name.isdecimal() else -1, str(path))


def _overrides(job: Path) -> list[str]:
    return [str(each) for each in OmegaConf.load(job / ".hydra" / "overrides.yaml")]
