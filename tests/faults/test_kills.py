"""Every tool that writes is killed at random moments; see `kills`."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

KILLS = os.environ.get("SAUNET_KILLS", "8")
TOOLS = ("train", "predict", "evaluate", "export", "prepare", "doctor")


@pytest.mark.slow
@pytest.mark.parametrize("tool", TOOLS)
def test_a_kill_loses_nothing_and_leaves_nothing(tool: str, tmp_path: Path) -> None:
    command = [sys.executable, str(Path(__file__).with_name("kills.py")), "--kills", KILLS, "--only", tool]
    done = subprocess.run([*command, "--keep", str(tmp_path)], capture_output=True, text=True)
    tallies = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    assert tallies, done.stderr
    for tally in tallies:
        assert tally["wrong"] == []
        assert tally["kills"] > 0
