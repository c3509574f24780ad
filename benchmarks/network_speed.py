"""Speed of the networks on a CPU as a ratio to resnet18+unet: ``OMP_NUM_THREADS=2 python benchmarks/network_speed.py``.

All networks are timed in turn, round after round, so that whatever else the machine does falls on all of them alike.
The ratio is that of the medians; beside it stands that of the fastest rounds, which other processes disturb least.
On a busy machine, waiting for threads drowns everything; ``--threads 1 --clock cpu`` then still gives a usable ratio.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import torch

from saunet.models.depth import DepthNet
from saunet.registry import decoders, encoders

BASELINE = ("resnet18+unet", "fp32", "eager")
# model, precision, mode, and the ratio to the baseline that is to be reached
CASES: list[tuple[str, str, str, float | None]] = [
    (*BASELINE, None),
    ("stratified_tiny+aunet", "fp32", "eager", 5.5),
    ("stratified_tiny+aunet", "bf16", "eager", 2.5),
    ("stratified_nano+aunet", "fp32", "eager", 1.2),
]
COMPILED: list[tuple[str, str, str, float | None]] = [
    ("resnet18+unet", "fp32", "compiled", None),
    ("stratified_tiny+aunet", "fp32", "compiled", None),
    ("stratified_nano+aunet", "fp32", "compiled", None),
]


def network(model: str, precision: str, mode: str, height: int, width: int) -> Callable[[], object]:
    encoder, decoder = model.split("+")
    dtype = {"fp32": torch.float32, "bf16": torch.bfloat16}[precision]
    depth = DepthNet(encoders.build(encoder), decoders.partial(decoder)).eval().to(dtype)
    image = torch.rand(1, 3, height, width).to(dtype)
    forward = torch.compile(depth) if mode == "compiled" else depth
    return lambda: forward(image)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition(":")[0])
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--size", type=int, nargs=2, default=(192, 640), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--clock", choices=("wall", "cpu"), default="wall", help="what to read")
    parser.add_argument("--compiled", action="store_true", help="also time compiled networks")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    clock = {"wall": time.perf_counter, "cpu": time.process_time}[arguments.clock]
    cases = CASES + (COMPILED if arguments.compiled else [])
    calls = {case[:3]: network(*case[:3], *arguments.size) for case in cases}
    times: dict[tuple[str, str, str], list[float]] = {case: [] for case in calls}
    with torch.inference_mode():
        for _ in range(arguments.rounds + 2):  # the first two warm up
            for case, call in calls.items():
                start = clock()
                call()
                times[case].append(clock() - start)
    times = {case: values[2:] for case, values in times.items()}
    base = times[BASELINE]
    size = f"{arguments.size[0]}x{arguments.size[1]}"
    print(f"batch 1, {size}, threads {arguments.threads}, {arguments.rounds} rounds, {arguments.clock} clock")
    print(f"{'model':24} {'':5} {'':9} {'median':>9} {'fastest':>9} {'ratio':>7} {'fastest':>8} {'wanted':>7}")
    for model, precision, mode, wanted in cases:
        own = times[model, precision, mode]
        median, fastest = statistics.median(own), min(own)
        ratios = f"{median / statistics.median(base):7.2f} {fastest / min(base):8.2f}"
        print(
            f"{model:24} {precision:5} {mode:9} {median * 1e3:6.1f} ms {fastest * 1e3:6.1f} ms {ratios} "
            f"{'' if wanted is None else f'{wanted:7.2f}'}"
        )


if __name__ == "__main__":
    main()
