"""The monitors: what they measure, and what they say of a training that goes wrong."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import tiny
import torch
from lightning import Callback

from saunet.data.loading.windows import Selection
from saunet.errors import ConfigError
from saunet.geometry.pose import pose_matrix
from saunet.registry import objectives
from saunet.runs.folder import RunRecord
from saunet.training.health import HealthMonitor, doubt, health, holes
from saunet.training.optim import Recipe
from saunet.training.pace import LoaderMonitor, Loading, Pace, first_change, sentence
from saunet.types import DepthPyramid, LossTerms


def pyramid(disparity: torch.Tensor) -> DepthPyramid:
    return DepthPyramid((disparity,), (disparity,), (1 / disparity,))


def test_sky_is_no_hole_and_a_far_patch_in_a_car_is() -> None:
    far = torch.zeros(1, 1, 10, 10, dtype=torch.bool)
    far[..., :3, :] = True
    assert float(holes(far)) == 0
    far[..., 6:8, 4:9] = True
    assert float(holes(far)) == pytest.approx(0.1)


def test_the_figures_of_a_step() -> None:
    ramp = torch.linspace(0.1, 0.3, 8)[:, None].expand(8, 6)[None, None]
    poses = pose_matrix(torch.tensor([[[0, 0.2, 0]]]), torch.tensor([[[3.0, 0, 4]]]))
    mask = torch.zeros(1, 1, 8, 6)
    mask[..., :2, :] = 1
    terms = LossTerms(torch.tensor(1.0), {}, {"automask": mask})
    figures = {name: float(value) for name, value in health(pyramid(ramp), poses, terms, 100.0).items()}
    assert figures == pytest.approx(
        {
            "disparity_spread": float(ramp.std() / ramp.mean()),
            "holes": 0.0,
            "translation": 5.0,
            "rotation": 0.2,
            "automask": 0.25,
        },
        abs=1e-5,
    )
    assert float(health(pyramid(torch.full((1, 1, 4, 4), 0.3)), poses, terms, 100.0)["disparity_spread"]) < 1e-6


@pytest.mark.parametrize(
    ("figure", "value", "words"),
    [
        ("disparity_spread", 0.001, "depth has collapsed"),
        ("holes", 0.2, "20.0% of the pixels are holes"),
        ("automask", 0.01, "only 1.0% of the pixels are used"),
        ("translation", 1e-9, "the pose network has collapsed"),
        ("rotation", 1.0, "turns by 1.00 rad"),
        ("automask", 1.0, "drops almost no pixel (100.00% are used)"),
        ("loss", 1e-6, "the loss is nearly zero (1.0e-06)"),
        ("disparity_spread", float("nan"), "is not a number"),
    ],
)
def test_each_sickness_is_said_once(figure: str, value: float, words: str) -> None:
    healthy = {"disparity_spread": 0.5, "holes": 0.0, "automask": 0.5, "translation": 0.1, "rotation": 0.0}
    monitor = HealthMonitor()
    assert monitor.judge(healthy) == []
    (said,) = monitor.judge({**healthy, figure: value})
    assert words in said
    assert monitor.judge({**healthy, figure: value}) == []


def test_it_speaks_while_training(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    monitor = HealthMonitor(every_n_steps=2, after=2, spread=1e9)
    trainer = tiny.tiny_trainer(tmp_path, max_epochs=1, limit_val_batches=0, callbacks=[monitor], log_every_n_steps=1)
    with caplog.at_level("INFO"):
        trainer.fit(tiny.tiny_model(), tiny.tiny_walls())
    (said,) = [record.getMessage() for record in caplog.records if "collapsed" in record.getMessage()]
    assert said.startswith("step 2: disparity is nearly flat")


def test_the_figures_are_logged_while_training(tmp_path: Path) -> None:
    trainer = tiny.tiny_trainer(tmp_path, max_epochs=1, limit_train_batches=1, callbacks=[HealthMonitor()])
    trainer.fit(tiny.tiny_model(), tiny.tiny_walls())
    names = {"disparity_spread", "holes", "automask", "translation", "rotation"}
    assert {f"health/{name}" for name in names} <= trainer.callback_metrics.keys()


def test_small_rotations_are_measured() -> None:
    poses = pose_matrix(torch.tensor([[[0, 1e-5, 0]]]), torch.zeros(1, 1, 3))
    terms = LossTerms(torch.tensor(1.0), {}, {})
    figures = health(pyramid(torch.rand(1, 1, 4, 4) + 0.1), poses, terms, 100.0)
    assert float(figures["rotation"]) == pytest.approx(1e-5, rel=1e-3)


class Doubled(tiny.Wall):
    """A wall whose frames are all the same: nothing moves."""

    def image(self, index: int) -> Any:
        return super().image(0)


class DoubledWalls(tiny.TinyWalls):
    def select(self, split: str) -> Any:
        return [Selection(Doubled(f"{split} 1"), range(8))]


class Holed(tiny.TinyDepth):
    """Depth with a hole at the far limit below something near."""

    def forward(self, image: torch.Tensor) -> DepthPyramid:
        near = super().forward(image)
        disparity = near.disparity[0].clone()
        disparity[..., 16:, 8:40] = 0.01  # of a limit of 100
        return DepthPyramid(near.sigmoid, (disparity,), (1 / disparity,))


def flat(model: Any) -> None:
    torch.nn.init.zeros_(model.depth.decoder.weight)


def frozen(model: Any) -> None:
    torch.nn.init.zeros_(model.pose.layer.weight)
    torch.nn.init.zeros_(model.pose.layer.bias)


def turning(model: Any) -> None:
    torch.nn.init.constant_(model.pose.layer.bias, 100.0)


def holed(model: Any) -> None:
    model.depth = Holed()


def photometric_alone(model: Any) -> None:
    model.objective = objectives.build("saunet", beta=0.0)


@pytest.mark.parametrize(
    ("sicken", "data", "freeze", "figures"),
    [
        (flat, tiny.TinyWalls, ["depth.decoder"], {"disparity_spread"}),
        (frozen, tiny.TinyWalls, ["pose"], {"translation"}),
        (turning, tiny.TinyWalls, ["pose"], {"rotation"}),
        (holed, tiny.TinyWalls, [], {"holes"}),
        (photometric_alone, DoubledWalls, [], {"automask", "loss"}),
    ],
    ids=["flat", "frozen pose", "turning pose", "holes", "doubled frames"],
)
def test_a_training_that_is_really_sick_says_so_in_its_record(
    sicken: Any, data: Any, freeze: list[str], figures: set[str], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    model = tiny.tiny_model(Recipe(lr=1e-3, freeze=freeze))
    sicken(model)
    model.run_record = RunRecord(tmp_path, "sick")
    model.run_record.start()
    monitor = HealthMonitor(every_n_steps=1, after=2)
    trainer = tiny.tiny_trainer(tmp_path, max_epochs=3, limit_val_batches=0, callbacks=[monitor], log_every_n_steps=1)
    with caplog.at_level("INFO"):
        trainer.fit(model, data(height=32, width=48, batch_size=2, workers=0))
    found = json.loads((tmp_path / "run.json").read_text())["health"]
    assert figures <= found.keys()
    assert all(sentence in caplog.text for sentence in found.values())


@pytest.mark.parametrize(
    ("figures", "words"),
    [
        ({"automask": 0.005, "rotation": 0.0}, ["0.5% of the pixels"]),
        ({"automask": 0.5, "rotation": 0.8}, ["0.80 rad"]),
        ({"automask": 0.005, "rotation": 0.8}, ["0.5% of the pixels", "0.80 rad"]),
        ({"automask": 0.5, "rotation": 0.01}, None),
        ({}, None),
    ],
)
def test_a_loss_of_few_pixels_or_a_spinning_camera_says_little(figures: Any, words: list[str] | None) -> None:
    said = doubt(figures)
    assert (said is None) == (words is None)
    assert all(word in str(said) for word in words or ())


@pytest.mark.parametrize(("sicken", "marks"), [(turning, 1), (lambda model: None, 0)])
def test_a_short_training_says_that_its_loss_means_little(
    sicken: Any, marks: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    model = tiny.tiny_model(Recipe(lr=1e-3, freeze=["pose"]))
    sicken(model)
    model.run_record = RunRecord(tmp_path, "short")
    model.run_record.start()
    monitor = HealthMonitor(automask=0.0)  # of fresh networks
    trainer = tiny.tiny_trainer(tmp_path, max_steps=10, limit_val_batches=0, callbacks=[monitor])
    with caplog.at_level("INFO"):
        trainer.fit(model, tiny.tiny_walls())
    found = json.loads((tmp_path / "run.json").read_text())["health"]
    assert list(found) == ["loss"] * marks
    assert caplog.text.count("the loss says little about this training: the predicted camera turns by") == marks


def test_a_healthy_training_has_no_marks(tmp_path: Path) -> None:
    model = tiny.tiny_model(Recipe(lr=1e-3))
    model.run_record = RunRecord(tmp_path, "well")
    model.run_record.start()
    monitor = HealthMonitor(every_n_steps=1, after=1, automask=0.0)  # fresh networks are masked
    trainer = tiny.tiny_trainer(tmp_path, max_epochs=2, limit_val_batches=0, callbacks=[monitor], log_every_n_steps=1)
    trainer.fit(model, tiny.tiny_walls())
    assert json.loads((tmp_path / "run.json").read_text())["health"] == {}


def test_thresholds_are_checked() -> None:
    with pytest.raises(ConfigError, match=r"holes is 2\.0; it must lie between 0 and 1"):
        HealthMonitor(holes=2.0)


def test_loading_figures() -> None:
    loading = Loading(images=360, seconds=10.0, waited=4.0)
    assert (loading.reached, loading.needed, loading.share) == pytest.approx((36.0, 60.0, 0.4))


@pytest.mark.parametrize(("cacheable", "cached"), [(True, False), (True, True), (False, False)])
def test_copies_are_advised_where_the_data_can_be_read_from_them(
    cacheable: bool, cached: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer, data = tiny.tiny_trainer(tmp_path), tiny.tiny_walls()
    data.cacheable = cacheable
    if cached:
        monkeypatch.setattr(data, "copies", object())
    monkeypatch.setattr(trainer, "datamodule", data, raising=False)
    monkeypatch.setattr("saunet.training.pace.available_cores", lambda: 0)
    said = sentence(Loading(images=360, seconds=10.0, waited=4.0), trainer)
    assert ("with saunet prepare cache" in said) == (cacheable and not cached)
    assert ("use a faster disk or more cores" in said) == (not cacheable or cached)


@pytest.mark.parametrize(
    ("waiting", "augment", "given", "change"),
    [
        (0.5, 0.0, {"workers": 1}, "data.workers=2 (now 1)"),
        (0.9, 0.0, {"workers": 2}, "data.workers=4 (now 2)"),
        (0.5, 0.0, {"workers": 4}, "saunet prepare cache"),
        (0.5, 0.0, {"workers": 4, "cacheable": False}, "no setting helps"),
        (0.0, 0.5, {}, "color_jitter_prob=0"),
        (0.0, 0.1, {"device": "cuda"}, "trainer.precision=bf16-mixed"),
        (0.0, 0.1, {"device": "cuda", "precision": "bf16-mixed"}, "speed.compile=true"),
        (0.0, 0.1, {"device": "cuda", "precision": "bf16-mixed", "compiled": True}, "the networks set the pace"),
        (0.0, 0.1, {}, "the networks set the pace"),
    ],
)
def test_the_setting_that_gains_most(
    waiting: float, augment: float, given: dict[str, Any], change: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("saunet.training.pace.available_cores", lambda: 4)
    usual: dict[str, Any] = {"workers": 0, "cacheable": True, "device": "cpu", "precision": "32-true"}
    pace = Pace(step=1.0, waiting=waiting, augment=augment, decode=0.4, rest=0.1)
    assert f"{waiting:.0%} waiting" in str(pace)
    assert change in first_change(pace, share=0.1, **{**usual, "compiled": False, **given})


@pytest.mark.parametrize(("slow", "epochs", "every"), [(True, 1, 2), (False, 1, 2), (True, 2, 4), (True, 3, 5)])
def test_a_slow_loader_is_named_with_its_figures_and_a_fast_one_is_not(
    slow: bool,
    epochs: int,
    every: int,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = [0.0]  # a clock of our own: a busy machine must not decide this test
    monkeypatch.setattr("saunet.data.loading.sampling.time.perf_counter", lambda: clock[0])
    monkeypatch.setattr("saunet.training.pace.time.monotonic", lambda: clock[0])
    monkeypatch.setattr("saunet.training.pace._ENOUGH", 1)
    monkeypatch.setattr("saunet.training.pace.available_cores", lambda: 3)
    image = tiny.Wall.image

    def read(self: Any, index: int) -> Any:
        clock[0] += 0.01 if slow else 0.0
        return image(self, index)

    class Clocked(tiny.TinyDepth):
        def forward(self, image: torch.Tensor) -> DepthPyramid:
            clock[0] += 0.04
            return super().forward(image)

    class Pause(Callback):
        def on_train_epoch_end(self, *_: Any) -> None:
            clock[0] += 100.0  # validation and checkpoints, which the loader cannot help

    monkeypatch.setattr(tiny.Wall, "image", read)
    model = tiny.tiny_model()
    model.depth = Clocked()
    callbacks = [LoaderMonitor(every_n_steps=every), Pause()]
    trainer = tiny.tiny_trainer(
        tmp_path, max_epochs=epochs, limit_val_batches=0, callbacks=callbacks, log_every_n_steps=1
    )
    with caplog.at_level("INFO"):
        trainer.fit(model, tiny.tiny_walls())
    said = [record.getMessage() for record in caplog.records if "bottleneck" in record.getMessage()]
    (pace,) = [record.getMessage() for record in caplog.records if "to make it faster" in record.getMessage()]
    assert f"{75 if slow else 0}% waiting" in pace
    assert ("data.workers=3 (now 0)" if slow else "the networks set the pace") in pace
    # four samples of three images: 0.12 s to load, 0.04 s to use
    assert trainer.callback_metrics["loader/share"] == pytest.approx(0.75 if slow else 0.0, abs=0.01)
    assert trainer.callback_metrics["loader/images_per_second"] == pytest.approx(75 if slow else 300, rel=0.01)
    assert len(said) == slow
    if slow:
        assert "75 images/s arrive and the model could use 300 (75% of the time" in said[0]
        assert "raise data.workers (now 0" in said[0]
        assert "load smaller copies made once with saunet prepare cache" in said[0]
