"""Train in two processes, of which the second gets a spoiled third batch: ``python ddp_nonfinite.py FOLDER ACTION``.

Each process writes the names of its third batch to ``FOLDER/names_RANK`` and what it ended with to ``FOLDER/end_RANK``.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import tiny
import torch
from lightning import Callback, LightningModule, Trainer

from saunet.errors import SaunetError
from saunet.training.callbacks import LastCheckpoint
from saunet.training.nonfinite import NonFinite


class SpoilSecond(Callback):
    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        if trainer.global_step == 2:
            (self.folder / f"names_{trainer.global_rank}").write_text(", ".join(batch["name"]))
            if trainer.global_rank == 1:
                batch["target"].fill_(torch.nan)


def main(folder: Path, action: Any) -> None:
    saved = LastCheckpoint(str(folder), every_n_steps=1)
    callbacks = [SpoilSecond(folder), saved, NonFinite(str(folder / "bad"), action)]
    settings = {"max_epochs": 2, "limit_val_batches": 0, "devices": 2, "strategy": "ddp"}
    trainer = tiny.tiny_trainer(folder, callbacks=callbacks, **settings)
    try:
        trainer.fit(tiny.tiny_model(), tiny.tiny_walls())
    except SaunetError as error:
        (folder / f"end_{trainer.global_rank}").write_text(str(error))
        raise


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
