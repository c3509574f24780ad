"""Where the time of a training step goes: Monodepth2's structure (ResNet-18 depth and pose, 640x192, four scales).

Each part of the step is timed by itself (processor time on a CPU, events on a GPU), then PyTorch's profiler lists the
most expensive operations::

    python benchmarks/train_step.py                                   # two samples on the CPU
    python benchmarks/train_step.py --device cuda --batch 12 --precision bf16 --compile
    python benchmarks/train_step.py --overrides model=sau_net objective=saunet
"""

from __future__ import annotations

import argparse
import functools
import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from saunet.cli.compose import Composed, options, register_configs
from saunet.cli.table import config_dir, read
from saunet.data.loading.windows import DRAWS
from saunet.registry import instantiate
from saunet.training.speed import Speed
from saunet.training.tool import TrainOptions, assemble
from saunet.types import Views

SIZE = (192, 640)


def build(overrides: list[str], batch: int) -> tuple[Any, Any]:
    """Return the training module and the data module of a composed config."""
    register_configs()
    with initialize_config_dir(str(config_dir()), version_base="1.3"):
        chosen = ["model=mono_r18", "objective=monodepth2", "data=synthetic", f"data.height={SIZE[0]}"]
        chosen += [f"data.width={SIZE[1]}", f"data.batch_size={batch}", "output_dir=unused", *overrides]
        cfg = compose("train", chosen)
    plain: Any = OmegaConf.to_container(cfg, resolve=True)
    data = instantiate(plain["data"])
    torch.manual_seed(0)
    return assemble(options(TrainOptions, Composed(plain, {}, (), ""), read()), data), data


def random_frames(batch: int, offsets: int, device: str) -> dict[str, Any]:
    """Return a batch as the loader yields it, of noise."""
    height, width = round(SIZE[0] * 1.05), round(SIZE[1] * 1.05)
    K = torch.tensor([[0.58 * width, 0, 0.5 * width], [0, 1.92 * height, 0.5 * height], [0, 0, 1]])
    return {
        "frames": torch.randint(0, 256, (batch, 1 + offsets, 3, height, width), dtype=torch.uint8).to(device),
        "K": K.repeat(batch, 1, 1).to(device),
        "name": [str(index) for index in range(batch)],
        "draws": torch.rand(batch, DRAWS).to(device),
    }


class Timer:
    """Milliseconds a part, summed over steps."""

    def __init__(self, device: str) -> None:
        self.device = device
        self.parts: dict[str, float] = {}

    @contextmanager
    def __call__(self, part: str) -> Iterator[None]:
        began = self._now()
        yield
        self.parts[part] = self.parts.get(part, 0.0) + 1000 * (self._now() - began)

    def _now(self) -> float:
        if self.device == "cuda":
            torch.cuda.synchronize()
            return time.perf_counter()
        return time.process_time()


def step(model: Any, data: Any, frames: Any, optimizer: Any, timer: Any, precision: str) -> None:
    """One training step, part by part, as `SelfSupervisedDepth.step` does it."""
    device = frames["frames"].device.type
    with timer("1 device transforms"):
        batch = data.on_after_batch_transfer(frames, 0)
    with torch.autocast(device, torch.bfloat16, enabled=precision == "bf16"):
        with timer("2 depth network"):
            pyramid = model.depth(batch["target"])
        with timer("3 pose network"):
            poses = model.motion(batch)
        with timer("4 view synthesis and losses"):  # on a CPU with their gradients
            synthesize = functools.partial(model.synthesize, batch, pyramid, poses)
            views = synthesize() if model.speed.compile else Views(len(pyramid.disparity), synthesize)
            terms = model.objective(batch, pyramid, poses, views)
    with timer("5 backward, view synthesis and losses"):
        gradients = torch.autograd.grad(terms.total, [*pyramid.sigmoid, poses])
    with timer("6 backward, networks"):
        torch.autograd.backward([*pyramid.sigmoid, poses], list(gradients))
    with timer("7 optimizer"):
        optimizer.step()
        optimizer.zero_grad()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--batch", type=int, default=2)
    parser.add_argument("--steps", type=int, default=3)
    parser.add_argument("--precision", default="fp32", choices=["fp32", "bf16"])
    parser.add_argument("--compile", action="store_true")
    parser.add_argument("--checkpoint-activations", action="store_true")
    parser.add_argument("--operations", type=int, default=12, help="rows of the profiler's table, 0 for none")
    parser.add_argument("--overrides", nargs="*", default=[], help="of the training's config, such as model=sau_net")
    parser.add_argument("--output", type=Path, help="also write the figures to this JSON file")
    options = parser.parse_args()

    model, data = build(options.overrides, options.batch)
    model.to(options.device).train()
    data.augment.to(options.device)
    model.speed = Speed(compile=options.compile, checkpoint_activations=options.checkpoint_activations)
    model.speed.apply(model, torch.device(options.device))
    frames = random_frames(options.batch, len(data.offsets), options.device)
    fused = options.device == "cuda"
    optimizer = torch.optim.Adam(model.parameters(), 1e-4, fused=fused)
    for _ in range(2):  # warm-up
        step(model, data, frames, optimizer, Timer(options.device), options.precision)
    timer = Timer(options.device)
    if options.device == "cuda":
        torch.cuda.reset_peak_memory_stats()
    for _ in range(options.steps):
        step(model, data, frames, optimizer, timer, options.precision)
    parts = {name: value / options.steps for name, value in timer.parts.items()}
    total = sum(parts.values())
    print(f"{SIZE[1]}x{SIZE[0]}, {options.batch} samples, {options.device}, {options.precision}, {torch.__version__}")
    for name, value in parts.items():
        print(f"{name[2:]:40s} {value:9.1f} ms {value / total:6.1%}")
    print(f"{'step':40s} {total:9.1f} ms {1000 * options.batch / total:6.2f} samples/s")
    if options.device == "cuda":
        print(f"peak memory {torch.cuda.max_memory_allocated() / 2**30:.2f} GiB")
    if options.operations:
        with torch.profiler.profile() as profile:
            step(model, data, frames, optimizer, Timer(options.device), options.precision)
        sort = "self_device_time_total" if options.device == "cuda" else "self_cpu_time_total"
        print(profile.key_averages().table(sort_by=sort, row_limit=options.operations, max_name_column_width=40))
    if options.output:
        options.output.write_text(json.dumps({"milliseconds": parts, "total": total}, indent=2))


if __name__ == "__main__":
    main()
