"""Everything that only a GPU can tell, in one run of at most ten minutes: ``benchmarks/gpu.sh OUT``.

Parts, in this order: the limits of the machine (matrix products, a copy); losses and gradients against the CPU;
training steps at 12 x 640x192 in float32, bfloat16 and compiled, with their peak memory and their distance from the
limits; CUDA graphs; the loader; a training of `street`'s network; ONNX Runtime's and TensorRT's depth. Each part is a
process of its own with a time limit: one that fails, hangs or runs out of time is recorded with its error and what it
had measured, and the others run. ``--device cpu --tiny`` tries the same code without a GPU.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import functools
import importlib.util
import json
import multiprocessing
import os
import platform
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import train_step
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import flop_registry

import saunet
from saunet.exporting import exporters
from saunet.io.atomic import write_bytes, write_json
from saunet.io.images import encode_jpeg
from saunet.runs.record import ModelRecord
from saunet.tables import Column, Row, Table
from saunet.threads import available_cores
from saunet.tools.benchmark.measure import matmul_ceiling
from saunet.training.speed import Speed
from saunet.weights.files import read_model

Keep = Callable[..., None]
"""Adds figures to a part's result, which is on disk at once."""


@dataclasses.dataclass(frozen=True)
class Setting:
    device: torch.device
    tiny: bool
    folder: Path

    @property
    def size(self) -> tuple[int, int]:
        return (64, 96) if self.tiny else train_step.SIZE

    @property
    def models(self) -> tuple[str, ...]:
        return ("sau_net_nano",) if self.tiny else ("mono_r18", "sau_net_tiny")

    @property
    def batch(self) -> int:
        return 2 if self.tiny else 12

    @property
    def cuda(self) -> bool:
        return self.device.type == "cuda"

    def wait(self) -> None:
        if self.cuda:
            torch.cuda.synchronize()

    def milliseconds(self, call: Callable[[], Any], calls: int = 20) -> list[float]:
        """Return the time of each call, after three that do not count."""
        calls, warm, times = (2, 1, list[float]()) if self.tiny else (calls, 3, [])
        for _ in range(warm + calls):
            self.wait()
            began = time.perf_counter()
            call()
            self.wait()
            times.append(1000 * (time.perf_counter() - began))
        return times[warm:]


def spread(times: Sequence[float]) -> dict[str, float]:
    """Return median, least and greatest."""
    return {"ms": float(np.median(times)), "least": min(times), "greatest": max(times)}


def build(setting: Setting, model: str) -> Any:
    """Return a training module on the device, without what no two devices draw alike: dropped paths, noise."""
    given = [
        f"model={model}",
        f"objective={'monodepth2' if model == 'mono_r18' else 'saunet'}",
        f"data.height={setting.size[0]}",
    ]
    built = train_step.build([*given, f"data.width={setting.size[1]}"], setting.batch)[0].train()
    for part in built.modules():
        for name in {"noise", "rate"} & vars(part).keys():
            setattr(part, name, 0.0)
    return built.to(setting.device)


def batch_of(setting: Setting, count: int, kind: torch.dtype = torch.float32) -> dict[str, Any]:
    """Return a training batch: smooth pictures that shift between frames, always the same."""
    height, width = setting.size
    random = torch.Generator().manual_seed(0)
    coarse = torch.rand(count, 3, height // 8, width // 8 + 4, generator=random)
    wide = nn.functional.interpolate(coarse, (height, width + 32), mode="bicubic").clamp(0, 1)
    frames = torch.stack([wide[..., shift : shift + width] for shift in (8, 4, 12)], 1).to(setting.device, kind)
    K = torch.tensor([[0.58 * width, 0, 0.5 * width], [0, 1.92 * height, 0.5 * height], [0, 0, 1]], dtype=kind)
    pictures = {"target": frames[:, 0].contiguous(), "sources": frames[:, 1:].contiguous()}
    batch = {**pictures, **{f"loss_{key}": value for key, value in pictures.items()}}
    return {**batch, "K": K.repeat(count, 1, 1).to(setting.device), "name": [str(index) for index in range(count)]}


class Roofline(TorchDispatchMode):
    """Adds up the operations' FLOPs and bytes, and the least time that each can take on this machine."""

    def __init__(self, flops_per_second: float, bytes_per_second: float) -> None:
        super().__init__()
        self.peak, self.bandwidth = flops_per_second, bytes_per_second
        self.flops = self.bytes = 0
        self.seconds = self.bound_by_memory = 0.0

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = function(*args, **(kwargs or {}))
        count = flop_registry.get(function._overloadpacket)
        flops = count(*args, **(kwargs or {}), out_val=out) if count else 0
        given = {each.untyped_storage().data_ptr() for each in tree_leaves(args) if isinstance(each, Tensor)}
        made = [each for each in tree_leaves(out) if isinstance(each, Tensor)]
        moved = 0
        if any(each.untyped_storage().data_ptr() not in given for each in made) or function._schema.is_mutable:
            moved = sum(t.numel() * t.element_size() for t in [*tree_leaves(args), *made] if isinstance(t, Tensor))
        compute, memory = flops / self.peak, moved / self.bandwidth
        self.flops, self.bytes = self.flops + flops, self.bytes + moved
        self.seconds += max(compute, memory)
        self.bound_by_memory += memory if memory > compute else 0.0
        return out


def copy_speed(setting: Setting) -> float:
    """Return the bytes per second, read and written, of a copy that does not fit into a cache."""
    source = torch.empty(2**20 if setting.tiny else 2**28, dtype=torch.float32, device=setting.device)
    target = torch.empty_like(source)
    return 2 * 4 * source.numel() / (min(setting.milliseconds(lambda: target.copy_(source))) / 1000)


def matmul_speed(setting: Setting, kind: torch.dtype) -> float:
    return matmul_ceiling(setting.device, kind, 128 if setting.tiny else 8192)


def machine(setting: Setting, keep: Keep) -> None:
    """What a matrix product and a copy reach: nothing can be faster."""
    keep(torch=torch.__version__, python=platform.python_version(), cores=available_cores())
    if setting.cuda:
        about = torch.cuda.get_device_properties(0)
        keep(gpu=about.name, gigabytes=about.total_memory / 2**30, cuda=torch.version.cuda)
    keep(copy_gb_per_second=copy_speed(setting) / 1e9)
    keep(float32_tflops=matmul_speed(setting, torch.float32) / 1e12)
    keep(bf16_tflops=matmul_speed(setting, torch.bfloat16) / 1e12)
    if setting.cuda:
        torch.backends.cuda.matmul.allow_tf32 = True
        keep(tf32_tflops=matmul_speed(setting, torch.float32) / 1e12)


def correctness(setting: Setting, keep: Keep) -> None:
    """Losses and gradients of one step: in float64 on the CPU, and on the device in float64 and float32."""
    torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = False
    reference = dataclasses.replace(setting, device=torch.device("cpu"))

    def step(where: Setting, kind: torch.dtype, state: Any) -> tuple[Tensor, Tensor]:
        model = build(where, model_name)
        model.load_state_dict(state)
        model.to(kind)
        torch.manual_seed(0)
        total = model.step(batch_of(where, 2, kind))[3].total
        total.backward()
        found = [p.grad.flatten().double().cpu() for p in model.parameters() if p.grad is not None]
        return total.detach().double().cpu(), torch.cat(found)

    for model_name in setting.models:
        made = build(reference, model_name)
        state = made.state_dict()
        loss, gradient = step(reference, torch.float64, state)
        figures = {}
        for kind, limits in {torch.float64: (1e-9, 1e-6), torch.float32: (1e-4, 5e-2)}.items():
            other, its = step(setting, kind, state)
            off = float((other - loss).abs() / loss), float((its - gradient).norm() / gradient.norm())
            figures[str(kind).removeprefix("torch.")] = {"loss": off[0], "gradient": off[1]}
            keep(**{model_name: figures})
            wrong = f"{model_name} in {kind}: loss differs by {off[0]:.2g}, its gradient by {off[1]:.2g}"
            assert off[0] <= limits[0], wrong
            assert off[1] <= limits[1], wrong


def training(setting: Setting, keep: Keep, model: str, precision: str, compiled: bool) -> None:
    """A whole training step: forward, losses, backward, Adam."""
    torch.backends.cudnn.benchmark = True
    torch.set_float32_matmul_precision("high" if precision == "tf32" else "highest")
    torch.backends.cudnn.allow_tf32 = precision == "tf32"
    made = build(setting, model)
    made.speed = Speed(compile=compiled)
    made.speed.apply(made)
    optimizer = torch.optim.Adam(made.parameters(), 1e-4, fused=setting.cuda)
    batch = batch_of(setting, setting.batch)

    def step() -> None:
        with torch.autocast(setting.device.type, torch.bfloat16, enabled=precision == "bf16"):
            total = made.step(batch)[3].total
        total.backward()
        optimizer.step()
        optimizer.zero_grad()

    began = time.perf_counter()
    step()
    setting.wait()
    keep(first_step_seconds=time.perf_counter() - began)
    if setting.cuda:
        torch.cuda.reset_peak_memory_stats()
    times = setting.milliseconds(step)
    figures = spread(times)
    keep(**figures, samples_per_second=1000 * setting.batch / figures["ms"])
    if setting.cuda:
        keep(peak_gib=torch.cuda.max_memory_allocated() / 2**30)
    if not compiled:
        kind = torch.bfloat16 if precision == "bf16" else torch.float32
        with Roofline(matmul_speed(setting, kind), copy_speed(setting)) as roofline:
            step()
        keep(gflop=roofline.flops / 1e9, gigabytes=roofline.bytes / 1e9, least_ms=1000 * roofline.seconds)
        keep(share_of_limit=1000 * roofline.seconds / figures["ms"])
        keep(bound_by_memory=roofline.bound_by_memory / max(roofline.seconds, 1e-12))


def graphs(setting: Setting, keep: Keep) -> None:
    """One image as `saunet predict` runs it, eager and as a CUDA graph, whose launches cost nothing."""
    for name in ("street", *setting.models):
        depth = read_model("street").networks()[0] if name == "street" else build(setting, name).depth
        network = exporters.FinestDisparity(depth).to(setting.device).eval()
        image = torch.rand(1, 3, *setting.size, device=setting.device)
        with torch.inference_mode():
            eager = spread(setting.milliseconds(functools.partial(network, image), 50))
            figures: dict[str, Any] = {"eager": eager}
            keep(**{name: figures})
            if not setting.cuda:
                continue
            graph = torch.cuda.CUDAGraph()
            wanted = network(image)
            with torch.cuda.graph(graph):
                got = network(image)
            graph.replay()
            setting.wait()
            assert torch.allclose(got, wanted, rtol=1e-3), f"{name} differs as a CUDA graph"
            figures["graph"] = spread(setting.milliseconds(graph.replay, 50))
            keep(**{name: {**figures, "ratio": figures["graph"]["ms"] / eager["ms"]}})


def loader(setting: Setting, keep: Keep) -> None:
    """Images a second from JPEGs of 1242x375 with all cores: what a training has to stay below."""
    clips, count = setting.folder / "clips", 12 if setting.tiny else 96
    smooth = np.random.default_rng(0).integers(0, 256, (40, 160, 3), dtype=np.uint8)
    import cv2

    wide = cv2.resize(smooth, (1242 + 4 * count, 375), interpolation=cv2.INTER_CUBIC)
    for index in range(count):
        picture = np.ascontiguousarray(wide[:, 4 * index : 4 * index + 1242])
        write_bytes(clips / "drive" / f"{index:06d}.jpg", encode_jpeg(picture))
    write_bytes(clips / "camera.yaml", b"image_size: [1242, 375]\nK: [720, 720, 620.5, 187]\nfps: 10\n")
    height, width = setting.size
    workers = 0 if setting.tiny else available_cores()
    about = {"height": height, "width": width, "batch_size": setting.batch, "workers": workers}
    data: Any = saunet.build("data", "video", root=str(clips), val_share=0.0, **about)
    data.setup("fit")
    images, began, epochs = 0, 0.0, 1 if setting.tiny else 8
    batches = data.train_dataloader()
    for epoch in range(epochs + 1):  # the first starts the processes
        if epoch == 1:
            began = time.perf_counter()
        for batch in batches:
            images += batch["frames"].shape[0] * batch["frames"].shape[1] * (epoch > 0)
    speed = images / (time.perf_counter() - began)
    keep(workers=workers, images_per_second=speed, samples_per_second=speed / 3)


def street(setting: Setting, keep: Keep) -> None:
    """Train the network of `street` to see a road in every picture, a few steps at full size; its loss has to fall."""
    network = read_model("street").networks()[0].to(setting.device).train()
    for layer in network.modules():
        if isinstance(layer, nn.modules.batchnorm._BatchNorm):
            layer.eval()
    batch = batch_of(setting, setting.batch)
    height = setting.size[0]
    below = torch.arange(height, device=setting.device) - height / 3  # a road, from the horizon down
    truth = (1.65 * 1.92 * height / below.clamp(min=4))[:, None].expand(setting.batch, 1, *setting.size)
    optimizer = torch.optim.AdamW(network.parameters(), 1e-4)
    losses = []

    def step() -> None:
        with torch.autocast(setting.device.type, torch.bfloat16, enabled=setting.cuda):
            depth = network(batch["target"]).depth[0]
        apart = depth.float().log() - truth.log()
        loss = apart.square().mean() - 0.85 * apart.mean().square()  # up to scale, as the recipe's
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        losses.append(loss.detach())

    times = setting.milliseconds(step, 40)
    values = [float(loss) for loss in losses]
    keep(**spread(times), first_loss=values[0], last_loss=values[-1], steps=len(values))
    assert np.isfinite(values).all(), "a loss is not finite"
    assert values[-1] < values[0], "the loss does not fall"


def runtimes(setting: Setting, keep: Keep) -> None:
    """Depth of the exported network in onnxruntime's providers, and in torch on the device, against the CPU's."""
    if any(importlib.util.find_spec(name) is None for name in ("onnx", "onnxscript", "onnxruntime")):
        keep(skipped="onnx, onnxscript or onnxruntime is not installed")
        return
    import onnxruntime

    network, path = read_model("street").networks()[0].eval(), setting.folder / "street.onnx"
    exporters.export_onnx(network, ModelRecord({}, {}, None, 0.1, 100.0, *setting.size), path, batch="one")
    image = np.random.default_rng(0).random((1, 3, *setting.size), dtype=np.float32)
    wanted = exporters.run_eager(network)(image)[:, 0]
    found = {"onnx CPU": exporters.run_onnx(path)(image)[:, 0]}
    moved = exporters.FinestDisparity(network).to(setting.device)
    with torch.inference_mode():
        found["torch"] = moved(torch.from_numpy(image).to(setting.device)).cpu().numpy()[:, 0]
    available = onnxruntime.get_available_providers()
    for name in ("CUDA", "Tensorrt"):
        if setting.cuda and f"{name}ExecutionProvider" in available:
            session = onnxruntime.InferenceSession(str(path), providers=[f"{name}ExecutionProvider"])
            used = session.get_providers()[0]
            assert used.startswith(name), f"{name} is installed but does not run: {used} does"
            found[f"onnx {name}"] = session.run(None, {"image": image})[0][:, 0]
    changes = {name: float(np.abs(wanted / each - 1).mean()) for name, each in found.items()}
    keep(providers=available, abs_rel_change=changes)
    for name, change in changes.items():
        assert change <= 2e-3, f"{name} changes depth by {change:.2g} (Abs Rel)"


def plan(tiny: bool) -> dict[str, tuple[Callable[[Setting, Keep], None], int]]:
    """Return the parts in order of importance: what to do, and the most seconds for it."""
    parts = {"machine": (machine, 45), "correctness": (correctness, 90)}
    models = ("mono_r18", "sau_net_tiny")
    ways = [(model, precision, False) for model in models for precision in ("float32", "tf32", "bf16")]
    ways += [*((model, "bf16", True) for model in models), ("mono_r18", "float32", True)]
    for model, precision, compiled in [("sau_net_nano", "float32", False)] if tiny else ways:
        part = functools.partial(training, model=model, precision=precision, compiled=compiled)
        parts[f"training {model} {precision}{' compiled' * compiled}"] = (part, 110 if compiled else 40)
    others = {"graphs": (graphs, 45), "loader": (loader, 45), "street": (street, 60), "runtimes": (runtimes, 60)}
    eager = {name: part for name, part in parts.items() if "compiled" not in name}
    return {**eager, **others, **parts}


def attempt(part: Callable[[Setting, Keep], None], setting: Setting, path: Path) -> None:
    """Run a part in this process, which is its own group, and leave its figures and its error in a file."""
    os.setsid()
    result: dict[str, Any] = {"seconds": 0.0, "error": "it was killed or ended by itself"}
    began = time.perf_counter()

    def keep(**figures: Any) -> None:
        result.update(figures)
        write_json(path, {**result, "seconds": time.perf_counter() - began})

    keep()
    try:
        part(setting, keep)
        keep(error=None)
    except Exception as reason:
        traceback.print_exc()
        keep(error=f"{type(reason).__name__}: {(str(reason).strip() or 'no message').splitlines()[0][:300]}")


def run(setting: Setting, budget: float, only: Sequence[str]) -> dict[str, Any]:
    """Run all parts within so many seconds; return their results by name."""
    deadline, results = time.monotonic() + budget, dict[str, Any]()
    context = multiprocessing.get_context("fork")  # nothing here has used the GPU, so that each part can
    for name, (part, most) in plan(setting.tiny).items():
        if only and not any(name.startswith(each) for each in only):
            continue
        left = deadline - time.monotonic()
        if left < 5:
            results[name] = {"error": "not run: the time was spent"}
            continue
        path = setting.folder / "part.json"
        path.unlink(missing_ok=True)
        process = context.Process(target=attempt, args=(part, setting, path))
        process.start()
        limit = min(most * (10 if setting.tiny else 1), left)
        process.join(limit)
        late = process.is_alive()
        if process.pid is not None:  # with what it started: compilers, loader processes
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
        process.join()
        found = json.loads(path.read_text()) if path.is_file() else {"error": "it ended before it began"}
        results[name] = {**found, "error": f"stopped after {limit:.0f} s"} if late else found
        print(f"{name}: {results[name]['error'] or 'done'}", flush=True)
    return results


def page(results: dict[str, Any], setting: Setting) -> str:
    """Return the results as Markdown."""

    def flat(values: dict[str, Any], before: str = "") -> dict[str, str]:
        found: dict[str, str] = {}
        for key, value in values.items():
            if isinstance(value, dict):
                found |= flat(value, f"{before}{key} ")
            elif key != "error" and value is not None:
                found[before + key] = f"{value:.4g}" if isinstance(value, float) else str(value)
        return found

    failed = {name: found["error"] for name, found in results.items() if found["error"]}
    rows = tuple(Row((name, key, value)) for name, found in results.items() for key, value in flat(found).items())
    table = Table("gpu", "Figures", (Column("part"), Column("figure"), Column("value")), rows)
    lines = [f"# One run on `{setting.device}`{', tiny: the figures mean nothing' * setting.tiny}", ""]
    lines += [f"- **{name}** failed: {error}" for name, error in failed.items()] or ["Every part passed."]
    return "\n".join([*lines, "", table.markdown(), ""])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--tiny", action="store_true", help="small sizes and few calls, to try the program itself")
    parser.add_argument("--budget", type=float, default=570, help="seconds for all parts")
    parser.add_argument("--only", nargs="*", default=[], help="parts whose names begin so")
    parser.add_argument("--output", type=Path, default=Path("outputs/gpu"))
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        setting = Setting(torch.device(given.device), given.tiny, Path(folder))
        results = run(setting, given.budget, given.only)
        given.output.mkdir(parents=True, exist_ok=True)
        write_json(given.output / "gpu.json", {"device": given.device, "tiny": given.tiny, "parts": results})
        write_bytes(given.output / "gpu.md", page(results, setting).encode())
    print(f"results: {given.output / 'gpu.md'}")
    sys.exit(1 if not results or any(found["error"] for found in results.values()) else 0)


if __name__ == "__main__":
    main()
