"""Does an exported file compute what the network computes, and how fast: measured on the same inputs in one run."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Run = Callable[[NDArray[np.float32]], NDArray[np.float32]]
"""From images (b 3 h w) to disparity (b 1 h w)."""


@dataclass(frozen=True, slots=True)
class Parity:
    """How an exported file compares with the network it came from."""

    file: str
    difference: float
    """Largest difference in disparity, as a share of the network's range of disparity."""
    images: int
    """Images compared: random ones and, where given, real ones."""
    eager_ms: float
    """Median time of the original for one image, on the CPU."""
    exported_ms: float
    """Median time of the exported file for one image, on the CPU."""


def compare(file: str, eager: Run, exported: Run, images: Sequence[NDArray[np.float32]], span: float) -> Parity:
    """Compare an exported file with the original.

    Args:
        file: Its name, for the report.
        eager: The original.
        exported: The exported file.
        images: Inputs, each 1 x 3 x h x w.
        span: Largest minus smallest disparity that the network can give.
    """
    difference = max(float(np.abs(exported(image) - eager(image)).max()) / span for image in images)
    return Parity(file, difference, len(images), milliseconds(eager, images[0]), milliseconds(exported, images[0]))


def milliseconds(run: Run, image: NDArray[np.float32], repeats: int = 11) -> float:
    """Return the median time of ``repeats`` runs, after two that do not count."""
    times = []
    for _ in range(repeats + 2):
        start = time.perf_counter()
        run(image)
        times.append(time.perf_counter() - start)
    return round(float(np.median(times[2:])) * 1000, 3)
