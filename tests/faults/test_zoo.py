"""Whatever is passed to what is public, the error is one of saunet's, or Python's own about the call."""

from __future__ import annotations

import json
from pathlib import Path

from processes import python

import saunet

NAMES = [name for name in saunet.__all__ if callable(getattr(saunet, name)) and not name.endswith("Error")]


def test_wrong_values_are_refused_in_a_sentence() -> None:
    done = python(str(Path(__file__).with_name("zoo.py")))
    assert done.returncode == 0, done.stderr
    strange: dict[str, list[str]] = json.loads(done.stdout.strip().splitlines()[-1])
    assert set(NAMES) <= set(strange)
    assert [said for each in strange.values() for said in each] == []
