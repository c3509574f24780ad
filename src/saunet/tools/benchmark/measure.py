"""Parameters, FLOPs, latency and peak memory of networks: one at a time, and many of them side by side."""

from __future__ import annotations

import contextlib
import copy
import ctypes
import gc
import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from saunet.errors import ConfigError, divisible, one_of, positive, usable_device

_DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}
_MODES = ("eager", "compiled")


@dataclass(frozen=True, slots=True)
class Latency:
    """Duration of a call, in seconds."""

    median: float
    p90: float
    fastest: float
    warmup: float
    """Time of all warm-up calls: compilation, first allocations, choice of algorithms."""


def count_parameters(module: nn.Module | None) -> int:
    """Return the number of parameters, counting shared ones once; 0 for None."""
    return 0 if module is None else sum(parameter.numel() for parameter in module.parameters())


def count_flops(module: nn.Module, *inputs: Tensor) -> int:
    """Return the floating-point operations of convolutions and matrix products; a multiply-add counts as two."""
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

    def timed() -> float:
        start = time.perf_counter()
        call()
        _wait(device)
        elapsed = time.perf_counter() - start
        if done is not None:
            done()
        return elapsed

    first = sum((timed() for _ in range(warmup)), 0.0)
    times = [timed() for _ in range(runs)]
    median, p90 = np.quantile(times, (0.5, 0.9)).tolist()
    return Latency(median, p90, min(times), first)


def peak_memory(call: Callable[[], Any], device: torch.device) -> int | None:
    """Return by how many bytes a call raises the peak memory; None if the system does not report it.

    On CUDA this is the memory of tensors. On a CPU it is the resident memory of the process (Linux only), after the
    allocator has released memory left over from earlier calls.
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
    with contextlib.suppress(OSError, AttributeError):  # C libraries other than glibc keep their memory
        ctypes.CDLL("libc.so.6").malloc_trim(0)
    try:
        reset.write_text("5")  # resets the kernel's high-water mark
        resident = _kilobytes(status, "VmRSS")
        call()
        return 1024 * (_kilobytes(status, "VmHWM") - resident)
    except OSError:
        return None


def _kilobytes(status: Path, field: str) -> int:
    return next(int(line.split()[1]) for line in status.read_text().splitlines() if line.startswith(f"{field}:"))


def matmul_ceiling(device: torch.device, dtype: torch.dtype, side: int = 0) -> float:
    """Return the FLOPs per second of one large square matrix product: the most that a network could reach."""
    side = side or (1024 if device.type == "cpu" else 4096)
    factor = torch.randn(side, side, device=device).to(dtype)
    latency = measure_latency(lambda: factor @ factor, device, runs=10)
    return 2 * side**3 / latency.fastest


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    elif device.type == "mps":
        torch.mps.synchronize()


@dataclass(frozen=True, slots=True)
class Networks:
    """A model's networks; only the depth network runs in prediction."""

    depth: nn.Module
    pose: nn.Module | None = None


@dataclass(frozen=True, kw_only=True)
class Plan:
    """The combinations to measure: all of those of the sequences; see `BenchmarkOptions`."""

    sizes: Sequence[str] = ("192x640",)
    devices: Sequence[str] = ("cpu",)
    precisions: Sequence[str] = ("fp32",)
    modes: Sequence[str] = ("eager",)
    batch_sizes: Sequence[int] = (1,)
    runs: int = 20
    warmup: int = 3

    def __post_init__(self) -> None:
        for field in fields(self):
            if isinstance(field.default, tuple) and field.default and not getattr(self, field.name):
                usual = field.default[0]
                raise ConfigError(
                    f"{field.name} is empty, so nothing would be measured; give at least one, such as {usual}"
                )
        for size in self.sizes:
            _parse(size)
        for device in self.devices:
            usable_device(device)
        for precision in self.precisions:
            one_of("precisions", precision, _DTYPES)
        for mode in self.modes:
            one_of("modes", mode, _MODES)
        for batch in self.batch_sizes:
            positive("batch_sizes", batch)
        positive("runs", self.runs)
        positive("warmup", self.warmup, allow_zero=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurement(Latency):
    """One line of the table; memory is in bytes."""

    model: str
    size: str
    device: str
    precision: str
    mode: str
    batch_size: int
    depth_parameters: int
    pose_parameters: int
    total_parameters: int
    flops: int
    """FLOPs of the depth network, for one image."""
    throughput: float
    """Images per second, at the median."""
    memory: int | None
    """Peak memory of the first call (not compiled) above the use before it; None if the system does not report it."""
    ceiling_share: float
    """FLOPs per second relative to one large matrix product on the same device in the same precision."""


def run_suite(
    models: Mapping[str, Networks],
    plan: Plan,
    progress: Callable[[str, int, int], None] = lambda text, done, total: None,
) -> list[Measurement]:
    """Measure every combination of models and plan."""
    for (name, networks), size in itertools.product(models.items(), plan.sizes):
        divisible(*_parse(size), getattr(networks.depth, "size_divisor", 1), by=f"the encoder stride of {name},")
    cases = list(itertools.product(models, plan.devices, plan.precisions, plan.sizes, plan.modes, plan.batch_sizes))
    steps, ticks = len(cases) * (plan.runs + plan.warmup), itertools.count(1)
    ceilings = {
        (device, precision): matmul_ceiling(usable_device(device), _DTYPES[precision])
        for device, precision in itertools.product(plan.devices, plan.precisions)
    }
    results = []
    for name, device_name, precision, size, mode, batch in cases:

        def tick(text: str = f"{name} {size} {device_name} {precision} {mode} x{batch}") -> None:
            progress(text, next(ticks), steps)

        networks, device, dtype, sides = models[name], usable_device(device_name), _DTYPES[precision], _parse(size)
        home = next(networks.depth.parameters()).device
        flops = count_flops(networks.depth, torch.zeros(1, 3, *sides, device=home))
        network = copy.deepcopy(networks.depth).eval().to(device, dtype)
        image = torch.rand(batch, 3, *sides, device=device).to(dtype)
        memory, latency = _run(network, image, mode == "compiled", plan, tick)
        depth, pose = count_parameters(networks.depth), count_parameters(networks.pose)
        measurement = Measurement(
            model=name,
            size=size,
            device=device_name,
            precision=precision,
            mode=mode,
            batch_size=batch,
            depth_parameters=depth,
            pose_parameters=pose,
            total_parameters=depth + pose,
            flops=flops,
            throughput=batch / latency.median,
            memory=memory,
            ceiling_share=batch * flops / latency.median / ceilings[device_name, precision],
            **asdict(latency),
        )
        results.append(measurement)
    return results


@torch.no_grad()
def _run(
    network: nn.Module, image: Tensor, compiled: bool, plan: Plan, tick: Callable[[], None]
) -> tuple[int | None, Latency]:
    memory = peak_memory(lambda: network(image), image.device)
    forward: Callable[[Tensor], object] = network
    if compiled:
        # As if nothing had been compiled before: otherwise, after other shapes, the compiler would generate code for
        # any shape, and after eight of them fall back to eager.
        torch.compiler.reset()
        forward = torch.compile(network, dynamic=False)
    return memory, measure_latency(lambda: forward(image), image.device, plan.runs, plan.warmup, tick)


def _parse(size: str) -> tuple[int, int]:
    sides = size.lower().split("x")
    if len(sides) != 2 or not all(side.isdigit() and int(side) > 0 for side in sides):
        raise ConfigError(f"size is '{size}'; write height and width in pixels, such as 192x640")
    return int(sides[0]), int(sides[1])
