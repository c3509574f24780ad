"""One page from finished runs: the paper's tables and figures with our numbers beside the printed ones."""

from __future__ import annotations

from saunet.reporting.inputs import collect
from saunet.reporting.tool import ReportOptions, ReportResult, report

__all__ = ["ReportOptions", "ReportResult", "collect", "report"]
