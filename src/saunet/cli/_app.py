"""What every command-line tool shares: compose the typed config, run, and turn errors into one sentence."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import wraps

import hydra
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from saunet.checks import SaunetError
from saunet.config import config_dir, register_configs


def run(name: str, task: Callable[[DictConfig], None]) -> None:
    """Run ``task`` as the Hydra application whose root config is ``conf/<name>.yaml``."""
    register_configs()

    @wraps(task)
    def guarded(cfg: DictConfig) -> None:
        try:
            _require(cfg)
            task(cfg)
        except SaunetError as error:
            _fail(name, str(error))
        except MissingMandatoryValue as error:
            _fail(name, str(error).splitlines()[0])
        except OmegaConfBaseException as error:
            _fail(name, " ".join(str(error).split()))
        except KeyboardInterrupt:
            _fail(name, "interrupted", code=130)

    hydra.main(version_base="1.3", config_path=str(config_dir()), config_name=name)(guarded)()


def pick_device(name: str) -> str:
    """Return the device that ``auto`` stands for: a GPU where there is one; any other name as it is."""
    import torch

    return ("cuda" if torch.cuda.is_available() else "cpu") if name == "auto" else name


def _require(cfg: DictConfig) -> None:
    missing = sorted(OmegaConf.missing_keys(cfg))
    if missing:
        raise SaunetError(
            f"{missing[0]} is not set; add {' '.join(f'{key}=...' for key in missing)} to the command line"
        )


def _fail(name: str, message: str, code: int = 1) -> None:
    print(f"saunet-{name}: {message}", file=sys.stderr)
    raise SystemExit(code)
