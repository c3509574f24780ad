"""Fixtures shared by all tests: where the reference data lie, and small inputs."""

from __future__ import annotations

import contextlib
import dataclasses
import gc
import logging
import os
from collections.abc import Callable, Generator, Iterator, Mapping
from pathlib import Path
from typing import Any

import enforcement
import numpy as np
import pytest
import torch
from browsing import browser  # noqa: F401 (a fixture)
from hydra.core.config_store import ConfigStore
from hypothesis import HealthCheck, settings

DATA_ROOT = Path(os.environ.get("SAUNET_TEST_DATA", Path(__file__).parents[1] / ".." / "shared")).resolve()


enforcement.install()

# Hydra copies all that it has in store for every composition, though it copies each node that it gives as well.
ConfigStore.__deepcopy__ = lambda store, memo: store  # type: ignore[attr-defined]

# Every run tries the same examples, however slow the machine: `pytest --hypothesis-profile=default` looks for new ones.
settings.register_profile(
    "reproducible", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow], print_blob=True
)
settings.load_profile("reproducible")

# What the surroundings may say to Hydra and Lightning is not said to the tests, nor to the processes that they start.
for _name in [name for name in os.environ if name.startswith(("HYDRA_", "SLURM_"))]:
    del os.environ[_name]
for _name in ("RANK", "LOCAL_RANK", "NODE_RANK", "GROUP_RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT"):
    os.environ.pop(_name, None)


def pytest_collection_finish() -> None:
    """Keep what imports have made out of the garbage collector: it goes through all there is each time it is called."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def _fixed_seed() -> None:
    torch.manual_seed(0)


@pytest.fixture(autouse=True)
def _plain_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Print tables as wide and as plain as into a file, whatever the terminal of the test run."""
    monkeypatch.setenv("COLUMNS", "80")
    for name in ("LINES", "FORCE_COLOR", "NO_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Switch the shape and type checks of the tests off, to see what a user sees, or where calls are too many."""
    monkeypatch.setattr("jaxtyping.config.jaxtyping_disable", True)


@pytest.fixture(autouse=True)
def _logging_as_it_was() -> Iterator[None]:
    """Undo what a tool that ran inside the test did to logging."""
    with logging_as_it_was():
        yield


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(fixturedef: pytest.FixtureDef[Any]) -> Generator[None, Any, Any]:
    """Make what several tests share the same whichever of them asks first: own seed, and logging left alone."""
    if fixturedef.scope == "function":
        return (yield)
    torch.manual_seed(0)
    with logging_as_it_was():
        return (yield)


@contextlib.contextmanager
def logging_as_it_was() -> Iterator[None]:
    """Restore logging afterwards: tools leave handlers that write into a run's folder or into a stream that closes."""
    before = {logger: (logger.handlers[:], logger.level, logger.propagate, logger.disabled) for logger in _loggers()}
    try:
        yield
    finally:
        for logger in _loggers():
            # One that an import has just made keeps its level, and speaks through its parents.
            was = before.get(logger, ([], logger.level, True, False))
            if was == (logger.handlers, logger.level, logger.propagate, logger.disabled):
                continue  # as after most tests
            handlers, level, propagate, disabled = was
            for handler in set(logger.handlers) - set(handlers):
                logger.removeHandler(handler)
                handler.close()
            logger.handlers[:], logger.propagate, logger.disabled = handlers, propagate, disabled
            if logger.level != level:  # setting one goes through all loggers there are
                logger.setLevel(level)


def _loggers() -> list[logging.Logger]:
    known = logging.root.manager.loggerDict.values()
    return [logging.root, *(each for each in known if isinstance(each, logging.Logger))]


@pytest.fixture
def hydra() -> Iterator[None]:
    """Let a test compose configurations, as the tools do."""
    from hydra import initialize_config_dir

    from saunet.cli.compose import register_configs
    from saunet.cli.table import config_dir

    register_configs()
    with initialize_config_dir(str(config_dir()), version_base="1.3"):
        yield


@pytest.fixture(scope="session")
def node() -> Callable[[str, str], dict[str, Any]]:
    """Return a component's settings as a checkpoint records them: ``node("encoder", "resnet18")``."""

    def plain(kind: str, name: str) -> dict[str, Any]:
        from saunet.cli.compose import structured
        from saunet.registry import REGISTRIES

        settings = dataclasses.asdict(structured(REGISTRIES[kind].node(name))())
        return {key: value for key, value in settings.items() if value != "???"}

    return plain


@pytest.fixture(scope="session")
def test_data() -> Path:
    """Root of the reference data; skips the test where they are absent."""
    if not (DATA_ROOT / "reference").is_dir():
        pytest.skip(f"no reference data at {DATA_ROOT}; set SAUNET_TEST_DATA to the folder that holds 'reference'")
    return DATA_ROOT


@pytest.fixture(scope="session")
def reference(test_data: Path) -> Callable[[str], Mapping[str, Any]]:
    """Load the expected numbers of an established implementation: ``reference("ssim")["target"]``."""

    def load(name: str) -> Mapping[str, Any]:
        with np.load(test_data / "reference" / f"{name}.npz") as arrays:
            return {key: arrays[key] for key in arrays.files}

    return load


@pytest.fixture(scope="session")
def kitti_mini(test_data: Path) -> Path:
    """Folder with a few real KITTI recordings; skips the test where they are absent."""
    if not (test_data / "kitti_mini" / "raw").is_dir():
        pytest.skip(f"no KITTI frames at {test_data / 'kitti_mini'}")
    return test_data / "kitti_mini"
