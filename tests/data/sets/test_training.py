"""One step of training on each public data set."""

from __future__ import annotations

import pytest
import set_trees
import torch
from tiny import tiny_model, tiny_trainer

from saunet.registry import datamodules
from saunet.training.optim import Recipe

SETS = {
    "cityscapes": {},
    "ddad": {"cameras": ["camera_01", "camera_05"], "target_depth": True, "with_pose": True},
    "kitti_360": {"train_sequences": ["0003"], "stereo": True},
    "nuscenes": {"frames": "sweeps"},
}


@pytest.mark.parametrize("name", SETS)
def test_a_step(tmp_path, name):
    options = {"cityscapes": {"right": False}}.get(name, {})
    root = getattr(set_trees, name)(tmp_path / "data", **options)
    data = datamodules.build(name, root=str(root), height=32, width=96, batch_size=2, workers=0, **SETS[name])
    model = tiny_model(Recipe(lr=1e-2, schedule="constant"))
    before = [each.clone() for each in model.parameters()]
    trainer = tiny_trainer(tmp_path, max_epochs=1, limit_train_batches=1, limit_val_batches=1)
    trainer.fit(model, data)
    assert trainer.global_step == 1
    assert torch.isfinite(trainer.callback_metrics["val/abs_rel"])
    assert any(not torch.equal(old, new) for old, new in zip(before, model.parameters(), strict=True))
