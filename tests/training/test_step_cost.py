"""The training step computes nothing twice and never waits for the device."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import tiny
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from training_options import train_options

from saunet.data.loading.module import DepthDataModule
from saunet.losses import one_pass
from saunet.registry import objectives
from saunet.training.health import health
from saunet.training.module import SelfSupervisedDepth
from saunet.training.nonfinite import NonFinite
from saunet.training.tool import assemble

WAITS = {
    "aten._local_scalar_dense",  # .item(), bool(), float()
    "aten.nonzero",
    "aten.masked_select",
    "aten.is_nonzero",
    "aten.equal",
    "aten._unique2",
    "aten.unique_dim",
    "aten.repeat_interleave",
}


class Waits(TorchDispatchMode):
    """Count the operations that make the host wait for the device, or whose size depends on data."""

    def __init__(self) -> None:
        super().__init__()
        self.found: Counter[str] = Counter()

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = str(function).rpartition(".")[0]
        if name in WAITS:
            self.found[name] += 1
        if name in ("aten.index", "aten.index_put", "aten.index_put_"):
            indices = [index for index in args[1] if index is not None]
            self.found[f"{name} by mask"] += sum(index.dtype in (torch.bool, torch.uint8) for index in indices)
        return function(*args, **(kwargs or {}))


def test_the_counter_counts() -> None:
    with Waits() as waits:
        mask = torch.tensor([True, False])
        torch.ones(2)[mask].sum().item()
    assert waits.found["aten._local_scalar_dense"] == 1
    assert waits.found["aten.index by mask"] + waits.found["aten.nonzero"] >= 1


@pytest.mark.parametrize("objective", ["saunet", "monodepth2"])
def test_nothing_in_a_step_waits_for_the_device(objective: str, config: dict[str, Any], walls: DepthDataModule) -> None:
    model = assemble(train_options(config), walls)
    model.objective = objectives.build(objective)
    walls.setup("fit")
    loaded = next(iter(walls.train_dataloader()))
    model.train()
    with Waits() as waits:
        batch: Any = walls.on_after_batch_transfer(loaded, 0)
        pyramid, poses, _, terms = model.step(batch)
        health(pyramid, poses, terms, 100.0)
        terms.total.backward()
    assert +waits.found == Counter()


def test_watching_for_nan_does_not_wait_for_the_device(tmp_path: Path) -> None:
    class Watched(NonFinite):
        def on_before_optimizer_step(self, *args: Any) -> None:
            with waits:
                super().on_before_optimizer_step(*args)
            looked.append(len(self._pending))

    waits, looked = Waits(), list[int]()
    trainer = tiny.tiny_trainer(tmp_path, max_epochs=1, limit_val_batches=0, callbacks=[Watched(str(tmp_path))])
    trainer.fit(tiny.tiny_model(), tiny.tiny_walls())
    assert looked == [1] * 3
    assert +waits.found == Counter()


def test_identity_losses_once_and_one_comparison_a_scale(
    model: SelfSupervisedDepth, walls: DepthDataModule, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept: list[int | None] = []
    error = one_pass._Comparison.error

    def counted(self: Any, image: torch.Tensor, keep: int | None = None) -> torch.Tensor:
        kept.append(keep)
        return error(self, image, keep)

    monkeypatch.setattr(one_pass._Comparison, "error", counted)
    monkeypatch.setattr(model, "synthesize", lambda *_: pytest.fail("views are made that no term asks for"))
    monkeypatch.setattr("jaxtyping.config.jaxtyping_disable", True)  # to check the type of views, one is looked at
    walls.setup("fit")
    batch: Any = walls.on_after_batch_transfer(next(iter(walls.train_dataloader())), 0)
    _, _, views, _ = model.step(batch)
    images = len(batch["name"])
    assert len(views) == 4
    # Each image: both sources as they are, and both at each of four scales, with their gradients.
    assert kept == [None, None, *[0, 1] * 4] * images


@pytest.mark.gpu
def test_a_step_runs_under_cudas_sync_debug_mode(model: SelfSupervisedDepth, walls: DepthDataModule) -> None:
    walls.setup("fit")
    loaded: Any = next(iter(walls.train_dataloader()))
    model.cuda().train()
    walls.augment.cuda()
    on_device = {key: value.cuda() if isinstance(value, torch.Tensor) else value for key, value in loaded.items()}

    def step() -> None:
        pyramid, poses, _, terms = model.step(walls.on_after_batch_transfer(on_device, 0))  # type: ignore[arg-type]
        health(pyramid, poses, terms, 100.0)
        terms.total.backward()

    step()  # the first one may plan convolutions
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        step()
    finally:
        torch.cuda.set_sync_debug_mode("default")
