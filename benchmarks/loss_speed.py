"""View synthesis, photometric loss and their gradients: in one pass against separate operations, in turn.

Four scales, two sources, 640x192, processor time of one thread::

    python benchmarks/loss_speed.py                       # two samples
    python benchmarks/loss_speed.py --batch 4 --term photometric_monodepth2
"""

from __future__ import annotations

import argparse
import functools
import statistics
import time
from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

import saunet
from saunet.geometry.depth import disparity_to_depth, sigmoid_to_disparity
from saunet.training.module import SelfSupervisedDepth
from saunet.types import DepthPyramid, View, Views

HEIGHT, WIDTH, SCALES, SOURCES = 192, 640, 4, 2


def inputs(batch: int) -> tuple[dict[str, Tensor], list[Tensor], Tensor, Tensor]:
    """Return images with structure and noise, the depth network's outputs, and motions."""
    torch.manual_seed(0)
    count = batch * (1 + SOURCES)
    smooth = F.interpolate(torch.rand(count, 3, 24, 80), (HEIGHT, WIDTH), mode="bicubic").clamp(0, 1)
    images = (0.8 * smooth + 0.2 * torch.rand_like(smooth)).view(batch, 1 + SOURCES, 3, HEIGHT, WIDTH)
    K = torch.tensor([[0.58 * WIDTH, 0, 0.5 * WIDTH], [0, 1.92 * HEIGHT, 0.5 * HEIGHT], [0, 0, 1]])
    sizes = [(HEIGHT >> scale, WIDTH >> scale) for scale in range(SCALES)]
    sigmoid = [F.interpolate(torch.rand(batch, 1, 4, 5), size, mode="bilinear").requires_grad_() for size in sizes]
    axisangle, translation = (0.02 * torch.rand(batch, SOURCES, 3), 0.2 * torch.rand(batch, SOURCES, 3))
    frames = {"loss_target": images[:, 0].contiguous(), "loss_sources": images[:, 1:].contiguous()}
    return {**frames, "K": K.repeat(batch, 1, 1)}, sigmoid, axisangle.requires_grad_(), translation.requires_grad_()


def seconds(term: Any, one_pass: bool, given: tuple[Any, list[Tensor], Tensor, Tensor]) -> tuple[float, float]:
    """Return processor seconds from the networks' outputs to their gradients, and the loss."""
    batch, sigmoid, axisangle, translation = given
    torch.manual_seed(1)
    began = time.process_time()
    disparity = tuple(sigmoid_to_disparity(each, 0.1, 100.0) for each in sigmoid)
    pyramid = DepthPyramid(tuple(sigmoid), disparity, tuple(map(disparity_to_depth, disparity)))
    poses = saunet.pose_matrix(axisangle, translation)
    made: Any = functools.partial(SelfSupervisedDepth.synthesize, batch, pyramid, poses)
    views: Sequence[View] = Views(SCALES, made) if one_pass else made()
    value = term(batch, pyramid, poses, views).value
    torch.autograd.grad(value, [*sigmoid, axisangle, translation])
    return time.process_time() - began, float(value.detach())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--term", default="photometric", choices=["photometric", "photometric_monodepth2"])
    options = parser.parse_args()
    torch.set_num_threads(1)
    term, given, ratios = saunet.build("term", options.term), inputs(options.batch), []
    for repeat in range(options.repeats + 1):
        separate, expected = seconds(term, False, given)
        ours, loss = seconds(term, True, given)
        if repeat:  # the first one warms up
            ratios.append(ours / separate)
            print(f"separate {separate:.3f} s, one pass {ours:.3f} s, ratio {ratios[-1]:.2f}", flush=True)
    low, high = min(ratios), max(ratios)
    print(
        f"ratio {statistics.median(ratios):.2f} ({low:.2f} to {high:.2f}); losses differ by {abs(loss - expected):.1e}"
    )


if __name__ == "__main__":
    main()
