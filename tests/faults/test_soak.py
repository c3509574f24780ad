"""What runs for long grows neither in memory nor in open files."""

from __future__ import annotations

import gc
import os
from pathlib import Path

import numpy as np
import psutil
import pytest
import tiny
from lightning import Callback, Trainer
from tiny_depth import TinyDecoder, TinyEncoder

from saunet.models.depth import DepthNet
from saunet.prediction.predictor import Predictor

LENGTH = float(os.environ.get("SAUNET_SOAK", "1"))  # times as long as the slow session allows


class Usage(Callback):
    """Note memory (MB) and open files after every epoch."""

    def __init__(self) -> None:
        self.seen: list[tuple[float, int]] = []

    def note(self) -> None:
        gc.collect()
        process = psutil.Process()
        self.seen.append((process.memory_info().rss / 2**20, process.num_fds()))

    def on_train_epoch_end(self, trainer: Trainer, *_: object) -> None:
        self.note()

    def check(self) -> None:
        """The second half has no more files open than the first, and at most 20 MB more memory."""
        half = len(self.seen) // 2
        first, second = self.seen[1:half], self.seen[half:]
        assert max(files for _, files in second) <= max(files for _, files in first)
        assert max(memory for memory, _ in second) < max(memory for memory, _ in first) + 20


@pytest.mark.slow
def test_a_long_training(tmp_path: Path) -> None:
    usage = Usage()
    trainer = tiny.tiny_trainer(
        tmp_path,
        max_epochs=round(100 * LENGTH),
        callbacks=[usage, tiny.LastCheckpoint(str(tmp_path), every_n_steps=1)],
    )
    trainer.fit(tiny.tiny_model(), tiny.tiny_walls(workers=2 if LENGTH > 1 else 0))
    usage.check()


@pytest.mark.slow
def test_many_predictions() -> None:
    predictor, usage = Predictor(DepthNet(TinyEncoder(), TinyDecoder), 32, 64), Usage()
    picture = np.random.default_rng(0).integers(0, 255, (60, 90, 3), np.uint8)
    for _ in range(20):
        for _ in range(round(100 * LENGTH)):
            predictor.predict(picture)
        usage.note()
    usage.check()
