"""Speed of the window encoder on a CPU beside timm's Swin of the same shape: Swin-T, patches of 2, windows of 8.

In an environment with the extra ``timm``. Both run in turn, round after round, on one thread; each figure is
processor time, and the ratio is the median of the rounds'::

    OMP_NUM_THREADS=1 python benchmarks/window_speed.py --rounds 9
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from typing import Any

import timm
import torch
from torch import nn

from saunet.registry import encoders


def build(kind: str, height: int, width: int) -> nn.Module:
    if kind == "saunet":
        return encoders.build("stratified_tiny", window=(8, 8, 8, 8))
    shape: dict[str, Any] = {"patch_size": 2, "window_size": 8, "img_size": (height, width)}
    return timm.create_model("swin_tiny_patch4_window7_224", features_only=True, **shape)


def forward(network: nn.Module, image: torch.Tensor) -> None:
    with torch.inference_mode():
        network(image)


def both_ways(network: nn.Module, image: torch.Tensor) -> None:
    network.zero_grad()
    sum(feature.mean() for feature in network(image)).backward()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--size", type=int, nargs=2, default=(192, 640), metavar=("HEIGHT", "WIDTH"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    cases: list[tuple[str, torch.dtype, Callable[[nn.Module, torch.Tensor], None]]] = [
        ("forward, float32", torch.float32, forward),
        ("forward, bfloat16", torch.bfloat16, forward),
        ("forward and backward, float32", torch.float32, both_ways),
    ]
    for name, dtype, call in cases:
        networks = {kind: build(kind, *options.size).to(dtype).eval() for kind in ("saunet", "timm")}
        image = torch.rand(1, 3, *options.size, dtype=dtype)
        times: dict[str, list[float]] = {kind: [] for kind in networks}
        for turn in range(options.rounds + 1):
            for kind, network in networks.items():
                start = time.process_time()
                call(network, image)
                if turn:  # the first warms up
                    times[kind].append(time.process_time() - start)
        ratios = [ours / theirs for ours, theirs in zip(times["saunet"], times["timm"], strict=True)]
        medians = ", ".join(f"{kind} {1000 * statistics.median(each):.0f} ms" for kind, each in times.items())
        print(f"{name}: {medians}, ratio {statistics.median(ratios):.3f} ({min(ratios):.3f} to {max(ratios):.3f})")


if __name__ == "__main__":
    main()
