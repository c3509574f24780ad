"""Whether an exported file computes the same as its network, and how fast, measured on the same inputs in one run."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from saunet.tables import Column, Row, Table

Run = Callable[[NDArray[np.float32]], NDArray[np.float32]]
"""From images (b 3 h w) to disparity (b 1 h w)."""


@dataclass(frozen=True, slots=True)
class Parity:
    """Comparison of an exported file with its network."""

    file: str
    batch: str
    """Number of images the file takes at once: ``any`` or ``one``."""
    difference: float
    """Largest difference in disparity, as a fraction of the network's range of disparity."""
    depth_difference: float
    """Largest relative difference in depth."""
    random: int
    """Number of random images compared."""
    real: int
    """Number of real images compared."""
    megabytes: float = 0.0
    """Size of the file."""
    eager_ms: float = 0.0
    """Median time of the original for one image, on the CPU; see `timed`."""
    exported_ms: float = 0.0
    """Median time of the exported file for one image, on the CPU."""


def random_images(height: int, width: int) -> list[NDArray[np.float32]]:
    """Return two images of random colors, each 1 3 h w, always the same."""
    return list(np.random.default_rng(0).random((2, 1, 3, height, width), dtype=np.float32))


def compare(
    file: str,
    eager: Run,
    exported: Run,
    random: Sequence[NDArray[np.float32]],
    real: Sequence[NDArray[np.float32]],
    span: float,
    batch: str = "one",
    megabytes: float = 0.0,
) -> Parity:
    """Compare an exported file with the original on single images and, if it takes any number, on all at once."""
    inputs = [*random, *real]
    if batch == "any":
        inputs.append(np.concatenate(inputs[-4:]))
    difference = relative = 0.0
    for image in inputs:
        got, wanted = exported(image).astype(np.float64), eager(image).astype(np.float64)
        apart = np.abs(got - wanted)
        difference = float(np.maximum(difference, apart.max() / span))  # NaN stays NaN and fails any tolerance
        relative = float(np.maximum(relative, (apart / np.abs(got)).max()))  # |1/got - 1/wanted| * wanted
    return Parity(file, batch, difference, relative, len(random), len(real), round(megabytes, 3))


def timed(
    reports: Sequence[Parity], eager: Run, exported: Sequence[Run], image: NDArray[np.float32], repeats: int = 11
) -> list[Parity]:
    """Return the comparisons with times: of the original, the same in all, and of each file."""
    first, *others = milliseconds([eager, *exported], image, repeats)
    return [replace(report, eager_ms=first, exported_ms=own) for report, own in zip(reports, others, strict=True)]


def milliseconds(runs: Sequence[Run], image: NDArray[np.float32], repeats: int = 11) -> list[float]:
    """Return the median milliseconds of calls of each, taken in turn, after two warm-up calls."""
    times = np.zeros((repeats + 2, len(runs)))
    for row in times:
        for index, run in enumerate(runs):
            start = time.perf_counter()
            run(image)
            row[index] = time.perf_counter() - start
    return [round(float(value) * 1000, 3) for value in np.median(times[2:], axis=0)]


def parity_table(reports: Sequence[Parity]) -> Table:
    """Return the comparisons for a terminal and for the card."""
    columns = {"file": "", "MB": ".1f", "batch": "", "differs by": ".1e", "random images": "", "real images": ""}
    columns |= {"eager ms": ".1f", "this ms": ".1f", "depth differs by": ".1g"}
    shown = attrgetter("file", "megabytes", "batch", "difference", "random", "real", "eager_ms", "exported_ms")
    rows = [Row((*shown(each), each.depth_difference)) for each in reports]
    notes = (
        "differs by: largest difference in disparity over all images, random and real, as a fraction of its range",
        "eager ms, this ms: the original network's and this file's time for one image",
    )
    title = "Files: against the original network on the CPU"
    return Table("parity", title, tuple(Column(*each) for each in columns.items()), tuple(rows), notes)
