"""Sweeps: each job has its folder, one failed job costs no other, and at the end every failure is named."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra._internal.hydra import Hydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from saunet.errors import ConfigError
from saunet.runs.folder import FILE
from saunet.runs.sweep import PLAN, summary, write_plan


class Failed:
    """What a job returns that failed and said so."""


def sweep(hydra: Hydra, name: str, overrides: list[str], task: Callable[[bool, DictConfig], object]) -> int:
    """Run a job for each combination of the values given.

    Args:
        hydra: Hydra.
        name: Of the root config.
        overrides: What the command line says.
        task: What a job does, given whether it raises what goes wrong, as a search wants it, and its configuration.

    Returns:
        The exit code.
    """
    cfg = hydra.compose_config(name, overrides, RunMode.MULTIRUN)
    HydraConfig.instance().set_config(cfg)
    folder = Path(str(OmegaConf.select(cfg, "hydra.sweep.dir"))).absolute()
    planned = _planned(cfg)
    HydraConfig.instance().cfg = None
    if planned:
        write_plan(folder, planned)
    failed: Exception | None = None
    stopped: SystemExit | None = None
    code = 0
    try:
        returned = hydra.multirun(name, functools.partial(task, not planned), overrides)
        jobs = [job for batch in returned for job in batch] if planned else []
        code = 1 if any(isinstance(job.return_value, Failed) for job in jobs) else 0
    except KeyboardInterrupt:
        code = 130
    except SystemExit as stop:  # a training that was asked to stop says how to resume; the sweep ends with it
        stopped = stop
    except Exception as error:
        failed, code = error, 1
    if not any(folder.glob("**/.hydra")) and failed:
        for file in (PLAN, "multirun.yaml"):
            (folder / file).unlink(missing_ok=True)
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
        raise failed
    if any(folder.glob(f"**/{FILE}")):
        text, finished = summary(folder, planned)
    else:  # of a tool that keeps no record of a run
        finished = code == 0
        text = f"sweep: {f'{len(planned)} jobs finished' if finished else 'not all jobs finished'}; results: {folder}"
    print(text, file=sys.stdout if finished else sys.stderr)
    if stopped is not None:
        raise stopped
    return 0 if finished else code or 1


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


def check_job(config: Mapping[str, object], job: str) -> None:
    """Check what a job of a sweep must not do.

    Args:
        config: Its configuration.
        job: The folder that the sweep gave it.

    Raises:
        ConfigError: if it would write anywhere else, where the next job writes too, or start the sweep once more.
    """
    folder = config.get("output_dir")
    if folder:  # an empty one is refused below
        given, own = Path(str(folder)).resolve(), Path(job).resolve()
        if own != given and own not in given.parents:
            raise ConfigError(
                f"output_dir is '{folder}' and the jobs of a sweep must not share a folder; "
                f"leave it out and set hydra.sweep.dir={folder}, below which each job gets its own"
            )
    trainer = config.get("trainer")
    if isinstance(trainer, Mapping) and _replays(trainer):
        raise ConfigError(
            "--multirun with several processes per job would replay the whole sweep on every process; "
            "use one process per job, or start each training with a command of its own, such as in a shell loop"
        )


def _replays(trainer: Mapping[str, object]) -> bool:
    """Return whether a trainer will start further processes by running this command again."""
    strategy = str(trainer.get("strategy", "auto")).lower()  # a name, or a node with a _target_
    several = str(trainer.get("devices", 1)) not in ("1", "[0]", "auto") or trainer.get("num_nodes", 1) not in (1, None)
    return several or any(kind in strategy for kind in ("ddp", "fsdp", "deepspeed"))
