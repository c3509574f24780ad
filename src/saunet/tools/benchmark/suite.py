"""Many models at many sizes, on many devices, in many precisions: one `Measurement` for each combination."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Literal

import torch
from torch import Tensor, nn

from saunet.errors import ConfigError, divisible, one_of, positive, usable_device
from saunet.tools.benchmark.measure import count_flops, count_parameters, matmul_ceiling, measure_latency, peak_memory

_DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}
_MODES = ("eager", "compiled")


@dataclass(frozen=True, slots=True)
class Networks:
    """A model's networks; only the depth network runs in prediction."""

    depth: nn.Module
    pose: nn.Module | None = None


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What to measure: every combination of the sequences; see `BenchmarkOptions`."""

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
                raise ConfigError(f"{field.name} is empty, so nothing would be measured; give some, such as {usual}")
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


@dataclass(frozen=True, slots=True)
class Measurement:
    """One line of the table. Times are in seconds, memory in bytes."""

    model: str
    size: str
    device: str
    precision: str
    mode: Literal["eager", "compiled"]
    batch_size: int
    depth_parameters: int
    pose_parameters: int
    total_parameters: int
    flops: int
    """Of the depth network, for one image."""
    median: float
    p90: float
    fastest: float
    warmup: float
    throughput: float
    """Images per second, at the median."""
    memory: int | None
    """Peak of the first call (not compiled) above what was in use before it; None where the system does not tell."""
    ceiling_share: float
    """FLOPs per second over what one large matrix product reaches on the same device in the same precision."""


def run_suite(
    models: Mapping[str, Networks], plan: Plan, progress: Callable[[str, int, int], None] | None = None
) -> list[Measurement]:
    """Measure every combination of models and plan."""
    for (name, networks), size in itertools.product(models.items(), plan.sizes):
        divisible(*_parse(size), getattr(networks.depth, "size_divisor", 1), by=f"the encoder stride of {name},")
    cases = list(itertools.product(models, plan.devices, plan.precisions, plan.sizes, plan.modes, plan.batch_sizes))
    steps, done = len(cases) * (plan.runs + plan.warmup), 0
    ceilings = {
        (device, precision): matmul_ceiling(usable_device(device), _DTYPES[precision])
        for device in plan.devices
        for precision in plan.precisions
    }
    results = []
    for name, device, precision, size, mode, batch in cases:

        def tick(text: str = f"{name} {size} {device} {precision} {mode} x{batch}") -> None:
            nonlocal done
            done += 1
            if progress is not None:
                progress(text, done, steps)

        ceiling = ceilings[device, precision]
        results.append(_measure(name, models[name], device, precision, size, mode, batch, plan, ceiling, tick))
    return results


def _measure(
    name: str,
    networks: Networks,
    device_name: str,
    precision: str,
    size: str,
    mode: str,
    batch: int,
    plan: Plan,
    ceiling: float,
    tick: Callable[[], None],
) -> Measurement:
    device, dtype = usable_device(device_name), _DTYPES[precision]
    height, width = _parse(size)
    flops = count_flops(networks.depth, torch.zeros(1, 3, height, width, device=_home(networks.depth)))
    network = copy.deepcopy(networks.depth).eval().to(device, dtype)
    image = torch.rand(batch, 3, height, width, device=device).to(dtype)
    forward: Callable[[Tensor], object] = _compiled(network) if mode == "compiled" else network
    with torch.no_grad():
        memory = peak_memory(lambda: network(image), device)
        latency = measure_latency(lambda: forward(image), device, plan.runs, plan.warmup, tick)
    depth, pose = count_parameters(networks.depth), count_parameters(networks.pose)
    return Measurement(
        model=name,
        size=size,
        device=device_name,
        precision=precision,
        mode="compiled" if mode == "compiled" else "eager",
        batch_size=batch,
        depth_parameters=depth,
        pose_parameters=pose,
        total_parameters=depth + pose,
        flops=flops,
        median=latency.median,
        p90=latency.p90,
        fastest=latency.fastest,
        warmup=latency.warmup,
        throughput=batch / latency.median,
        memory=memory,
        ceiling_share=batch * flops / latency.median / ceiling,
    )


def _compiled(network: nn.Module) -> Callable[[Tensor], object]:
    """Compile for one shape of input, as if nothing had been compiled before.

    Else, after other shapes, the compiler would write code for any shape, and after eight of them fall back to eager.
    """
    torch.compiler.reset()
    return torch.compile(network, dynamic=False)


def _home(module: nn.Module) -> torch.device:
    return next(module.parameters()).device


def _parse(size: str) -> tuple[int, int]:
    sides = size.lower().split("x")
    if len(sides) != 2 or not all(side.isdigit() and int(side) > 0 for side in sides):
        raise ConfigError(f"size is '{size}'; write height and width in pixels, such as 192x640")
    return int(sides[0]), int(sides[1])
