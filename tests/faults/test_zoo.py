"""Whatever is passed to what is public, the error is one of saunet's, or Python's own about the call."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

import saunet

NAMES = [name for name in saunet.__all__ if callable(getattr(saunet, name)) and not name.endswith("Error")]


@pytest.fixture(scope="module")
def strange() -> dict[str, list[str]]:
    done = subprocess.run([sys.executable, str(Path(__file__).with_name("zoo.py"))], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout.strip().splitlines()[-1]))


@pytest.mark.parametrize("name", NAMES)
def test_wrong_values_are_refused_in_a_sentence(name: str, strange: dict[str, list[str]]) -> None:
    assert strange[name] == []
