"""Motion from tracked points takes the place of the predicted one, follows crops and flips, and teaches the network."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from training_options import train_options

from saunet.data.synthetic import SyntheticDataModule
from saunet.errors import ConfigError
from saunet.training.tool import assemble


@pytest.fixture(scope="module")
def street() -> SyntheticDataModule:
    data = SyntheticDataModule(
        height=96,
        width=192,
        batch_size=8,
        workers=0,
        train_drives=1,
        frames_per_drive=10,
        cache=None,
        track_motion=True,
        with_pose=True,
        target_depth=True,
    )
    data.setup("fit")
    return data


def test_it_is_the_true_motion_up_to_the_unit_of_depth(config: dict[str, Any], street: SyntheticDataModule) -> None:
    config["objective"]["extra"] = {"tracked_motion": {"weight": 1.0}}
    model = assemble(train_options(config), street)
    batch = street.augment(next(iter(street.train_dataloader())))  # cropped, and some of it mirrored
    assert 0 < (batch["K"][:, 0, 2] > 95.5).sum() < 8
    _, poses, _, terms = model.step(batch)
    true = batch["T_src_tgt"]
    torch.testing.assert_close(poses[..., :3, :3], true[..., :3, :3], rtol=0, atol=0.01)
    lengths = poses[..., :3, 3].norm(dim=-1)
    directions = poses[..., :3, 3] / lengths[..., None]
    assert (directions * torch.nn.functional.normalize(true[..., :3, 3], dim=-1)).sum(-1).min() > 0.99
    ways = true[..., :3, 3].norm(dim=-1)
    # Points lie where the picture shows them: true depth over theirs is the true way, of which they are a part.
    for points, depth, way in zip(batch["track_points"], batch["target_depth"], ways, strict=True):
        for each, length in zip(points, way, strict=True):
            column, row, z = each[(each >= 0).all(-1) & (each[:, 0] < 191.5) & (each[:, 1] < 95.5)].T
            there = depth[0, row.round().long(), column.round().long()]
            assert float((there / z)[there > 0].median()) == pytest.approx(float(length), rel=0.15)
    terms.total.backward()
    assert model.pose is not None
    assert all(each.grad is not None and each.grad.isfinite().all() for each in model.pose.parameters())
    assert any(each.grad is not None for each in model.depth.parameters())
    scored = street.prepare(next(iter(street.val_dataloader())))
    assert torch.equal(model.step(scored)[1][..., :3, :3], scored["T_tracked"][..., :3, :3])


def test_the_network_answers_where_points_do_not(config: dict[str, Any], street: SyntheticDataModule) -> None:
    config["objective"]["extra"] = {"tracked_motion": {"weight": 1.0}}
    model = assemble(train_options(config), street)
    batch = street.augment(next(iter(street.train_dataloader())))
    batch["T_tracked"][0, 1] = torch.nan
    batch["track_points"][2, 0] = torch.nan
    poses, own = model.step(batch)[1], model.motion(batch)
    same = (poses == own).flatten(2).all(-1)
    assert same.nonzero().tolist() == [[0, 1], [2, 0]]


def test_a_network_that_learns_nothing_is_refused(config: dict[str, Any], street: SyntheticDataModule) -> None:
    with pytest.raises(ConfigError, match=r"objective\.extra\.tracked_motion\.weight=1"):
        assemble(train_options(config), street)
