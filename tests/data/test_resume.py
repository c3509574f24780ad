"""A training that is interrupted in the middle of an epoch goes on with the next batch."""

from __future__ import annotations

import pytest
import torch
from drives import NumberDrive
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint

from saunet.data.loading.module import DepthDataModule
from saunet.data.loading.windows import Selection


class Drives(DepthDataModule):
    def select(self, split):
        return [Selection(NumberDrive(f"{split} l", indices=range(14)), range(14))]


class Notes(LightningModule):
    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))
        self.seen = []

    def training_step(self, batch, batch_idx):
        self.seen.append((self.current_epoch, batch_idx, tuple(batch["name"]), float(batch["target"].sum())))
        return self.weight * batch["target"].mean()

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), 0.1)


def fit(folder, resume=None, **settings):
    torch.manual_seed(99 if resume else 1)  # nothing may depend on the global generator
    model, data = Notes(), Drives(height=10, width=15, batch_size=3, workers=0)
    every = ModelCheckpoint(folder, filename="{step}", save_top_k=-1, every_n_train_steps=1)
    trainer = Trainer(
        max_epochs=3,
        accelerator="cpu",
        logger=False,
        callbacks=[every],
        enable_progress_bar=False,
        enable_model_summary=False,
        limit_val_batches=0,
        **settings,
    )
    trainer.fit(model, datamodule=data, ckpt_path=resume, weights_only=True)
    return model.seen


@pytest.mark.parametrize("cut", [1, 3, 4, 6, 8])
def test_exact_resume_inside_and_between_epochs(tmp_path, cut):
    whole = fit(tmp_path / "whole")  # four batches an epoch
    assert [(epoch, step) for epoch, step, *_ in whole[3:6]] == [(0, 3), (1, 0), (1, 1)]
    rest = fit(tmp_path / "rest", resume=tmp_path / "whole" / f"step={cut}.ckpt")
    assert rest == whole[cut:]


@pytest.mark.parametrize("cut", [1, 2, 4, 5])
def test_exact_resume_where_a_limit_ends_the_epochs(tmp_path, cut):
    """After its last step, an epoch that a limit cuts has batches left, and the next one still begins at the first."""
    whole = fit(tmp_path / "whole", limit_train_batches=2)
    rest = fit(tmp_path / "rest", tmp_path / "whole" / f"step={cut}.ckpt", limit_train_batches=2)
    assert rest == whole[cut:]
