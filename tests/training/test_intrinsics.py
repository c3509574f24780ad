"""Focal lengths that a training refines or learns: they move towards the truth, are kept, and two processes agree."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from rendered import Winding
from torch import nn
from training_options import train_options

import saunet
from saunet.data.drive import DriveProxy
from saunet.data.loading.module import DepthDataModule
from saunet.data.loading.windows import Selection, recording_of, sample_name
from saunet.data.video.camera import read_camera
from saunet.errors import CheckpointError, ConfigError
from saunet.evaluation.tool import _refined
from saunet.exporting.tool import public_record
from saunet.geometry.camera import GUESS, crop_intrinsics, flip_intrinsics, scale_intrinsics, zoom_intrinsics
from saunet.io.images import write_image
from saunet.registry import objectives
from saunet.runs.checkpoint import read_checkpoint, store_scale
from saunet.runs.record import Intrinsics, ModelRecord, Scale
from saunet.training.intrinsics import FocalLengths, focal_lengths
from saunet.training.module import SelfSupervisedDepth
from saunet.training.tool import train
from saunet.types import DepthPyramid

GIVEN = {"a": (60.0, 100), "b c": (30.0, 100)}


def test_zoom_goes_along_with_resize_crop_and_flip() -> None:
    K = torch.tensor([[50.0, 2.0, 20.0], [0.0, 40.0, 11.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    zoomed = zoom_intrinsics(K, 1.1)
    expected = torch.tensor([[55.0, 2.2, 20.0], [0.0, 44.0, 11.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(zoomed, expected)
    for change in (
        lambda K: scale_intrinsics(K, 0.5, 0.25),
        lambda K: crop_intrinsics(K, 3, 4),
        lambda K: flip_intrinsics(K, 60),
    ):
        torch.testing.assert_close(change(zoomed), zoom_intrinsics(change(K), 1.1))
    factor = torch.tensor([0.9, 1.2], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(zoom_intrinsics, (K.expand(2, 3, 3).clone().requires_grad_(), factor))


@pytest.mark.parametrize("drive", ["x", "2011_09_26/drive_0001_sync l", "a 0000000003"])
def test_the_recording_is_known_by_the_name_of_the_sample(drive: str) -> None:
    assert recording_of(sample_name(drive, 17)) == drive
    assert recording_of(sample_name(drive, 17), with_side=False) == drive.removesuffix(" l")


@pytest.mark.parametrize(("mode", "factors"), [("refined", (1, 1, 1)), ("learned", (GUESS / 0.6, GUESS / 0.3, GUESS))])
def test_start_and_recordings_that_were_not_trained_on(mode: str, factors: tuple[float, ...]) -> None:
    """Images of half the width, so K is 0.5 of it; 'c' is another recording, with a focal length of one width."""
    focals = FocalLengths(mode, GIVEN)
    names = [sample_name(drive, 3) for drive in ("a", "b c", "c")]
    K = torch.stack([torch.diag(torch.tensor([fx, 0.8 * fx, 1.0])) for fx in (30.0, 15.0, 50.0)])
    found = focals(K, names, 50)
    torch.testing.assert_close(found[:, 0, 0] / K[:, 0, 0], torch.tensor(factors, dtype=torch.float32))
    torch.testing.assert_close(found[:, 1, 1], 0.8 * found[:, 0, 0])
    with torch.no_grad():
        focals.change.copy_(torch.tensor([0.01, -0.02]))
    record = focals.found(focals.change)
    for number, (name, own) in enumerate((("a", 0.6), ("b c", 0.3), ("c", 1.0))):
        now = focals(K, names, 50)[number, 0, 0].item() / 50
        assert record.focal(name, own) == pytest.approx(now, rel=1e-6)
    (evaluated,) = _refined([{"K": K, "name": names, "target": torch.zeros(3, 3, 8, 50)}], record)  # type: ignore[list-item, typeddict-item]
    torch.testing.assert_close(evaluated["K"], focals(K, names, 50).detach())
    assert f"'a': 60.0 -> {record.focal('a', 0.6) * 100:.1f} px" in focals.told(record)


def test_the_record_is_checked() -> None:
    found = Intrinsics("refined", {"a": (0.6, 0.66), "b": (0.5, 0.55)})
    assert found.focal("other", 1.0) == pytest.approx(1.1)
    node = {"_target_": "x"}
    record = ModelRecord(node, node, None, 0.1, 100.0, 32, 64, intrinsics=found)
    assert ModelRecord.from_plain(record.to_plain()) == record
    for pair in ([0.6], [0.6, 0.0], [0.6, "1"], [0.6, float("nan")], 0.6):
        with pytest.raises(CheckpointError, match=r"focal length|model record's a is"):
            ModelRecord.from_plain({**record.to_plain(), "intrinsics": {"mode": "refined", "focals": {"a": pair}}})


class Said(DriveProxy):
    """A recording whose focal length is said wrong by a factor."""

    factor = 1.0

    def intrinsics(self, index: int) -> NDArray[np.float64]:
        return super().intrinsics(index) @ np.diag([self.factor, self.factor, 1.0])


class Bends(DepthDataModule):
    """A winding street, with exact depth and motion."""

    factor = 1.0

    def select(self, split: str) -> Sequence[Selection]:
        drive = Said(Winding(seed=3, frames=14, height=self.height, width=self.width))
        drive.factor = self.factor
        return [Selection(drive, drive.indices)]


class Exact(nn.Module):
    """The truth, in place of a network."""

    answer: Any = None

    def forward(self, *_: Any) -> Any:
        return self.answer


@pytest.mark.parametrize(("mode", "factor"), [("refined", 1.1), ("refined", 1 / 1.1), ("learned", 1.0)])
def test_a_wrong_focal_length_moves_towards_the_truth(mode: str, factor: float) -> None:
    """Depth and motion are exact: 80 steps take a focal length that is 10 % off, or a guess, to within 2 %."""
    data = Bends(
        height=64, width=160, batch_size=6, workers=0, with_pose=True, target_depth=True, color_jitter_prob=0.0
    )
    data.factor = factor
    data.setup("fit")
    drive = data.datasets["train"].drives[0]
    assert drive.intrinsics(0)[0, 0] == pytest.approx(0.58 * 160 * factor)
    depth, pose = Exact(), Exact()
    model = SelfSupervisedDepth(depth, pose, objectives.build("saunet"))
    model.intrinsics = focals = focal_lengths(mode, data)
    assert focals is not None
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-3)
    before = abs(float((focals.start - np.log(0.58)).abs()))
    steps = 0
    while steps < 80:
        for raw in data.train_dataloader():
            batch = data.augment(raw)
            z = torch.where(batch["target_depth"] > 0, batch["target_depth"], 1e3)
            depth.answer = DepthPyramid((1 / z,), (1 / z,), (z,))
            pose.answer = batch["T_src_tgt"]
            optimizer.zero_grad()
            model.step(batch)[3].total.backward()
            optimizer.step()
            steps += 1
    found = focals.found(focals.change).focals[drive.name][1]
    print(f"{mode}: from {before:.3f} to {abs(np.log(found / 0.58)):.4f} (logarithm)")
    assert before > 0.09
    assert found == pytest.approx(0.58, rel=0.02)


def test_a_training_says_what_it_found_keeps_it_and_resumes(
    config: dict[str, Any], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    data = dict(saunet.Spec.of("data", "synthetic_tiny", frames_per_drive=5, workers=0).node)
    config |= {"data": data, "output_dir": str(tmp_path / "run"), "logger": {}, "callbacks": None}
    config["model"]["intrinsics"] = "learned"
    config["trainer"] = {"accelerator": "cpu", "max_epochs": 1, "limit_val_batches": 1}
    with caplog.at_level("INFO"):
        result = train(train_options(config))
    assert "focal lengths, given -> learned" in caplog.text
    assert result.model.intrinsics is not None
    last = read_checkpoint(tmp_path / "run" / "checkpoints" / "last.ckpt")
    found = last.record.intrinsics
    assert found == result.model.found_intrinsics()
    (name,) = found.focals
    given, now = found.focals[name]
    assert given == pytest.approx(0.58, rel=1e-6)
    assert now == pytest.approx(GUESS, rel=0.05)
    assert now != pytest.approx(GUESS, rel=1e-6)  # it learned
    assert json.loads((tmp_path / "run" / "run.json").read_text())["intrinsics"]["focals"] == {name: [given, now]}
    store_scale(last.path, Scale(2.0, "a test"))
    write_image(tmp_path / "image.png", np.zeros((40, 200, 3), np.uint8))
    paths = {"checkpoint": str(last.path), "input": str(tmp_path / "image.png"), "output": str(tmp_path / "out")}
    saunet.predict(saunet.PredictOptions(**paths, outputs=["pairs"], camera="checkpoint"))
    (camera,) = (tmp_path / "out").rglob("camera.yaml")
    np.testing.assert_allclose(read_camera(camera).K, [[200 * now, 0, 99.5], [0, 200 * now, 19.5], [0, 0, 1]])
    assert public_record(last.record).intrinsics == Intrinsics("learned", {"mean": (given, now)})
    again = {**config, "resume": "auto", "trainer": {**config["trainer"], "max_epochs": 2}}
    further = train(train_options(again)).model.found_intrinsics().focals[name][1]
    assert further != now
    config["model"]["intrinsics"] = "fixed"
    with pytest.raises(CheckpointError, match=r"model\.intrinsics=learned but this run has fixed"):
        train(train_options(again | {"model": config["model"]}))


def test_a_stereo_pair_alone_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"model\.intrinsics=refined needs neighbors in time"):
        focal_lengths("refined", Bends(offsets=[], stereo=True))
    with pytest.raises(ConfigError, match=r"model\.intrinsics=learned and data\.track_motion=true cannot be combined"):
        focal_lengths("learned", Bends(track_motion=True))
    with pytest.raises(ConfigError, match=r"model\.intrinsics"):
        train_options({"model": {"encoder": {}, "decoder": {}, "intrinsics": "free"}})
