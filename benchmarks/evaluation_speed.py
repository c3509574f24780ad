"""How long an evaluation takes, and whether its memory stays flat: simulated KITTI-sized samples, no data needed.

Every sample has a decoded image at the network's size and LiDAR-like ground truth at 1242x375, made on the fly, as a
loader would; so what is timed is the network, the scoring and the statistics. ``--predictors 3`` is what
``saunet evaluate`` does by default (the model, constant depth and the mean depth map).
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Iterator

import torch

from saunet.evaluation import NetworkPredictor, score
from saunet.evaluation.scoring import Buckets
from saunet.evaluation.statistics import with_statistics
from saunet.metrics.baselines import ConstantDepth
from saunet.metrics.protocols import protocol
from saunet.models.depth import DepthNet
from saunet.registry import decoders, encoders
from saunet.types import EvalBatch


def batches(samples: int, size: int, height: int, width: int, share: float, memory: list[float]) -> Iterator[EvalBatch]:
    generator = torch.Generator().manual_seed(0)
    for start in range(0, samples, size):
        count = min(size, samples - start)
        depth = torch.rand(count, 1, 375, 1242, generator=generator) * 85
        depth[torch.rand(depth.shape, generator=generator) > share] = 0
        memory.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
        yield {  # type: ignore[typeddict-item]
            "target": torch.rand(count, 3, height, width, generator=generator),
            "name": [f"drive_{(start + i) // 25:02d} {start + i:010d} l" for i in range(count)],
            "depth": depth,
            "depth_size": torch.tensor([[375, 1242]] * count),
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition(":")[0])
    parser.add_argument("--samples", type=int, default=697)
    parser.add_argument("--model", default="resnet18+unet", help="encoder+decoder, random weights; or 'none'")
    parser.add_argument("--size", type=int, nargs=2, default=(192, 640), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--predictors", type=int, default=3)
    parser.add_argument("--known", type=float, default=0.045, help="share of pixels with ground truth")
    parser.add_argument("--buckets", action="store_true")
    parser.add_argument("--threads", type=int, default=2)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    height, width = arguments.size
    predictors = {f"constant {i}": NetworkPredictor(ConstantDepth(5.0 + i)) for i in range(arguments.predictors)}
    if arguments.model != "none":
        encoder, decoder = arguments.model.split("+")
        network = DepthNet(encoders.build(encoder), decoders.partial(decoder))
        predictors = {"model": NetworkPredictor(network), **dict(list(predictors.items())[1:])}
    memory: list[float] = []
    wall, cpu = time.perf_counter(), time.process_time()
    result = score(
        predictors,
        batches(arguments.samples, arguments.batch, height, width, arguments.known, memory),
        [protocol("eigen_camera_z"), protocol("metric")],
        buckets=Buckets() if arguments.buckets else None,
        total=arguments.samples,
    )
    with_statistics(result, 0.95)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    early = memory[min(len(memory) - 1, 3)]  # once everything has been allocated once
    print(
        f"{arguments.samples} samples, {len(predictors)} predictors, 2 protocols, {arguments.model}, "
        f"{height}x{width}, threads {arguments.threads}: {wall:.0f} s wall, {cpu:.0f} s CPU "
        f"({cpu / arguments.samples * 1e3:.0f} ms a sample); peak memory {early:.0f} MB after four batches, "
        f"{memory[-1]:.0f} MB at the end"
    )


if __name__ == "__main__":
    main()
