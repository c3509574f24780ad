"""Single measurements: parameters, FLOPs, latency, peak memory and the speed of plain matrix products."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from saunet.errors import positive


@dataclass(frozen=True, slots=True)
class Latency:
    """How long a call takes, in seconds."""

    median: float
    p90: float
    fastest: float
    warmup: float
    """All warm-up calls together: compilation, first allocations, choice of algorithms."""
    runs: int


def count_parameters(module: nn.Module | None) -> int:
    """Return the number of parameters, shared ones once; 0 for None."""
    return 0 if module is None else sum(parameter.numel() for parameter in module.parameters())


def count_flops(module: nn.Module, *inputs: Tensor) -> int:
    """Return the floating-point operations of one evaluation, a multiply-add counted as two.

    Counted are convolutions and matrix products, those inside attention too.
    """
    training = module.training
    counter = FlopCounterMode(display=False)
    # fused attention kernels are not counted by every version of torch; their parts are
    with torch.no_grad(), sdpa_kernel(SDPBackend.MATH), counter:
        module.eval()(*inputs)
    module.train(training)
    return int(counter.get_total_flops())


def measure_latency(
    call: Callable[[], Any],
    device: torch.device,
    runs: int = 20,
    warmup: int = 3,
    done: Callable[[], None] | None = None,
) -> Latency:
    """Time a call, waiting for the device each time."""
    positive("runs", runs)
    positive("warmup", warmup, allow_zero=True)

    def timed() -> float:
        start = time.perf_counter()
        call()
        _wait(device)
        elapsed = time.perf_counter() - start
        if done is not None:
            done()
        return elapsed

    first = sum((timed() for _ in range(warmup)), 0.0)
    times = sorted(timed() for _ in range(runs))
    return Latency(median=_quantile(times, 0.5), p90=_quantile(times, 0.9), fastest=times[0], warmup=first, runs=runs)


def _quantile(ordered: list[float], share: float) -> float:
    """Return the linearly interpolated quantile of sorted values."""
    place = share * (len(ordered) - 1)
    low, high = math.floor(place), math.ceil(place)
    return ordered[low] + (ordered[high] - ordered[low]) * (place - low)


def peak_memory(call: Callable[[], Any], device: torch.device) -> int | None:
    """Return by how many bytes a call raises the memory in use at its peak; None where the system does not tell.

    On CUDA this is memory of tensors. On a CPU it is resident memory of the process (Linux only), after the allocator
    has given back what earlier calls left it with.
    """
    gc.collect()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
        before = torch.cuda.memory_allocated(device)
        torch.cuda.reset_peak_memory_stats(device)
        call()
        torch.cuda.synchronize(device)
        return torch.cuda.max_memory_allocated(device) - before
    status, reset = Path("/proc/self/status"), Path("/proc/self/clear_refs")
    with contextlib.suppress(OSError, AttributeError):  # other C libraries than glibc keep what they have
        ctypes.CDLL("libc.so.6").malloc_trim(0)
    try:
        reset.write_text("5")  # lets the kernel forget the highest mark so far
        resident = _kilobytes(status, "VmRSS")
        call()
        return 1024 * (_kilobytes(status, "VmHWM") - resident)
    except OSError:
        return None


def _kilobytes(status: Path, field: str) -> int:
    return next(int(line.split()[1]) for line in status.read_text().splitlines() if line.startswith(f"{field}:"))


def matmul_ceiling(device: torch.device, dtype: torch.dtype, side: int = 0) -> float:
    """Return the FLOPs per second that one large square matrix product reaches: what a network could at best."""
    side = side or (1024 if device.type == "cpu" else 4096)
    factor = torch.randn(side, side, device=device).to(dtype)
    latency = measure_latency(lambda: factor @ factor, device, runs=10)
    return 2 * side**3 / latency.fastest


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    elif device.type == "mps":
        torch.mps.synchronize()
