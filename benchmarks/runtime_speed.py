"""A depth network in each installed runtime against torch: ``OMP_NUM_THREADS=1 python benchmarks/runtime_speed.py``.

The runs of a model are timed in turn in one process, so that whatever else the machine does falls on all alike; printed
are the ratio of the medians to eager torch in float32, the least and greatest ratio of a round, and how depth changes.
``fused`` is eager torch with convolutions and their batch normalization made one.
"""

from __future__ import annotations

import argparse
import copy
import importlib.util
import itertools
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from saunet.exporting import exporters
from saunet.exporting.openvino import export_openvino, has_bf16, run_openvino
from saunet.exporting.parity import Run
from saunet.models.depth import DepthNet
from saunet.prediction.runtimes import depth_change
from saunet.registry import decoders, encoders
from saunet.runs.record import ModelRecord
from saunet.weights.files import read_model


def network(model: str, size: tuple[int, int] | None) -> tuple[DepthNet, int, int]:
    """Return a network, and height and width of its input, from ``encoder+decoder`` or a trained model's name."""
    if "+" in model:
        encoder, decoder = model.split("+")
        return (DepthNet(encoders.build(encoder), decoders.partial(decoder)).eval(), *(size or (192, 640)))
    read = read_model(model)
    return (read.networks()[0].eval(), *(size or (read.record.height, read.record.width)))


def fused(depth: DepthNet) -> DepthNet:
    """Return a copy with each normalization that directly follows a convolution in its parent folded into it."""
    made = copy.deepcopy(depth)
    for parent in made.modules():
        children = list(parent.named_children())
        for (first, conv), (second, norm) in itertools.pairwise(children):
            follows = isinstance(conv, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d)
            if follows and conv.out_channels == norm.num_features:
                setattr(parent, first, fuse_conv_bn_eval(conv, norm))
                setattr(parent, second, nn.Identity())
    return made


def runs(depth: DepthNet, height: int, width: int, folder: Path) -> dict[str, Run]:
    """Return all ways to run a network."""
    record = ModelRecord({}, {}, None, 0.1, 100.0, height, width)
    found = {"torch": exporters.run_eager(depth), "torch fused": exporters.run_eager(fused(depth))}
    if importlib.util.find_spec("onnxscript") and importlib.util.find_spec("onnxruntime"):
        exporters.export_onnx(depth, record, folder / "x.onnx", batch="one")
        found["onnx f32"] = exporters.run_onnx(folder / "x.onnx")
    if importlib.util.find_spec("openvino"):
        export_openvino(depth, record, folder / "x.xml", folder / "x.bin", batch="one")
        for precision in ("f32", "bf16") if has_bf16() else ("f32",):
            found[f"openvino {precision}"] = run_openvino(folder / "x.xml", folder / "x.bin", precision)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition(":")[0])
    parser.add_argument("--models", nargs="+", default=["street", "resnet18+unet"], metavar="MODEL")
    parser.add_argument("--size", type=int, nargs=2, metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--clock", choices=("wall", "cpu"), default="cpu")
    given = parser.parse_args()
    clock = {"wall": time.perf_counter, "cpu": time.process_time}[given.clock]
    print(f"one image, {torch.get_num_threads()} threads, {given.rounds} rounds, {given.clock} clock")
    for model in given.models:
        depth, height, width = network(model, given.size)
        image = np.random.default_rng(0).random((1, 3, height, width), dtype=np.float32)
        with tempfile.TemporaryDirectory() as folder:
            ways = runs(depth, height, width, Path(folder))
            times = np.zeros((given.rounds + 2, len(ways)))  # the first two warm up
            for row in times:
                for index, run in enumerate(ways.values()):
                    start = clock()
                    run(image)
                    row[index] = clock() - start
        times = times[2:]
        base = times[:, 0]
        for index, (name, run) in enumerate(ways.items()):
            own, each = np.median(times[:, index]), times[:, index] / base
            change = depth_change(ways["torch"], run, image)
            ratio = f"{own / np.median(base):.3f} ({each.min():.3f} to {each.max():.3f})"
            print(
                f"{model:24} {width}x{height} {name:14} {1000 * own:7.1f} ms, ratio {ratio}, depth changes by {change}"
            )


if __name__ == "__main__":
    main()
