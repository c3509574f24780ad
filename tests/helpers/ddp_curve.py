"""Run the tiny training in one process or two: ``python ddp_curve.py FOLDER PROCESSES EPOCHS [RANK SIGNAL]``.

Writes the logged losses of its steps, the steps after which it validates, and the last metric to ``FOLDER/curve.json``.
With a rank and a signal, that process sends itself the signal in its fourth step.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

import tiny
import torch
from lightning import Callback, LightningModule, Trainer

from saunet.runs.folder import recording
from saunet.training.callbacks import LastCheckpoint
from saunet.training.intrinsics import focal_lengths
from saunet.training.optim import Recipe
from saunet.training.stopping import GracefulStop, ProcessWatch


class Curve(Callback):
    def __init__(self, folder: Path, rank: int | None, number: int) -> None:
        self.folder, self.rank, self.number = folder, rank, number
        self.losses: list[float] = []
        self.validated: list[int] = []

    def on_validation_end(self, trainer: Trainer, *_: Any) -> None:
        self.validated.append(trainer.global_step)

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, outputs: Any, *_: Any) -> None:
        self.losses.append(float(trainer.callback_metrics["train/loss"]))  # as it is logged
        if trainer.global_rank == self.rank and trainer.global_step == 4:
            (self.folder / "struck").touch()
            os.kill(os.getpid(), self.number)


def main(folder: Path, processes: int, epochs: int, rank: int | None = None, number: int = signal.SIGTERM) -> None:
    with recording(folder, "curve"):
        # The mean of the halves' losses is the whole's where no sample sees another and nothing is drawn: masks are on,
        # but no noise decides their ties, no dropout, no batch norm (which is synchronized on GPUs only).
        model = tiny.tiny_model(Recipe(lr=3e-3, schedule="cosine"), dropout=0.0)
        photometric: Any = model.objective.terms["photometric"]
        assert photometric.automask
        assert photometric.use_validity
        assert photometric.reduction == "masked"
        photometric.noise = 0.0
        model.depth.encoder[1] = torch.nn.Identity()  # type: ignore[union-attr, index, operator]
        data = tiny.tiny_walls()
        data.setup("fit")
        model.intrinsics = focal_lengths("refined", data)
        curve = Curve(folder, rank, number)
        watch = [
            GracefulStop(str(folder / "c")),
            ProcessWatch(str(folder), str(folder / "c")),
            LastCheckpoint(str(folder / "c"), every_n_steps=1),
        ]
        trainer = tiny.tiny_trainer(
            folder,
            max_epochs=epochs,
            max_steps=3 * epochs - 1,  # one before the end of the last epoch
            devices=processes,
            log_every_n_steps=1,
            strategy="ddp" if processes > 1 else "auto",
            callbacks=[curve, *watch],
        )
        trainer.fit(model, data)
        if trainer.is_global_zero:
            metrics = {name: float(value) for name, value in trainer.callback_metrics.items() if name.startswith("val")}
            focals = [after / before for before, after in model.found_intrinsics().focals.values()]
            seen = {"losses": curve.losses, "validated": curve.validated, "metrics": metrics, "focals": focals}
            (folder / "curve.json").write_text(json.dumps(seen))


if __name__ == "__main__":
    main(Path(sys.argv[1]), *(int(word) for word in sys.argv[2:]))
