"""Turn trained weights into one saunet checkpoint: ``python export.py depth.pt [--pose pose.pt] street.ckpt``."""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from train_depth import DECODER, MAX_DEPTH

from saunet.registry import Spec
from saunet.runs.checkpoint import atomic_save
from saunet.runs.record import ModelRecord


def checkpoint(out: Path, depth: Path, pose: Path | None, size: tuple[int, int], facts: dict[str, object]) -> None:
    """Write a checkpoint that ``saunet.load`` reads.

    Args:
        out: File to write.
        depth: Weights of the depth network, from train_depth.py.
        pose: Weights of the pose network, from train_pose.py; None leaves it out.
        size: (height, width) that the network was trained for.
        facts: Plain data about the training.
    """
    parts = {"depth": torch.load(depth, weights_only=True)}
    if pose is not None:
        parts["pose"] = torch.load(pose, weights_only=True)
    record = ModelRecord(
        encoder=dict(Spec.of("encoder", "efficientnet_lite0").node),
        decoder=dict(Spec.of("decoder", "unet", channels=list(DECODER)).node),
        pose=dict(Spec.of("pose", "posecnn").node) if pose is not None else None,
        min_depth=0.1,
        max_depth=MAX_DEPTH,
        height=size[0],
        width=size[1],
        data=facts,
    )
    state = {f"{part}.{key}": value for part, weights in parts.items() for key, value in weights.items()}
    atomic_save({"state_dict": state, "saunet": record.to_plain(), "epoch": 0, "global_step": 0}, out)


def main() -> None:
    """Write the checkpoint."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("depth", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--pose", type=Path)
    parser.add_argument("--size", type=int, nargs=2, default=(128, 416))
    options = parser.parse_args()
    facts = {
        "name": "street",
        "frames": "streets rendered by recipes/street, and of data=synthetic's world, with exact depth; no real frame",
        "depth": "meters for a camera whose focal length is 0.58 image widths; for another, times its own over 0.58",
    }
    checkpoint(options.out, options.depth, options.pose, tuple(options.size), facts)


if __name__ == "__main__":
    main()
