"""A run that is killed or asked to stop goes on as if nothing had happened."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import tiny
import torch
from lightning import Callback, LightningModule, Trainer
from processes import python
from training_options import train_options

from saunet.errors import CheckpointError, ConfigError
from saunet.exporting.box import pack
from saunet.runs.checkpoint import atomic_save, read_checkpoint
from saunet.runs.folder import Stopped
from saunet.training.callbacks import LastCheckpoint
from saunet.training.optim import Recipe
from saunet.training.resume import changes, check_resume, resume_path, stretched, warm_start
from saunet.training.stopping import GracefulStop
from saunet.training.tool import assemble
from saunet.weights import locate

EPOCHS = 3
BATCHES = 18  # twelve windows in batches of two, three epochs; two batches a step


def same(left: Path, right: Path) -> None:
    one, other = (torch.load(folder / "end.pt", weights_only=True) for folder in (left, right))
    assert one.keys() == other.keys()
    different = [name for name in one if not torch.equal(one[name], other[name])]
    assert different == []


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the uninterrupted training."""
    folder = tmp_path_factory.mktemp("whole")
    tiny.main(folder, EPOCHS)
    return folder


def test_killed_at_a_random_step_and_resumed_it_equals_the_uninterrupted_run(whole: Path, tmp_path: Path) -> None:
    strike = random.randrange(3, BATCHES - 1)  # a different one every time: any must do
    command = [sys.executable, str(Path(tiny.__file__)), str(tmp_path), str(EPOCHS)]
    environment = {**os.environ, "OMP_NUM_THREADS": str(torch.get_num_threads())}  # sums in the order of this process
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=1, text=True, env=environment
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        for line in process.stdout:
            if line.startswith("batch"):
                process.stdin.write("go on\n")  # the blow falls somewhere before the end of the next batch
                if int(line.split()[-1]) >= strike:
                    process.kill()
                    break
    assert process.returncode == -signal.SIGKILL
    assert not (tmp_path / "end.pt").exists()
    tiny.main(tmp_path, EPOCHS, str(tmp_path / "last.ckpt"))
    same(whole, tmp_path)


class Ask(Callback):
    """Ask the process to stop during a batch."""

    def __init__(self, batch: int, number: int = signal.SIGTERM) -> None:
        self.batch, self.number = batch, number

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        if trainer.fit_loop.total_batch_idx + 1 == self.batch:
            os.kill(os.getpid(), self.number)


@pytest.mark.parametrize("batch", [6, 8])  # the middle of an accumulation, the end of an epoch
def test_asked_to_stop_it_saves_and_says_how_to_go_on(batch: int, whole: Path, tmp_path: Path) -> None:
    handler = signal.getsignal(signal.SIGTERM)
    callbacks = [Ask(batch), GracefulStop(str(tmp_path)), LastCheckpoint(str(tmp_path))]
    trainer = tiny.tiny_trainer(
        tmp_path, max_epochs=EPOCHS, callbacks=callbacks, accumulate_grad_batches=2, gradient_clip_val=1.0
    )
    with pytest.raises(Stopped, match=r"stopped by SIGTERM after step \d+, .*resume with resume=.*last.ckpt") as stop:
        trainer.fit(tiny.tiny_model(tiny.RECIPE), tiny.tiny_walls(batch_size=2))
    assert stop.value.code == 143
    assert trainer.global_step < BATCHES // 2
    assert signal.getsignal(signal.SIGTERM) == handler
    tiny.main(tmp_path, EPOCHS, str(tmp_path / "last.ckpt"))
    same(whole, tmp_path)


@pytest.mark.parametrize("name", ["SIGHUP", "SIGUSR1"])
def test_a_closed_terminal_and_a_batch_systems_warning_stop_it_too(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SLURM_JOB_ID", "1")  # SIGUSR1 is a warning there only
    number = signal.Signals[name]
    before = signal.signal(number, signal.SIG_DFL)
    trainer = tiny.tiny_trainer(tmp_path, max_epochs=2, callbacks=[Ask(2, number), GracefulStop(str(tmp_path))])
    try:
        with pytest.raises(Stopped, match=rf"stopped by {name} after step 2") as stop:
            trainer.fit(tiny.tiny_model(), tiny.tiny_walls())
    finally:
        assert signal.signal(number, before) == signal.SIG_DFL
    assert stop.value.code == 128 + number
    assert torch.load(tmp_path / "last.ckpt", weights_only=True)["global_step"] == 2


def test_a_training_under_nohup_outlives_its_terminal(tmp_path: Path) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    trainer = tiny.tiny_trainer(tmp_path, max_epochs=1, callbacks=[Ask(1, signal.SIGHUP), GracefulStop(str(tmp_path))])
    try:
        trainer.fit(tiny.tiny_model(), tiny.tiny_walls())
    finally:
        signal.signal(signal.SIGHUP, before)
    assert trainer.global_step == 3


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda stored: stored.pop("loops"), "no loop state"),
        (lambda stored: stored.pop("optimizer_states"), "no optimizer state"),
        (lambda stored: stored["optimizer_states"][0]["state"].clear(), r"no optimizer state \(it is empty\)"),
        (lambda stored: [stored.pop(key) for key in ("loops", "optimizer_states", "lr_schedulers")], "weights only"),
    ],
)
def test_what_lacks_the_state_of_a_training_is_not_resumed(
    spoil: Any, words: str, config: dict[str, Any], walls: Any, tmp_path: Path
) -> None:
    few = {"max_epochs": 1, "limit_train_batches": 1, "limit_val_batches": 0}
    model = assemble(train_options(config), walls)
    tiny.tiny_trainer(tmp_path, **few, callbacks=[LastCheckpoint(str(tmp_path))]).fit(model, walls)
    last = tmp_path / "last.ckpt"
    assert check_resume(model, read_checkpoint(last), walls) == 1
    stored = torch.load(last, weights_only=True)
    spoil(stored)
    torch.save(stored, last)
    with pytest.raises(CheckpointError, match=rf"{words}.*init_from="):
        check_resume(model, read_checkpoint(last), walls)


def test_a_second_interrupt_ends_at_once(tmp_path: Path) -> None:
    stop = GracefulStop(str(tmp_path))
    stop._receive(signal.SIGINT, None)
    with pytest.raises(KeyboardInterrupt):
        stop._receive(signal.SIGINT, None)


def test_the_first_process_alone_answers_ctrl_c(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    GracefulStop(str(tmp_path))._receive(signal.SIGINT, None)
    assert capsys.readouterr().err.count("SIGINT: finishing the step") == 1
    monkeypatch.setenv("LOCAL_RANK", "1")
    other = GracefulStop(str(tmp_path))
    other._receive(signal.SIGINT, None)
    assert other.received == signal.SIGINT
    forked = GracefulStop(str(tmp_path))
    monkeypatch.setattr("os.getpid", lambda: -1)
    forked._receive(signal.SIGINT, None)
    assert forked.received is None
    assert not capsys.readouterr().err


def test_a_changed_rate_is_not_kept_in_silence(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    last = [LastCheckpoint(str(tmp_path))]
    first = tiny.tiny_trainer(tmp_path, max_epochs=1, callbacks=last)
    first.fit(tiny.tiny_model(Recipe(lr=1e-2)), tiny.tiny_walls())
    changed = tiny.tiny_model(Recipe(lr=5e-3, schedule="constant"))
    again = tiny.tiny_trainer(tmp_path, max_epochs=2)
    with caplog.at_level("INFO"):
        again.fit(changed, tiny.tiny_walls(), ckpt_path=str(tmp_path / "last.ckpt"), weights_only=True)
    assert again.optimizers[0].param_groups[0]["lr"] == 1e-2
    (said,) = [record.getMessage() for record in caplog.records if "resumed run" in record.getMessage()]
    assert "keeps the checkpoint's optim.lr 0.01 (not 0.005)" in said
    assert "the new optim.schedule constant (it was step)" in said
    assert "start from its weights with init_from=" in said


class Rates(Callback):
    """The learning rate of each step, as it is taken."""

    def __init__(self) -> None:
        self.seen: list[float] = []

    def on_before_optimizer_step(self, trainer: Trainer, pl_module: Any, optimizer: Any) -> None:
        self.seen.append(optimizer.param_groups[0]["lr"])


def test_a_later_end_says_the_rate_and_has_it_from_the_first_step(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    recipe, rates = Recipe(lr=1e-2, schedule="cosine"), Rates()
    first = tiny.tiny_trainer(tmp_path, max_epochs=1, callbacks=[LastCheckpoint(str(tmp_path))])
    first.fit(tiny.tiny_model(recipe), tiny.tiny_walls())
    assert first.optimizers[0].param_groups[0]["lr"] == 0
    for epochs, words in ((1, ""), (2, "0.005, 50% of the highest")):
        caplog.clear()
        again = tiny.tiny_trainer(tmp_path, max_epochs=epochs, callbacks=[rates])
        with caplog.at_level("INFO"):
            again.fit(
                tiny.tiny_model(recipe), tiny.tiny_walls(), ckpt_path=str(tmp_path / "last.ckpt"), weights_only=True
            )
        said = [record.getMessage() for record in caplog.records if "learning rate" in record.getMessage()]
        assert len(said) == bool(words)
        assert words in "".join(said)
    assert rates.seen[0] == pytest.approx(5e-3)
    assert len(rates.seen) == first.global_step
    assert "init_from" not in "".join(said)


@pytest.mark.parametrize(
    ("recipe", "total", "words"),
    [
        (Recipe(schedule="cosine"), 13, "1.45e-06, 1.45% of the highest"),
        (Recipe(schedule="one_cycle", warmup=0.3), 13, "init_from=runs/a"),
        (Recipe(), 24, "a learning rate of 0.0001, 100% of the highest"),
        (Recipe(schedule="constant"), 24, None),
        (Recipe(schedule="cosine"), 12, None),
        (Recipe(schedule="cosine", warmup=0.5), 10_000, "0.26% of the highest"),
    ],
)
def test_a_low_rate_at_a_later_end_comes_with_advice(recipe: Recipe, total: int, words: str | None) -> None:
    state = {"last_epoch": 12, "base_lrs": [1e-4]}
    checkpoint = {"global_step": 12, "saunet_training": {"steps": 12}, "lr_schedulers": [state]}
    said = stretched(checkpoint, recipe, total, "runs/a/checkpoints/last.ckpt")
    if words is None:
        assert said is None
    else:
        assert said is not None
        assert words in said
        assert ("init_from=runs/a and" in said) == (total == 13)  # not where it rises
    assert stretched({**checkpoint, "saunet_training": {}}, recipe, total, None) is None


def test_an_optimizer_that_does_not_fit_is_refused() -> None:
    before = Recipe().to_plain()
    assert Recipe().resumed_from(before) is None
    for changed in (Recipe(optimizer="adamw"), Recipe(freeze=["pose"]), Recipe(encoder_lr=1e-5)):
        with pytest.raises(ConfigError, match=r"init_from= instead of resume="):
            changed.resumed_from(before)


def test_where_a_run_resumes_from(tmp_path: Path) -> None:
    assert resume_path(None, tmp_path) is None
    assert resume_path("auto", tmp_path) is None
    last = tmp_path / "checkpoints" / "last.ckpt"
    last.parent.mkdir()
    last.touch()
    assert resume_path("auto", tmp_path) == str(last)


def test_a_warm_start_takes_what_fits_and_says_how_much(model: Any, tmp_path: Path, config: Any, walls: Any) -> None:
    with torch.no_grad():
        next(model.depth.parameters()).fill_(0.5)
    weights = {key: value for key, value in model.state_dict().items() if not key.startswith("pose.layers.0.")}
    atomic_save({"saunet": model.record, "state_dict": weights}, tmp_path / "a.ckpt")
    other = assemble(train_options(config), walls)
    said = warm_start(other, tmp_path / "a.ckpt")
    count = len(other.depth.state_dict())
    assert f"all {count} tensors of the depth network" in said
    assert f"{len(other.pose.state_dict()) - 2} of {len(other.pose.state_dict())} tensors of the pose" in said
    assert "pose network (left unchanged: layers.0.weight, not in it, and 1 more)" in said
    assert torch.equal(next(other.depth.parameters()), next(model.depth.parameters()))
    atomic_save({"saunet": model.record, "state_dict": {"depth.x": torch.zeros(1)}}, tmp_path / "b.ckpt")
    with pytest.raises(CheckpointError, match=r"no weights in .*b\.ckpt fit the depth network"):
        warm_start(other, tmp_path / "b.ckpt")


def test_a_warm_start_says_what_else_makes_depth_differ(model: Any, tmp_path: Path, config: Any, walls: Any) -> None:
    record = deepcopy(model.record)
    record["model"]["encoder"]["normalization"] = "imagenet"
    atomic_save({"saunet": record, "state_dict": model.state_dict()}, tmp_path / "a.ckpt")
    said = warm_start(model, tmp_path / "a.ckpt")
    assert (
        "its encoder has normalization imagenet but monodepth2 here, so the same weights give different depths" in said
    )


def test_a_warm_start_from_a_shipped_model(
    model: Any, tmp_path: Path, config: Any, walls: Any, node: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(locate, "BOX", tmp_path)
    atomic_save({"saunet": model.record, "state_dict": model.state_dict()}, tmp_path / "a.ckpt")
    pack(tmp_path / "a.ckpt", tmp_path / "street")
    model_config = config["model"]
    other = assemble(train_options({**config, "model": {**model_config, "max_depth": 50.0}}), walls)
    said = warm_start(other, "street")
    assert "starting from street: all " in said
    assert f"all {len(other.pose.state_dict())} tensors of the pose network" in said
    assert "max_depth is 100 but 50 here" in said
    for part in ("depth", "pose"):
        for own, theirs in zip(getattr(other, part).parameters(), getattr(model, part).parameters(), strict=True):
            assert own.dtype == torch.float32
            torch.testing.assert_close(own, theirs, rtol=1e-3, atol=1e-6)
    pose = node("pose", "efficientnet_lite0")
    options = train_options({**config, "model": {**model_config, "pose": pose}})
    said = warm_start(assemble(options, walls), "street")
    assert "it has no pose network that fits, so this training's pose network starts from fresh weights" in said


def test_a_writer_that_dies_midway_leaves_the_previous_checkpoint(tmp_path: Path) -> None:
    code = (
        "import os, sys, torch\n"
        "from saunet.runs.checkpoint import atomic_save\n"
        "path = sys.argv[1]\n"
        "atomic_save({'epoch': 1}, path)\n"
        "def die(content, stream):\n"
        "    stream.write(b'half'); stream.flush(); os._exit(9)\n"
        "torch.save = die\n"
        "atomic_save({'epoch': 2}, path)\n"
    )
    path = tmp_path / "last.ckpt"
    done = python("-c", code, str(path))
    assert done.returncode == 9
    assert torch.load(path, weights_only=True) == {"epoch": 1}


@pytest.mark.parametrize(
    ("seed", "data", "words"),
    [
        (5, {}, "with seed 0 but this run has 5"),
        (0, {"batch_size": 2}, "with data.batch_size 4 but this run has 2"),
        (0, {"offsets": (-2, 2)}, r"with training frames \(SHA-256 of their names\)"),
    ],
)
def test_a_resumed_run_sees_the_same_samples(seed: int, data: dict[str, Any], words: str, tmp_path: Path) -> None:
    first = tiny.tiny_trainer(tmp_path, max_epochs=1, callbacks=[LastCheckpoint(str(tmp_path))])
    first.fit(tiny.tiny_model(), tiny.tiny_walls())
    model = tiny.tiny_model()
    model.seed = seed
    again = tiny.tiny_trainer(tmp_path, max_epochs=2)
    with pytest.raises(CheckpointError, match=words):
        again.fit(model, tiny.tiny_walls(**data), ckpt_path=str(tmp_path / "last.ckpt"), weights_only=True)


def test_a_checkpoint_without_settings_is_resumed(tmp_path: Path) -> None:
    first = tiny.tiny_trainer(tmp_path, max_epochs=1, callbacks=[LastCheckpoint(str(tmp_path))])
    first.fit(tiny.tiny_model(), tiny.tiny_walls())
    old = torch.load(tmp_path / "last.ckpt", weights_only=True)
    del old["saunet_training"]["settings"]
    torch.save(old, tmp_path / "old.ckpt")
    again = tiny.tiny_trainer(tmp_path, max_epochs=2)
    model = tiny.tiny_model()
    model.seed = 5
    again.fit(model, tiny.tiny_walls(), ckpt_path=str(tmp_path / "old.ckpt"), weights_only=True)
    assert again.current_epoch == 2


def test_changed_networks_and_objectives_are_named(model: Any) -> None:
    before = {"objective": {"_target_": "a.Saunet", "alpha": 10.0}, "model": model.record["model"]}
    assert changes(before, before) is None
    now = {
        "objective": {"_target_": "a.Saunet", "alpha": 5.0},
        "model": {**before["model"], "pose": {**before["model"]["pose"], "_target_": "b.Other"}},
    }
    said = changes(before, now)
    assert said is not None
    assert "uses the new objective.alpha 5.0 (it was 10.0), model.pose Other (it was PoseCNN);" in said
    assert changes({"objective": {}, "model": {}}, now) is None


def test_a_changed_objective_is_not_kept_in_silence(
    config: dict[str, Any], walls: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    few = {"max_epochs": 1, "limit_train_batches": 1, "limit_val_batches": 0}
    first = tiny.tiny_trainer(tmp_path, **few, callbacks=[LastCheckpoint(str(tmp_path))])
    first.fit(assemble(train_options(config), walls), walls)
    config["objective"]["alpha"] = 3.0
    again = tiny.tiny_trainer(tmp_path, **few)
    with caplog.at_level("INFO"):
        again.fit(
            assemble(train_options(config), walls),
            walls,
            ckpt_path=str(tmp_path / "last.ckpt"),
            weights_only=True,
        )
    assert "uses the new objective.alpha 3.0 (it was 10.0)" in caplog.text
