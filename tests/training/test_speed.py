"""Speed switches change no result: the same losses, gradients and statistics within rounding."""

from __future__ import annotations

import copy
import json
import os
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import tiny
import torch
from lightning import Callback, LightningModule, Trainer

import saunet
from saunet.models.depth import DepthNet
from saunet.models.layers.conv import training_format
from saunet.training.optim import Recipe
from saunet.training.speed import Speed, recomputable

STEPS = 50


class Losses(Callback):
    def __init__(self) -> None:
        self.values: list[float] = []

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, outputs: Any, *_: Any) -> None:
        self.values.append(float(outputs["loss"]))


def losses(folder: Path, precision: str = "32-true", speed: Speed | None = None, **recipe: Any) -> list[float]:
    """Return the losses of fifty steps."""
    model = tiny.tiny_model(Recipe(**{"lr": 3e-3, "schedule": "constant", **recipe}), speed, dropout=0.0)
    model.objective.terms["photometric"].noise = 0.0  # type: ignore[assignment]
    seen = Losses()
    trainer = tiny.tiny_trainer(
        folder, max_steps=STEPS, max_epochs=-1, limit_val_batches=0, precision=precision, callbacks=[seen]
    )
    trainer.fit(model, tiny.tiny_walls())
    assert len(seen.values) == STEPS
    return seen.values


@pytest.fixture(scope="module")
def exact(tmp_path_factory: pytest.TempPathFactory) -> list[float]:
    return losses(tmp_path_factory.mktemp("exact"))


def test_fifty_steps_in_bfloat16_follow_those_in_float32(exact: list[float], tmp_path: Path) -> None:
    mixed = losses(tmp_path, "bf16-mixed")
    assert exact[-1] < 0.9 * exact[0]
    assert mixed != exact
    assert mixed == pytest.approx(exact, rel=0.05)


def test_the_fused_optimizer_trains_alike(exact: list[float], tmp_path: Path) -> None:
    # Processors round differently, and fifty steps let it grow; one step is compared closely in test_optim.py.
    apart = losses(tmp_path, fused=False)  # by default it is fused on a CPU
    assert apart != exact
    assert apart == pytest.approx(exact, rel=1e-2)


def test_gradients_are_clipped_in_half_precision_before_the_default_optimizer(tmp_path: Path) -> None:
    model = tiny.tiny_model()
    trainer = tiny.tiny_trainer(
        tmp_path, max_steps=1, max_epochs=-1, limit_val_batches=0, precision="bf16-mixed", gradient_clip_val=1e-3
    )
    trainer.fit(model, tiny.tiny_walls())
    norms = [each.grad.norm() for each in model.parameters() if each.grad is not None]
    assert torch.stack(norms).norm().item() == pytest.approx(1e-3, rel=1e-2)


@pytest.fixture
def network() -> DepthNet:
    torch.manual_seed(0)
    return DepthNet(saunet.build("encoder", "resnet18"), partial(saunet.build, "decoder", "unet"))


def applied(speed: Speed, network: DepthNet, device: str = "cpu") -> None:
    holder: Any = torch.nn.Module()
    holder.depth, holder.pose, holder.objective = network, None, None
    speed.apply(holder, torch.device(device))


def test_recomputed_activations_give_the_same_gradients_and_statistics(network: DepthNet) -> None:
    twin = copy.deepcopy(network)
    applied(Speed(), network)
    applied(Speed(checkpoint_activations=True), twin)
    assert [method for _, method in recomputable(twin.encoder)] == ["begin", *["forward"] * 8]  # the residual blocks
    assert recomputable(twin.decoder) == [(twin.decoder, "level")]
    image = torch.rand(2, 3, 64, 96)
    for each in (network, twin):
        each.train()
        sum(disparity.mean() for disparity in each(image).disparity).backward()
    assert twin.state_dict().keys() == network.state_dict().keys()
    for (name, plain), (_, recomputed) in zip(network.named_parameters(), twin.named_parameters(), strict=True):
        torch.testing.assert_close(plain.grad, recomputed.grad, msg=name)
    for (name, plain), (_, recomputed) in zip(network.named_buffers(), twin.named_buffers(), strict=True):
        assert torch.equal(plain, recomputed), name
    with torch.no_grad():
        torch.testing.assert_close(network(image).depth[0], twin(image).depth[0])


@pytest.mark.parametrize(
    ("capability", "device", "expected"),
    [
        ("AVX2", "cpu", torch.contiguous_format),
        ("AVX512", "cpu", torch.channels_last),
        ("AVX2", "cuda", torch.channels_last),
    ],
)
def test_convolutions_train_in_the_memory_format_that_is_fast_there(
    capability: str, device: str, expected: torch.memory_format, network: DepthNet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: capability)
    image = torch.rand(1, 3, 64, 96)
    before = network.eval()(image).depth[0]
    applied(Speed(), network, device)
    seen = []
    for module in network.modules():
        if isinstance(module, torch.nn.Conv2d) and module.out_channels > 1:
            module.register_forward_hook(lambda _, inputs, output: seen.append(output.stride(1) == 1))
    torch.testing.assert_close(network(image).depth[0], before)
    assert set(seen) == {expected is torch.channels_last}
    assert len(seen) > 25


def test_pointwise_and_depthwise_convolutions_always_train_channels_last(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "AVX2")
    network = saunet.build("encoder", "efficientnet_lite0")
    assert training_format(network, torch.device("cpu")) is torch.channels_last


COMPILED = """
import json, sys
sys.path[:0] = [sys.argv[1], sys.argv[1] + "/../helpers"]
from pathlib import Path
import tiny, test_speed
from saunet.training.speed import Speed
folder = Path(sys.argv[2])
print(json.dumps([test_speed.losses(folder), test_speed.losses(folder, speed=Speed(compile=True))]))
"""


@pytest.mark.slow
def test_fifty_compiled_steps_follow_those_in_eager_mode(tmp_path: Path) -> None:
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "TORCHINDUCTOR_COMPILE_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", COMPILED, str(Path(__file__).parent), str(tmp_path)],
        capture_output=True,
        text=True,
        env=environment,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    eager, compiled = json.loads(done.stdout.splitlines()[-1])
    assert compiled == pytest.approx(eager, rel=0.02)
