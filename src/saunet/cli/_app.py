"""What every command-line tool shares: compose the typed config, run, and turn errors into one sentence."""

from __future__ import annotations

import logging
import os
import re
import sys
import warnings
from collections.abc import Callable, Collection
from functools import wraps
from pathlib import Path
from typing import Any, NoReturn

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, InstantiationException, MissingConfigException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from saunet import schema
from saunet.cli._folders import Folder, noted
from saunet.cli._runs import planned_jobs
from saunet.cli._sweep import check_folder, swept_folder
from saunet.config import config_dir, register_configs
from saunet.errors import SaunetError, suggest, usable_device
from saunet.registry import REGISTRIES
from saunet.roots import ROOTS
from saunet.runs.folder import FILE, Stopped, record_failed_start
from saunet.runs.sweep import summary

PATHS = ("checkpoint", "folder", "init_from", "input", "output", "output_dir", "predictions", "resume", "root")
"""Keys at the root of a tool's config that name files or folders."""


def run(name: str, task: Callable[[DictConfig], Any], kinds: Collection[str] = tuple(REGISTRIES)) -> None:
    """Run ``task`` as the Hydra application whose root config is ``conf/<name>.yaml``.

    What a user can mend ends in one sentence and exit code 1; only a defect of the program shows a traceback.
    ``HYDRA_FULL_ERROR=1`` shows it always. In a sweep, the other jobs go on, and failures are named at the end.

    Args:
        name: The tool, without ``saunet ``.
        task: What it does with its config.
        kinds: Those of the components that the config may name: a tool without losses and data sets starts without
            importing what they are made of, Lightning among it.
    """
    before = os.environ.get("HYDRA_FULL_ERROR")
    # A process that DDP started inherits the variable from us, not from the user.
    debug = before == "1" and "LOCAL_RANK" not in os.environ
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra then lets exceptions through instead of printing them its own way

    folders: list[Folder] = []  # of a single run, as they were before it
    failed: list[Exception] = []
    noted()  # what an earlier run of this process left

    @wraps(task)
    def required(cfg: DictConfig) -> Any:
        if "data" in kinds:
            _one_voice()
        hydra_cfg = HydraConfig.get()
        if hydra_cfg.mode == RunMode.MULTIRUN:
            return _job(name, task, cfg)
        run_folder = noted()
        if run_folder is not None:
            folders.append(run_folder)
        if "output_dir" in cfg and Path(cfg.output_dir).resolve() != Path(hydra_cfg.runtime.output_dir).resolve():
            folders.append(Folder.as_it_is(Path(cfg.output_dir).resolve()))
        try:
            _check_given(cfg)
            return task(cfg)
        except Exception as error:
            failed.append(error)  # raised again outside of Hydra, which would print a line of its own before ours

    try:
        register_configs(kinds)
        hydra.main(version_base="1.3", config_path=str(config_dir()), config_name=name)(required)()
        if failed:
            raise failed[0]
        if not _end_sweep():
            raise SystemExit(1)
    except KeyboardInterrupt:
        _end_sweep(other="interrupted")
        _fail(name, "interrupted", code=130)
    except Stopped as stop:
        _end_sweep()
        if stop.code:
            _fail(name, stop.message, code=int(stop.code))
    except Exception as error:
        reason = sentence(error)
        if debug or reason is None:
            raise
        if not _end_sweep(other=reason):
            raise SystemExit(1) from error
        for folder in folders:
            folder.remove_traces(name)
        _fail(name, reason)
    finally:
        if before is None:
            del os.environ["HYDRA_FULL_ERROR"]


def _check_given(cfg: DictConfig) -> None:
    """Check that what must be given is, and that no path is empty, as one from an unset variable of the shell.

    Raises:
        SaunetError: naming the keys.
    """
    missing = sorted(OmegaConf.missing_keys(cfg))
    if missing:
        needed = " ".join(f"{key}=..." for key in missing)
        raise SaunetError(f"{missing[0]} is not set; add {needed} to the command line")
    for key in PATHS:
        if cfg.get(key) == "":
            raise SaunetError(f"{key}= is empty, perhaps from a shell variable that is not set; name a path")


def _job(name: str, task: Callable[[DictConfig], Any], cfg: DictConfig) -> Any:
    """Run one job of a sweep; what goes wrong is said at once and ends this job only."""
    owned = False
    try:
        _check_given(cfg)
        if "output_dir" in cfg:
            check_folder(cfg.output_dir, HydraConfig.get().runtime.output_dir)
        owned = True
        return task(cfg)
    except Exception as error:
        job = HydraConfig.get().job
        reason = sentence(error) or f"{type(error).__name__}: {error}"
        print(f"saunet {name}: job {job.num} ({job.override_dirname}) failed: {reason}", file=sys.stderr)
        if name == "train" and owned:
            record_failed_start(cfg.output_dir, cfg.name, error, sentence)
        raise


def _end_sweep(other: str | None = None) -> bool:
    """After a sweep, say how its jobs ended, unless none began and ``other`` is said of it.

    Returns:
        Whether all finished, or there is nothing to tell.
    """
    folder = swept_folder()
    if folder is None or (other and not any(folder.glob(f"**/{FILE}"))):
        return True
    text, finished = summary(folder, planned_jobs(folder))
    print(text, file=sys.stdout if finished else sys.stderr)
    return finished


def pick_device(name: str) -> str:
    """Return the device that ``auto`` stands for: a GPU where there is one; any other name as it is, once tried.

    Raises:
        ConfigError: if there is no such device.
    """
    return str(usable_device(name))


class _NoAdvertisement(logging.Filter):
    def filter(self, record: logging.LogRecord) -> bool:
        text = record.getMessage()
        return not text.startswith(("💡", "TPU available", "Loading `train_dataloader` to estimate"))


_NO_ADVERTISEMENT = _NoAdvertisement()


def _one_voice() -> None:
    """Let Lightning speak through Hydra's loggers, to the terminal and the run's log, of what concerns the user alone.

    In each job, as a sweep may run it in a process of its own.
    """
    import lightning.pytorch.utilities.rank_zero as rank_zero  # now: its first import adds handlers of its own

    for name in ("lightning", "lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).handlers.clear()
        logging.getLogger(name).propagate = True
    logging.getLogger(rank_zero.__name__).addFilter(_NO_ADVERTISEMENT)
    warnings.filterwarnings("ignore", message=r".*LeafSpec.*")
    warnings.filterwarnings("ignore", message=r".*does not have many workers.*")


def _fail(name: str, message: str, code: int = 1) -> NoReturn:
    print(f"saunet {name}: {message}", file=sys.stderr)
    raise SystemExit(code)


def sentence(error: Exception) -> str | None:
    """Say in one sentence what a user can mend; None for a defect of the program."""
    if isinstance(error, SaunetError):
        return str(error)
    if type(error).__name__ == "OutOfMemoryError":  # torch's, which is not imported for its name
        return "the GPU's memory is too small for this; lower the batch size (in training data.batch_size) or the size"
    if str(error).startswith("Config group override must be a string or a list"):
        return "a group of the config cannot be null; choose logger=none, or set single members to null"
    raised_elsewhere = re.search(r"^saunet\.checks\.\w+: (.*)", str(error), re.MULTILINE)
    if raised_elsewhere:  # in a process that was spawned: only its traceback's text arrives here
        return raised_elsewhere[1]
    cause = error.__cause__
    if isinstance(error, InstantiationException) and not isinstance(cause, OmegaConfBaseException):
        missing = re.search(r"\b(wandb|mlflow)\b", str(cause)) if isinstance(cause, ModuleNotFoundError) else None
        if missing:
            return f"logger={missing[1]} needs a package that is not installed; run `pip install 'saunet[track]'`"
        if isinstance(cause, SaunetError | ValueError | TypeError):
            return " ".join(str(cause).split())
    for each in (error, error.__cause__):  # Hydra wraps what a constructor raises
        if type(each).__name__ == "MisconfigurationException":  # Lightning's word for a user's error
            return " ".join(str(each).split())
    if type(error).__name__ == "ProcessExitedException":  # a process that was spawned is gone
        return f"{' '.join(str(error).split())}, so the run ends; resume with resume= and the run's last.ckpt"
    text = f"{error}\n{error.__cause__ or ''}"
    if isinstance(error, MissingConfigException):  # which is an OSError too
        return _unknown_choice(text)
    if isinstance(error, OSError):
        return f"cannot use {error.filename or 'a file'}: {error.strerror or error}; check the path and its rights"
    if not isinstance(error, HydraException | OmegaConfBaseException):
        return None
    full_key = re.search(r"full_key: (\S+)", text)
    unknown = re.search(r"Key '(\w+)' (?:is )?not in '(\w+)'", text)
    if unknown and full_key:
        key, owner = unknown.groups()
        allowed = _keys(owner)
        return f"unknown key '{full_key[1]}'{suggest(key, allowed) or ';'} allowed: {', '.join(allowed)}"
    if full_key and "is not a ListConfig" in text:
        return _not_a_list(full_key[1])
    wrong = re.search(r"Value '.*' of type .*", text)
    if wrong and full_key:
        return f"{full_key[1]}: {wrong[0][0].lower()}{wrong[0][1:]}"
    return " ".join(text.split())


def _not_a_list(key: str) -> str:
    """Say how to write a list of what was given; the command line knows it, Hydra's error does not."""
    given = [word.partition("=")[2] for word in sys.argv[1:] if word.lstrip("+").startswith(f"{key}=")]
    return f"{key} is {given[-1]!r}; it must be a list: {key}=[{given[-1]}]" if given else f"{key} must be a list"


def _unknown_choice(text: str) -> str:
    wanted = re.search(r"Could not find '([^']+)'", text)
    listed = re.search(r"Available options in '([^']+)':\n(.*?)\nConfig search path", text, re.DOTALL)
    if not wanted or not listed:
        return " ".join(text.split())
    options = [option for option in listed[2].split() if option not in ("base", "lightning")]
    name = wanted[1].rpartition("/")[2]
    return f"unknown {listed[1]} '{name}'{suggest(name, options) or ';'} available: {', '.join(options)}"


def _keys(owner: str) -> list[str]:
    """Return the keys of a config node by the name of its class."""
    for root in ROOTS:
        if root.__name__ == owner:
            return list(root.__dataclass_fields__)
    for registry in REGISTRIES.values():
        for entry in registry:
            if entry.target.__name__ == owner:
                return [name for name in schema.parameters(entry.target) if name not in registry.late]
    return []
