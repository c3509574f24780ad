"""Exported ONNX against the eager network, in one run: latency on the CPU, difference, and time to the first depth.

``OMP_NUM_THREADS=2 python benchmarks/export_speed.py`` (``--size 192 640`` by default; ``--models`` to choose).
Latencies are medians of calls taken in turn, so that whatever else the machine does falls on all alike. The last table
times whole processes, import, load, predict one image: from a checkpoint with torch, and from the ONNX file without.
"""

from __future__ import annotations

import argparse
import dataclasses
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from saunet.exporting.exporters import export_onnx, run_eager, run_onnx
from saunet.exporting.parity import milliseconds
from saunet.io.images import write_image
from saunet.registry import REGISTRIES
from saunet.runs.checkpoint import atomic_save, build_networks
from saunet.runs.record import ModelRecord

MODELS = ("resnet18+unet", "stratified_nano+aunet")
START = "import sys, saunet; saunet.load(sys.argv[1]).predict(sys.argv[2]); print('torch' in sys.modules)"


def record(model: str, height: int, width: int) -> ModelRecord:
    def node(kind: str, name: str) -> dict[str, object]:
        plain = dataclasses.asdict(REGISTRIES[kind].node(name)())
        return {key: value for key, value in plain.items() if value != "???"}

    encoder, decoder = model.split("+")
    return ModelRecord(node("encoder", encoder), node("decoder", decoder), None, 0.1, 100.0, height, width)


def seconds_to_first_depth(model: Path, image: Path, repeats: int) -> tuple[float, bool]:
    times, torch_imported = [], False
    for _ in range(repeats):
        start = time.perf_counter()
        arguments = [sys.executable, "-c", START, str(model), str(image)]
        result = subprocess.run(arguments, capture_output=True, text=True, check=True)
        times.append(time.perf_counter() - start)
        torch_imported = result.stdout.strip() == "True"
    return statistics.median(times), torch_imported


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition(":")[0])
    parser.add_argument("--models", nargs="+", default=MODELS, metavar="ENCODER+DECODER")
    parser.add_argument("--size", type=int, nargs=2, default=(192, 640), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--starts", type=int, default=3, help="processes to time")
    arguments = parser.parse_args()
    print(f"{torch.get_num_threads()} threads, {arguments.size[0]}x{arguments.size[1]}, one image")
    print(f"{'model':28}{'eager ms':>10}{'onnx ms':>10}{'ratio':>8}{'differs by':>12}{'export s':>10}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for model in arguments.models:
            own = record(model, *arguments.size)
            network = build_networks(own)[0].eval()
            start = time.perf_counter()
            export_onnx(network, own, folder / f"{model}.onnx")
            export_time = time.perf_counter() - start
            image = np.random.default_rng(0).random((1, 3, *arguments.size), dtype=np.float32)
            runs = [run_eager(network), run_onnx(folder / f"{model}.onnx")]
            eager, onnx = milliseconds(runs, image, arguments.rounds)
            difference = np.abs(runs[0](image) - runs[1](image)).max()
            print(f"{model:28}{eager:10.1f}{onnx:10.1f}{onnx / eager:8.2f}{difference:12.1e}{export_time:10.1f}")
            state = {f"depth.{key}": value for key, value in network.state_dict().items()}
            atomic_save({"state_dict": state, "saunet": own.to_plain()}, folder / f"{model}.ckpt")
        write_image(folder / "x.png", np.zeros((375, 1242, 3), np.uint8))
        print(f"\n{'start, load, predict one image':44}{'seconds':>8}  imports torch")
        for file in (f"{arguments.models[0]}.ckpt", f"{arguments.models[0]}.onnx"):
            seconds, imported = seconds_to_first_depth(folder / file, folder / "x.png", arguments.starts)
            print(f"{file:44}{seconds:8.2f}  {imported}")


if __name__ == "__main__":
    main()
