"""Files that users bring, damaged in thousands of ways; see `fuzz`."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from fuzz import MEMORY, PARSERS, Fuzz

SECONDS = float(os.environ.get("SAUNET_FUZZ_SECONDS", "120"))
COSTLY = {"exported model"}
"""Networks are built, so only the slow session damages it."""
LENIENT = {"run's folder"}
"""What cannot be read there counts as absent, so little of it is refused."""


@pytest.mark.parametrize("name", [name for name in PARSERS if name not in COSTLY])
def test_damaged_files_are_refused_in_a_sentence(name: str, tmp_path: Path) -> None:
    fuzz = Fuzz(name, tmp_path)
    fuzz.run(40)
    assert fuzz.files >= 40
    assert fuzz.refused > 0 or name in LENIENT


@pytest.mark.slow
@pytest.mark.parametrize("name", PARSERS)
def test_damaged_files_for_minutes(name: str, tmp_path: Path) -> None:
    fuzz, end, number = Fuzz(name, tmp_path), time.process_time() + SECONDS / len(PARSERS), 0
    while time.process_time() < end:
        number += 1
        fuzz.run(200, number)
    assert fuzz.grown < MEMORY
