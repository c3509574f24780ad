"""One page from finished runs: the paper's tables and figures with our numbers beside the printed ones."""

from __future__ import annotations

from saunet.reporting.build import Options, build
from saunet.reporting.inputs import Inputs, Sweep, collect
from saunet.reporting.output import write
from saunet.runs.folder import Run, Score, read_run

__all__ = ["Inputs", "Options", "Run", "Score", "Sweep", "build", "collect", "read_run", "write"]
