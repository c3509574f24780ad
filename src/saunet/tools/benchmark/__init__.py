"""What networks cost: parameters, FLOPs, time and memory."""

from __future__ import annotations

from saunet.tools.benchmark.measure import Measurement, Networks, Plan, count_parameters, run_suite
from saunet.tools.benchmark.tool import BenchmarkOptions, benchmark

__all__ = ["BenchmarkOptions", "Measurement", "Networks", "Plan", "benchmark", "count_parameters", "run_suite"]
