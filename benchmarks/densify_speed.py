"""Speed of dense depth by colorization against the usual version: ``python benchmarks/densify_speed.py --root DIR``.

The usual version is the NYU toolbox's loop over pixels followed by ``scipy.sparse.linalg.spsolve``; both run on the
same frames in turn, on one thread, so that whatever else the machine does falls on both. ``--clock cpu`` counts only
the time that the process itself was given; use it on a busy machine. Without ``--root`` a made-up frame is used.
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy is imported
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import statistics
import time
from collections.abc import Iterator

import cv2
import numpy as np
import scipy.sparse
import scipy.sparse.linalg
import torch

from saunet.tools.prepare.colorization import colorize
from saunet.tools.prepare.targets import interpolate


def usual(image: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Write the equations down pixel by pixel and give them to a general sparse solver."""
    gray = image @ (np.array([0.299, 0.587, 0.114]) / 255)
    height, width = gray.shape
    numbers = np.arange(gray.size).reshape(gray.shape)
    rows, columns, values = [], [], []
    for y in range(height):
        for x in range(width):
            window = (slice(max(0, y - 1), y + 2), slice(max(0, x - 1), x + 2))
            around = numbers[window].ravel() != numbers[y, x]
            to = numbers[window].ravel()[around]
            difference = (gray[window].ravel()[around] - gray[y, x]) ** 2
            spread = max(0.6 * gray[window].var(), -difference.min() / np.log(0.01), 2e-6)
            weight = np.exp(-difference / spread)
            rows += [numbers[y, x]] * (len(to) + 1)
            columns += [*to, numbers[y, x]]
            values += [*(-weight / weight.sum()), 1.0 + (depth[y, x] > 0)]
    matrix = scipy.sparse.csr_matrix((values, (rows, columns)), shape=(gray.size, gray.size))
    top = depth.max()
    solved = scipy.sparse.linalg.spsolve(matrix, depth.astype(np.float64).ravel() / top).reshape(depth.shape) * top
    return np.where(depth > 0, depth, solved)


def frames(root: str | None, count: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    if root is None:
        rng = np.random.default_rng(0)
        image = cv2.resize(
            rng.integers(0, 255, (47, 156, 3), dtype=np.uint8), (1242, 375), interpolation=cv2.INTER_CUBIC
        )
        image = np.clip(image + rng.normal(0, 3, image.shape), 0, 255).astype(np.uint8)
        ramp = np.repeat(np.linspace(60, 5, 375, dtype=np.float32)[:, None], 1242, 1)
        known = (rng.random(ramp.shape) < 0.05) & (np.arange(375)[:, None] > 130)
        yield image, np.where(known, ramp, 0).astype(np.float32)
        return
    from saunet.tools.prepare.tool import kitti_recordings

    taken = 0
    for drive, numbers in kitti_recordings(root):
        for number in numbers[:: max(1, len(numbers) // count)]:
            depth = drive.depth(number)
            if depth is not None and taken < count:
                taken += 1
                yield drive.image(number), depth


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition(":")[0])
    parser.add_argument("--root", help="KITTI raw recordings with scans")
    parser.add_argument("--frames", type=int, default=3)
    parser.add_argument("--clock", choices=("wall", "cpu"), default="wall", help="what to read")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    clock = {"wall": time.perf_counter, "cpu": time.process_time}[arguments.clock]
    times: dict[str, list[float]] = {"usual": [], "colorization": [], "linear": []}
    worst = 0.0
    for image, depth in frames(arguments.root, arguments.frames):
        start = clock()
        expected = usual(image, depth)
        times["usual"].append(clock() - start)
        for _ in range(3):
            start = clock()
            dense = colorize(image, depth)
            times["colorization"].append(clock() - start)
        start = clock()
        interpolate(depth)
        times["linear"].append(clock() - start)
        worst = max(worst, float(np.abs(dense / expected - 1).max()))
    medians = {name: statistics.median(each) for name, each in times.items()}
    print(
        f"{len(times['usual'])} frames of {image.shape[1]}x{image.shape[0]}, one thread, "
        f"{arguments.clock} clock, medians"
    )
    for name, median in medians.items():
        print(f"{name:13} {median:7.2f} s   {medians['usual'] / median:6.1f} x")
    print(f"largest difference of colorization to the usual version: {worst:.1e} relative")


if __name__ == "__main__":
    main()
