"""What the scale is measured from: frames of a folder or video as batches."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np
import torch
from jaxtyping import UInt8
from numpy.typing import NDArray

from saunet.errors import DataError
from saunet.io.images import network_input
from saunet.types import TrainBatch

Image = UInt8[np.ndarray, "_ _ 3"]


def clip_batches(
    frames: Iterable[Image],
    height: int,
    width: int,
    *,
    offsets: Sequence[int] = (),
    distance: Callable[[int, int], float] | None = None,
    intrinsics: Callable[[int, int], NDArray[np.float64]] | None = None,
    stereo: Iterable[Image] | None = None,
    baseline: float = 0.0,
    count: int | None = None,
    most: int = 100,
) -> Iterator[TrainBatch]:
    """Yield frames of a clip one by one as a network wants them, with neighbors, K and other view if asked for.

    ``distance`` gives meters between two frames by their numbers (NaN if unknown), ``intrinsics`` K of an image of a
    (height, width), and ``baseline`` is the meters to the other camera, positive if that is the right one. Of more
    frames than ``most``, only so many are used, evenly spread if ``count`` is known.
    """
    before, after = -min(0, *offsets, 0), max(0, *offsets, 0)
    step = max(1, (count - before - after) // most) if count else 1
    window: deque[NDArray[np.float32]] = deque(maxlen=before + 1 + after)
    others: deque[Image | None] = deque(maxlen=after + 1)
    yielded = 0
    for number, (frame, other) in enumerate(itertools.zip_longest(frames, () if stereo is None else stereo)):
        if frame is None or (stereo is not None and other is None):
            raise DataError(
                f"the two cameras have different numbers of images (one ends after {number}); give pairs taken at "
                "the same moment"
            )
        window.append(network_input(frame, height, width))
        others.append(other)
        index = number - after
        if len(window) < before + 1 + after or (index - before) % step:
            continue
        target = torch.from_numpy(window[before])[None]
        sources = [window[before + offset] for offset in offsets]
        batch: TrainBatch = {
            "target": target,
            "sources": target.new_zeros(1, 0, 3, height, width),
            "loss_target": target,
            "loss_sources": target.new_zeros(1, 0, 3, height, width),
            "K": torch.eye(3)[None],
            "name": [f"frame {index}"],
        }
        if intrinsics is not None:
            batch["K"] = torch.from_numpy(intrinsics(height, width)).float()[None]
        if distance is not None:
            batch["distance"] = torch.tensor([[distance(index, index + offset) for offset in offsets]])
        if others[0] is not None:
            sources.append(network_input(others[0], height, width))
            batch["T_stereo_tgt"] = torch.eye(4)[None]
            batch["T_stereo_tgt"][0, 0, 3] = -baseline
        if sources:
            batch["sources"] = batch["loss_sources"] = torch.from_numpy(np.stack(sources))[None]
        yield batch
        yielded += 1
        if yielded == most:
            return
