"""A small file cannot ask for a large network: what a record asks for is bounded before anything is built."""

from __future__ import annotations

import json
import os
import resource
import signal
import time
from pathlib import Path
from typing import Any

import pytest
import torch
from tiny_checkpoint import write_checkpoint

from saunet.errors import CheckpointError, ConfigError
from saunet.registry import decoders, encoders, poses
from saunet.runs.checkpoint import atomic_save, read_checkpoint
from saunet.runs.record import LIMIT_FACTOR, MAX_NUMBER, ModelRecord
from saunet.training.callbacks import BestCheckpoint, LastCheckpoint
from saunet.weights.files import read_model


@pytest.fixture
def content(tmp_path: Path) -> dict[str, Any]:
    write_checkpoint(tmp_path / "x.ckpt", 32, 64)
    return dict(torch.load(tmp_path / "x.ckpt", weights_only=True))


def changed(content: dict[str, Any], slot: str, **changes: Any) -> dict[str, Any]:
    plain = content["saunet"]
    return {**plain, "model": {**plain["model"], slot: {**plain["model"][slot], **changes}}}


def test_more_pixels_than_any_network_needs(content: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    plain = {**content["saunet"], "height": 1 << 13, "width": 1 << 12}
    with pytest.raises(CheckpointError, match=rf"8192x4096.*16,777,216 pixels.*{LIMIT_FACTOR}"):
        ModelRecord.from_plain(plain)
    monkeypatch.setenv(LIMIT_FACTOR, "2")
    assert ModelRecord.from_plain(plain).height == 8192


@pytest.mark.parametrize("text", ["much", "0", "-1", "nan", "inf"])
def test_a_factor_that_is_none(text: str, content: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(LIMIT_FACTOR, text)
    with pytest.raises(ConfigError, match=LIMIT_FACTOR):
        ModelRecord.from_plain(content["saunet"])


@pytest.mark.parametrize("value", [MAX_NUMBER + 1, -(10**9), [2, [10**6]], {"deep": 10**12}])
def test_numbers_out_of_proportion(content: dict[str, Any], value: Any) -> None:
    with pytest.raises(CheckpointError, match=rf"encoder asks for .*{LIMIT_FACTOR}"):
        ModelRecord.from_plain(changed(content, "encoder", depth=value))


def test_values_without_end(content: dict[str, Any]) -> None:
    several: Any = [0]
    for _ in range(40):
        several = [several] * 10  # small in the file, endless for whoever walks through it
    nested: Any = 1
    for _ in range(100):
        nested = [nested]
    begin = time.process_time()
    for value, words in (
        (several, "values"),
        (nested, "levels of nesting"),
        (10**500, "bits"),
        ("x" * 100_000, "100,000 characters"),
        (torch.zeros(2), "not plain data"),
        ({1: 2}, "not plain data"),
    ):
        with pytest.raises(CheckpointError, match=words):
            ModelRecord.from_plain({**content["saunet"], "data": {"x": value}})
    assert time.process_time() - begin < 5


def test_a_network_is_no_larger_than_the_weights_of_its_file(content: dict[str, Any], tmp_path: Path) -> None:
    """Wide layers pass the check of single numbers; their product does not."""
    node = {"_target_": "saunet.models.encoders.stratified.StratifiedTransformer", "dim": 8192}
    plain = changed(content, "encoder")
    plain["model"]["encoder"] = {**node, "depths": [2, 2, 6, 2], "heads": [1, 2, 4, 8]}
    atomic_save({**content, "saunet": plain}, tmp_path / "large.ckpt")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(CheckpointError, match=r"large.ckpt: .*more than .* numbers.*what the file holds"):
        read_checkpoint(tmp_path / "large.ckpt").networks()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300 * 1024
    exported = tmp_path / "exported"
    exported.mkdir()
    from safetensors.torch import save_file

    save_file({"depth.a": torch.ones(2)}, exported / "model.safetensors")
    (exported / "config.json").write_text(json.dumps(plain))
    with pytest.raises(CheckpointError, match="what the file holds"):
        read_model(exported).networks()


@pytest.mark.parametrize("changes", [{"depths": [2, 1, 1, 20_000]}, {"window": [8000, 4, 4, 4]}])
def test_neither_many_small_layers_nor_tables_fill_memory(
    changes: dict[str, Any], content: dict[str, Any], tmp_path: Path
) -> None:
    """Layers take memory without weights, and a table is filled before it becomes a parameter."""
    node = {"_target_": "saunet.models.encoders.stratified.StratifiedTransformer", "dim": 8, "heads": [1, 1, 2, 2]}
    plain = changed(content, "encoder")
    plain["model"]["encoder"] = {**node, "depths": [2, 1, 1, 1], "window": [4, 4, 4, 4], **changes}
    atomic_save({**content, "saunet": plain}, tmp_path / "x.ckpt")
    before, begin = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    with pytest.raises(CheckpointError, match="what the file holds"):
        read_checkpoint(tmp_path / "x.ckpt").networks()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300 * 1024
    assert time.process_time() - begin < 10


def test_whoever_trusts_a_file_allows_a_larger_network(
    content: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    atomic_save(content, tmp_path / "x.ckpt")
    monkeypatch.setenv(LIMIT_FACTOR, "0.02")
    with pytest.raises(CheckpointError, match=f"several times what the file holds.*{LIMIT_FACTOR}"):
        read_checkpoint(tmp_path / "x.ckpt").networks()
    monkeypatch.setenv(LIMIT_FACTOR, "1")
    read_checkpoint(tmp_path / "x.ckpt").networks()


def test_a_tensor_that_claims_more_than_it_stores_counts_for_what_it_stores(
    content: dict[str, Any], tmp_path: Path
) -> None:
    plain = changed(content, "encoder")
    plain["model"]["encoder"] = {
        "_target_": "saunet.models.encoders.stratified.StratifiedTransformer",
        "dim": 8192,
        "heads": [1, 2, 4, 8],
    }
    state = {**content["state_dict"], "depth.x": torch.ones(1).expand(1 << 40)}
    torch.save({**content, "saunet": plain, "state_dict": state}, tmp_path / "x.ckpt")
    with pytest.raises(CheckpointError, match="what the file holds"):
        read_checkpoint(tmp_path / "x.ckpt").networks()


def _presets() -> list[tuple[str, str, str]]:
    """Return slot, component and parameter for every whole number among the settings of networks."""
    found = []
    for slot, registry in (("encoder", encoders), ("decoder", decoders), ("pose", poses)):
        for entry in registry:
            for key in registry.node(entry.name).keys:
                number = key.default[0] if isinstance(key.default, list | tuple) and key.default else key.default
                if isinstance(number, int) and not isinstance(number, bool):
                    found.append((slot, entry.name, key.name))
    return found


@pytest.mark.slow
def test_no_number_of_any_preset_costs_gigabytes_or_minutes(content: dict[str, Any], tmp_path: Path) -> None:
    """Each number at its limit: refused or built in a process of 6 GB within 60 s of computing."""
    presets, wrong = _presets(), []
    assert len(presets) > 20
    for slot, name, key in presets:
        entry = {"encoder": encoders, "decoder": decoders, "pose": poses}[slot].entry(name)
        node = {"_target_": entry.path, **entry.preset}
        default = {
            each.name: each.default
            for each in {"encoder": encoders, "decoder": decoders, "pose": poses}[slot].node(name).keys
        }[key]
        node[key] = [MAX_NUMBER] * len(default) if isinstance(default, list | tuple) else MAX_NUMBER
        plain = changed(content, slot)
        plain["model"][slot] = node
        atomic_save({**content, "saunet": plain}, tmp_path / "x.ckpt")
        pid = os.fork()
        if pid == 0:
            resource.setrlimit(resource.RLIMIT_CPU, (60, 60))
            resource.setrlimit(resource.RLIMIT_DATA, (6 << 30, 6 << 30))
            try:
                read_checkpoint(tmp_path / "x.ckpt").networks()
            except CheckpointError:
                os._exit(0)
            except BaseException:
                os._exit(1)
            os._exit(0)
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        if code:
            wrong.append((slot, name, key, signal.Signals(-code).name if code < 0 else code))
    assert wrong == []


def test_the_last_checkpoint_follows_no_recorded_path(tmp_path: Path) -> None:
    """Lightning removes the recorded one after the next save; as ``local://...`` that was any folder."""
    callback = LastCheckpoint(str(tmp_path / "checkpoints"))
    state = callback.state_dict()
    callback.load_state_dict({**state, "best_model_path": f"local://{tmp_path}/elsewhere", "last_model_path": "x"})
    assert (callback.best_model_path, callback.last_model_path) == ("", "")


def test_the_best_checkpoint_is_looked_for_beside_the_resumed_one_only(tmp_path: Path) -> None:
    """A foreign file may name any path: it is not read, copied or replaced."""
    secret = tmp_path / "elsewhere" / "secret"
    secret.parent.mkdir()
    secret.write_text("private")
    own = tmp_path / "run" / "checkpoints"
    own.mkdir(parents=True)
    callback = BestCheckpoint(str(own))
    state = callback.state_dict()
    state |= {"best_model_path": str(secret), "best_model_score": torch.tensor(0.1), "dirpath": str(secret.parent)}
    callback.load_state_dict(state)
    assert secret.read_text() == "private"
    assert str(secret) not in (callback.best_model_path, *callback.best_k_models, callback.kth_best_model_path)
    assert list(own.iterdir()) == []
    assert Path(str(callback.dirpath)) == own
