"""What one test does to logging reaches no other test."""

from __future__ import annotations

import io
import logging
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest


@pytest.fixture
def logging_as_it_was(pytestconfig: pytest.Config) -> Callable[[], AbstractContextManager[None]]:
    """The manager of the conftest.py beside this file."""
    conftest = pytestconfig.pluginmanager.get_plugin(str(Path(__file__).with_name("conftest.py")))
    found: Callable[[], AbstractContextManager[None]] = conftest.logging_as_it_was  # type: ignore[union-attr]
    return found


@pytest.mark.parametrize("known", [True, False], ids=["made before", "made inside"])
def test_handlers_bound_to_a_stream_that_closes_go(
    logging_as_it_was: Callable[[], AbstractContextManager[None]], known: bool
) -> None:
    """As Lightning's first import, or Hydra, inside of a test that captures what is written."""
    name = f"saunet_test.{known}"
    own = logging.NullHandler()
    if known:
        logging.getLogger(name).addHandler(own)
        logging.getLogger(name).setLevel(logging.WARNING)
    with logging_as_it_was(), io.StringIO() as stream:
        for logger in (logging.root, logging.getLogger(name)):
            logger.handlers[:] = [logging.StreamHandler(stream)]
            logger.setLevel(logging.DEBUG)
        logging.getLogger(name).propagate = False
        logging.getLogger(name).disabled = True
    logger = logging.getLogger(name)
    assert logger.handlers == ([own] if known else [])
    assert logger.propagate
    assert not logger.disabled
    assert logger.level == (logging.WARNING if known else logging.DEBUG)
    assert not any(getattr(handler, "stream", None) is stream for handler in logging.root.handlers)
    logger.handlers.clear()
