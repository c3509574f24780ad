"""What networks cost: parameters, FLOPs, time and memory."""

from __future__ import annotations

from saunet.tools.benchmark.measure import count_flops, count_parameters, measure_latency, peak_memory
from saunet.tools.benchmark.suite import Measurement, Networks, Plan, run_suite
from saunet.tools.benchmark.tool import BenchmarkOptions, BenchmarkResult, benchmark

__all__ = [
    "BenchmarkOptions",
    "BenchmarkResult",
    "Measurement",
    "Networks",
    "Plan",
    "benchmark",
    "count_flops",
    "count_parameters",
    "measure_latency",
    "peak_memory",
    "run_suite",
]
