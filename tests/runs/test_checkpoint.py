"""Checkpoints: what is stored, what is refused, and that every refusal is one clear sentence."""

from __future__ import annotations

import dataclasses
import json
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from processes import python
from torch import Tensor, nn

from saunet.errors import CheckpointError, ConfigError
from saunet.runs.checkpoint import atomic_save, build_networks, load_weights, read_checkpoint
from saunet.runs.record import ModelRecord, Scale

Node = Callable[..., dict[str, Any]]


@pytest.fixture(scope="module")
def record(node: Node) -> ModelRecord:
    return ModelRecord(
        encoder=node("encoder", "resnet18"),
        decoder=node("decoder", "unet"),
        pose=node("pose", "resnet18"),
        min_depth=0.1,
        max_depth=100.0,
        height=32,
        width=64,
        scale=Scale(31.5, "camera height 1.65 m"),
        data={"name": "synthetic", "drives": ["a", "b"]},
    )


@pytest.fixture(scope="module")
def content(record: ModelRecord) -> dict[str, Any]:
    depth, pose = build_networks(record)
    assert pose is not None
    parts = nn.ModuleDict({"depth": depth, "pose": pose})
    return {"state_dict": dict(parts.state_dict()), "saunet": record.to_plain(), "epoch": 3, "global_step": 120}


@pytest.fixture
def saved(content: dict[str, Any], tmp_path: Path) -> Path:
    atomic_save(content, tmp_path / "run" / "last.ckpt")
    return tmp_path / "run" / "last.ckpt"


def one_sentence(error: pytest.ExceptionInfo[BaseException]) -> str:
    text = str(error.value)
    assert "\n" not in text
    assert len(text) < 600
    return text


def test_round_trip_gives_the_same_depth_and_record(saved: Path, content: dict[str, Any], record: ModelRecord) -> None:
    checkpoint = read_checkpoint(saved)
    assert checkpoint.record == record
    assert (checkpoint.epoch, checkpoint.global_step) == (3, 120)
    depth, pose = checkpoint.networks()
    assert pose is not None
    for name, value in depth.state_dict().items():
        assert torch.equal(value, content["state_dict"][f"depth.{name}"]), name
    original, _ = build_networks(record)
    load_weights(original, checkpoint.weights("depth"), "depth network")
    image = torch.rand(1, 3, 32, 64)
    assert torch.equal(depth.eval()(image).depth[0], original.eval()(image).depth[0])


def test_record_survives_json(record: ModelRecord) -> None:
    assert ModelRecord.from_plain(json.loads(json.dumps(record.to_plain()))) == record


def test_building_leaves_the_random_state_alone(record: ModelRecord) -> None:
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    build_networks(record)
    assert torch.equal(torch.rand(3), expected)


def test_what_training_started_from_is_not_fetched_again(record: ModelRecord, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("reading a checkpoint must not fetch anything")

    monkeypatch.setattr(torch.hub, "download_url_to_file", refuse)
    started = dataclasses.replace(record, encoder={**record.encoder, "weights": "https://example.org/w.pth"})
    depth, _ = build_networks(started)
    assert depth.features


def test_model_without_pose_network(content: dict[str, Any], record: ModelRecord, tmp_path: Path) -> None:
    plain = dataclasses.replace(record, pose=None, scale=None).to_plain()
    atomic_save({**content, "saunet": plain}, tmp_path / "x.ckpt")
    depth, pose = read_checkpoint(tmp_path / "x.ckpt").networks()
    assert pose is None
    assert isinstance(depth, nn.Module)


def test_compiled_model_loads(content: dict[str, Any], tmp_path: Path) -> None:
    state = {key.replace("depth.", "depth._orig_mod.", 1): value for key, value in content["state_dict"].items()}
    atomic_save({**content, "state_dict": state}, tmp_path / "x.ckpt")
    assert read_checkpoint(tmp_path / "x.ckpt").networks()[0] is not None


class TestUnreadable:
    def test_missing(self, tmp_path: Path) -> None:
        with pytest.raises(CheckpointError, match="no checkpoint at") as error:
            read_checkpoint(tmp_path / "absent.ckpt")
        one_sentence(error)

    def test_folder(self, saved: Path) -> None:
        with pytest.raises(CheckpointError, match=rf"is a folder; give the checkpoint file in it, such as {saved}"):
            read_checkpoint(saved.parent)

    @pytest.mark.parametrize("keep", [0, 1, 100, 0.5, 0.999])
    def test_truncated(self, saved: Path, keep: float) -> None:
        data = saved.read_bytes()
        saved.write_bytes(data[: int(len(data) * keep) if isinstance(keep, float) else keep])
        with pytest.raises(CheckpointError, match="damaged") as error:
            read_checkpoint(saved)
        one_sentence(error)

    @pytest.mark.parametrize("data", [b"hello, this is text", b"\x89PNG\r\n\x1a\n" + bytes(100), bytes(1000)])
    def test_other_files(self, tmp_path: Path, data: bytes) -> None:
        (tmp_path / "x.ckpt").write_bytes(data)
        with pytest.raises(CheckpointError, match="damaged") as error:
            read_checkpoint(tmp_path / "x.ckpt")
        one_sentence(error)

    def test_pickled_objects_are_refused_and_not_run(self, content: dict[str, Any], tmp_path: Path) -> None:
        marker = tmp_path / "ran"

        class Evil:
            def __reduce__(self) -> Any:
                return os.mkdir, (str(marker),)

        torch.save({**content, "hyper_parameters": Evil()}, tmp_path / "evil.ckpt")
        (tmp_path / "plain.ckpt").write_bytes(pickle.dumps(Evil()))
        for name in ("evil.ckpt", "plain.ckpt"):
            with pytest.raises(CheckpointError, match=r"refused|damaged") as error:
                read_checkpoint(tmp_path / name)
            one_sentence(error)
        assert not marker.exists()

    def test_pickled_module_is_refused(self, tmp_path: Path) -> None:
        torch.save(nn.Linear(1, 1), tmp_path / "x.ckpt")
        with pytest.raises(CheckpointError, match="pickled objects"):
            read_checkpoint(tmp_path / "x.ckpt")

    @pytest.mark.parametrize(
        "value", [{"state_dict": {}}, {"saunet": {}}, [1, 2], torch.zeros(2), {"a": torch.ones(1)}]
    )
    def test_not_ours(self, tmp_path: Path, value: Any) -> None:
        torch.save(value, tmp_path / "x.ckpt")
        with pytest.raises(CheckpointError, match="not a saunet checkpoint"):
            read_checkpoint(tmp_path / "x.ckpt")


class TestRecord:
    def test_newer_format(self, content: dict[str, Any], tmp_path: Path) -> None:
        atomic_save({**content, "saunet": {**content["saunet"], "format": 2, "version": "9.0"}}, tmp_path / "x.ckpt")
        with pytest.raises(CheckpointError, match=r"format 2, written by saunet 9\.0.*upgrade saunet") as error:
            read_checkpoint(tmp_path / "x.ckpt")
        one_sentence(error)

    @pytest.mark.parametrize("slot", ["encoder", "decoder", "pose"])
    def test_unregistered_target(self, content: dict[str, Any], tmp_path: Path, slot: str) -> None:
        model = {**content["saunet"]["model"], slot: {"_target_": "os.system", "command": "true"}}
        atomic_save({**content, "saunet": {**content["saunet"], "model": model}}, tmp_path / "x.ckpt")
        with pytest.raises(CheckpointError, match=r"'os\.system', which is not a registered") as error:
            read_checkpoint(tmp_path / "x.ckpt")
        assert str(tmp_path / "x.ckpt") in one_sentence(error)

    def test_registered_component_of_another_kind(self, record: ModelRecord) -> None:
        swapped = dataclasses.replace(record, encoder=record.decoder)
        with pytest.raises(CheckpointError, match="not a registered encoder"):
            build_networks(swapped)

    def test_nested_unregistered_target(self, record: ModelRecord) -> None:
        nested = {**record.encoder, "extra": [{"_target_": "builtins.eval"}]}
        with pytest.raises(CheckpointError, match=r"'builtins\.eval'"):
            build_networks(dataclasses.replace(record, encoder=nested))

    def test_node_without_target(self, record: ModelRecord) -> None:
        with pytest.raises(CheckpointError, match="the recorded encoder has no '_target_'"):
            build_networks(dataclasses.replace(record, encoder={"blocks": [2, 2, 2, 2]}))

    def test_unknown_parameter(self, record: ModelRecord, content: dict[str, Any], tmp_path: Path) -> None:
        edited = dataclasses.replace(record, encoder={**record.encoder, "widht": 3})
        with pytest.raises(ConfigError, match="no parameter 'widht'"):
            build_networks(edited)
        atomic_save({**content, "saunet": edited.to_plain()}, tmp_path / "x.ckpt")
        with pytest.raises(CheckpointError, match="no parameter 'widht'"):
            read_checkpoint(tmp_path / "x.ckpt").networks()

    @pytest.mark.parametrize("key", ["model", "height", "width"])
    def test_missing_key(self, record: ModelRecord, key: str) -> None:
        plain = record.to_plain()
        del plain[key]
        with pytest.raises(CheckpointError, match=f"lacks '{key}'"):
            ModelRecord.from_plain(plain)

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"height": 0}, "size is 0x64"),
            ({"width": "wide"}, "width is str 'wide'"),
            ({"height": True}, "height is bool True"),
            ({"width": -64}, "size is 32x-64"),
            ({"model": 3}, "model is int 3"),
            ({"offsets": 1}, "offsets is int 1"),
            ({"offsets": ["a"]}, "offsets is str 'a'"),
            ({"scale": {"factor": "2", "source": "x"}}, "factor is str '2'"),
            ({"scale": {"factor": -1.0, "source": "x"}}, "scale factor is -1.0"),
            ({"scale": {"factor": float("nan"), "source": "x"}}, "scale factor is nan"),
            ({"format": "1"}, "'format' number"),
        ],
    )
    def test_values_that_cannot_work(self, record: ModelRecord, changes: dict[str, Any], message: str) -> None:
        with pytest.raises(CheckpointError, match=message) as error:
            ModelRecord.from_plain({**record.to_plain(), **changes})
        one_sentence(error)

    def test_depth_range(self, record: ModelRecord) -> None:
        with pytest.raises(CheckpointError, match=r"depth range is 5\.0 to 1\.0"):
            dataclasses.replace(record, min_depth=5.0, max_depth=1.0)

    def test_only_plain_values_are_stored(self, record: ModelRecord) -> None:
        with pytest.raises(CheckpointError, match="plain values only"):
            dataclasses.replace(record, data={"path": Path("x")}).to_plain()


class TestWeights:
    def test_another_architecture(
        self, node: Node, content: dict[str, Any], record: ModelRecord, tmp_path: Path
    ) -> None:
        other = dataclasses.replace(record, encoder=node("encoder", "resnet34"))
        atomic_save({**content, "saunet": other.to_plain()}, tmp_path / "x.ckpt")
        with pytest.raises(
            CheckpointError, match="checkpoint of another model, the depth network does not fit"
        ) as error:
            read_checkpoint(tmp_path / "x.ckpt").networks()
        assert "it lacks 'encoder" in one_sentence(error)

    def test_shape_is_named(self) -> None:
        state = {"weight": torch.zeros(3, 2), "bias": torch.zeros(3)}
        with pytest.raises(CheckpointError, match=r"'weight' is \(3, 2\) but the model has \(3, 4\)"):
            load_weights(nn.Linear(4, 3), state, "layer")

    def test_extra_and_missing_are_named_and_nothing_changes(self) -> None:
        layer = nn.Linear(2, 2)
        before = layer.weight.detach().clone()
        state: dict[str, Tensor] = {"weight": torch.ones(2, 2), "scale": torch.ones(1), "shift": torch.ones(1)}
        with pytest.raises(CheckpointError, match=r"it lacks 'bias'; it has 'scale' \(and 1 more\)"):
            load_weights(layer, state, "layer")
        assert torch.equal(layer.weight, before)


class TestAtomicSave:
    def test_failure_keeps_the_old_file_and_leaves_nothing(self, tmp_path: Path) -> None:
        atomic_save({"a": 1}, tmp_path / "x.ckpt")
        with pytest.raises(AttributeError):
            atomic_save({"f": lambda: None}, tmp_path / "x.ckpt")
        assert torch.load(tmp_path / "x.ckpt", weights_only=True) == {"a": 1}
        assert [path.name for path in tmp_path.iterdir()] == ["x.ckpt"]

    def test_full_disk(self, tmp_path: Path) -> None:
        """A file size limit in a process of its own stands for a full disk."""
        code = (
            "import resource, signal, sys, torch\n"
            "from saunet.runs.checkpoint import atomic_save\n"
            "from saunet.errors import CheckpointError\n"
            "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
            "resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))\n"
            "try:\n    atomic_save({'w': torch.zeros(100000)}, sys.argv[1])\n"
            "except CheckpointError as error:\n    print(error)\n"
        )
        target = tmp_path / "x.ckpt"
        result = python("-c", code, str(target))
        assert result.returncode == 0, result.stderr
        assert f"cannot write {target}" in result.stdout
        assert list(tmp_path.iterdir()) == []

    def test_folder_in_the_way(self, tmp_path: Path) -> None:
        with pytest.raises(CheckpointError, match="a folder has this name"):
            atomic_save({}, tmp_path)

    def test_file_where_the_folder_should_be(self, tmp_path: Path) -> None:
        (tmp_path / "file").write_text("x")
        with pytest.raises(CheckpointError, match="cannot write"):
            atomic_save({}, tmp_path / "file" / "x.ckpt")
