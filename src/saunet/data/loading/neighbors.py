"""Frames of a split with what measuring the scale needs beside them: neighbors, stereo view, way traveled."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from lightning.pytorch.utilities import move_data_to_device

from saunet.data.loading.module import DepthDataModule
from saunet.data.loading.sampling import evenly
from saunet.data.loading.stereo import Odometer
from saunet.data.loading.windows import Selection, WindowDataset, collate, find_windows
from saunet.errors import ConfigError, DataError
from saunet.types import EvalBatch


def surroundings(
    data: DepthDataModule,
    split: str,
    device: str | torch.device,
    *,
    offsets: Sequence[int] = (),
    stereo: bool = False,
    odometer: Odometer | None = None,
    most: int = 100,
) -> Iterator[EvalBatch]:
    """Yield frames of a split one by one, as the networks want them, with the sources asked for."""
    if split not in data.datasets:
        raise ConfigError(f"the '{split}' split is not set up; call setup() first")
    dataset = data.datasets[split]
    wanted: dict[int, list[int]] = {}
    for position, frame in dataset.windows:
        wanted.setdefault(position, []).append(frame)
    drives = [dataset.drives[position] for position in wanted]
    selections = [Selection(drive, frames) for drive, frames in zip(drives, wanted.values(), strict=True)]
    windows, usage = find_windows(selections, offsets, stereo)
    if not windows:
        raise DataError(
            f"no frame of split '{split}' has neighbors at {list(offsets)}{' and a stereo view' if stereo else ''} "
            f"({'; '.join(map(str, usage[:3]))}); measure the scale in another way"
        )
    samples = WindowDataset(
        drives,
        [windows[place] for place in evenly(len(windows), most)],
        offsets=offsets,
        height=data.height,
        width=data.width,
        stereo=stereo,
        odometer=odometer,
    )
    for index in range(len(samples)):
        yield data.prepare(move_data_to_device(collate(samples[index]), torch.device(device)))
