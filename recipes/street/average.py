"""Average the weights of trainings that began from each other: ``python average.py out.pt a.pt b.pt ...``.

While a network learns rendered streets, its depth of real ones sways: what rendered frames leave open, each step
decides anew. The mean of weights from different times, or of branches of one training, reads real frames better.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor


def average(states: Sequence[dict[str, Tensor]]) -> dict[str, Tensor]:
    """Return the mean of every tensor; whole numbers, such as a count of batches, are the first's."""
    first = states[0]
    return {
        key: torch.stack([state[key] for state in states]).mean(0) if value.is_floating_point() else value
        for key, value in first.items()
    }


def main() -> None:
    """Write the average."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("weights", type=Path, nargs="+", help="files of train_depth.py; one named twice counts twice")
    options = parser.parse_args()
    torch.save(average([torch.load(path, weights_only=True) for path in options.weights]), options.out)


if __name__ == "__main__":
    main()
