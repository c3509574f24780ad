"""The path of a camera from a pose network: each motion between neighbouring frames predicted once, then chained."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float32, Float64
from numpy import ndarray
from torch import nn

from saunet.checks import ConfigError, DataError, positive
from saunet.images import network_input
from saunet.metrics.odometry import chain_motions
from saunet.progress import bar


class Step(NamedTuple):
    """Which output of the network is which motion."""

    target: int
    """Position of the target frame."""
    slot: int
    """Which of its sources is the other frame."""
    motion: int
    """The motion from the frame at this position to the next."""
    inverted: bool
    """The source is the earlier frame, so the network's T_src_tgt goes back in time."""


def plan(frames: int, offsets: Sequence[int]) -> list[Step]:
    """Plan how a network with sources at ``offsets`` sees each pair of neighbouring frames exactly once.

    A network that takes both neighbours gives two motions for every second frame.

    Raises:
        ConfigError: if no source is a direct neighbour of the target.
        DataError: if there are fewer than two frames.
    """
    if frames < 2:
        raise DataError(f"{frames} frames make no path; give at least two")
    ahead = offsets.index(1) if 1 in offsets else None
    behind = offsets.index(-1) if -1 in offsets else None
    if ahead is None and behind is None:
        raise ConfigError(
            f"the pose network was trained on offsets {list(offsets)}; a path needs the motion between neighbouring "
            "frames, so use a model trained with offset 1 or -1"
        )
    if ahead is None or behind is None:
        if ahead is not None:
            return [Step(motion, ahead, motion, False) for motion in range(frames - 1)]
        assert behind is not None
        return [Step(motion + 1, behind, motion, True) for motion in range(frames - 1)]
    steps = []
    for target in range(1, frames - 1, 2):
        steps += [Step(target, behind, target - 1, True), Step(target, ahead, target, False)]
    if frames % 2 == 0:
        steps.append(Step(frames - 2, ahead, frames - 2, False))
    return steps


@torch.inference_mode()
def predict_trajectory(
    pose: nn.Module,
    drive: Any,
    *,
    offsets: Sequence[int],
    height: int,
    width: int,
    device: str | torch.device = "cpu",
    batch_size: int = 8,
    progress: bool = True,
) -> Float64[ndarray, "n 4 4"]:
    """Predict the path of the camera through all frames of a recording.

    Args:
        pose: The pose network, on ``device``; put into evaluation mode.
        drive: A `saunet.data.sequences.Drive` whose frame numbers have no gap.
        offsets: Time offsets of the sources that the network takes.
        height: Height of its input in pixels.
        width: Width of its input in pixels.
        device: Where to run.
        batch_size: Targets that go through the network together.
        progress: Show a progress bar on a terminal or in a notebook.

    Returns:
        ``T_world_cam`` of each frame; the world is the first camera, and the scale is the network's own.

    Raises:
        ConfigError: if the network sees no neighbouring frames.
        DataError: if there are fewer than two frames, or some are missing in between.
    """
    positive("batch_size", batch_size)
    numbers = list(drive.indices)
    gaps = [a for a, b in itertools.pairwise(numbers) if b != a + 1]
    if gaps:
        raise DataError(f"'{drive.name}' has no frame {gaps[0] + 1}; a path needs all frames from first to last")
    steps = plan(len(numbers), offsets)
    targets = list(dict.fromkeys(step.target for step in steps))
    images: dict[int, Float32[ndarray, "3 h w"]] = {}

    def image(place: int) -> Float32[ndarray, "3 h w"]:
        place = min(max(place, 0), len(numbers) - 1)  # a source beyond the ends, whose motion nobody asks for
        if place not in images:
            images[place] = network_input(drive.image(numbers[place]), height, width)
        return images[place]

    motions: dict[tuple[int, int], Float64[ndarray, "4 4"]] = {}
    pose.eval()
    with bar(progress, "images", taken=True) as shown:
        task = shown.add_task(drive.name, total=len(targets))
        for start in range(0, len(targets), batch_size):
            chosen = targets[start : start + batch_size]
            target = np.stack([image(place) for place in chosen])
            sources = np.stack([[image(place + offset) for offset in offsets] for place in chosen])
            found = pose(torch.from_numpy(target).to(device), torch.from_numpy(sources).to(device))
            for place, row in zip(chosen, found.double().cpu().numpy(), strict=True):
                motions.update({(place, slot): row[slot] for slot in range(len(offsets))})
            oldest = chosen[-1] + min(0, *offsets)
            images = {place: kept for place, kept in images.items() if place >= oldest}
            shown.advance(task, len(chosen))
    ordered = sorted(steps, key=lambda step: step.motion)
    T_next_cam = [
        np.linalg.inv(motions[step.target, step.slot]) if step.inverted else motions[step.target, step.slot]
        for step in ordered
    ]
    return chain_motions(np.stack(T_next_cam))
