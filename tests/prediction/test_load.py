"""One door to any trained model: checkpoint, exported folder or file, hub; and nothing in a file is ever run."""

from __future__ import annotations

import json
import os
import pickle
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import saunet
from saunet.errors import CheckpointError, ConfigError
from saunet.exporting.tool import ExportOptions, export
from saunet.prediction.pointcloud import Camera
from saunet.runs.checkpoint import atomic_save, build_networks
from saunet.runs.record import ModelRecord
from saunet.weights.files import read_model, write_safetensors
from saunet.weights.locate import locate

Node = Callable[..., dict[str, Any]]


@pytest.fixture(scope="module")
def record(node: Node) -> ModelRecord:
    encoder = {**node("encoder", "resnet18"), "blocks": [1, 1, 1, 1]}
    decoder = {**node("decoder", "unet"), "channels": [8] * 5}
    return ModelRecord(encoder, decoder, node("pose", "posecnn"), 0.1, 100.0, 32, 64)


@pytest.fixture(scope="module")
def state(record: ModelRecord) -> dict[str, torch.Tensor]:
    depth, pose = build_networks(record)
    assert pose is not None
    return dict(torch.nn.ModuleDict({"depth": depth, "pose": pose}).state_dict())


@pytest.fixture
def exported(record: ModelRecord, state: dict[str, torch.Tensor], tmp_path: Path) -> Path:
    folder = tmp_path / "model"
    folder.mkdir()
    write_safetensors(state, folder / "model.safetensors")
    (folder / "config.json").write_text(json.dumps(record.to_plain()))
    return folder


def test_folder_and_checkpoint_are_the_same_model(
    exported: Path, record: ModelRecord, state: dict[str, torch.Tensor], tmp_path: Path
) -> None:
    atomic_save({"state_dict": state, "saunet": record.to_plain()}, tmp_path / "x.ckpt")
    expected = saunet.load(tmp_path / "x.ckpt")
    for source in (exported, str(exported), exported / "model.safetensors"):
        assert saunet.load(source).fingerprint == expected.fingerprint
    pose = read_model(exported).networks()[1]
    assert pose is not None
    assert all(torch.equal(value, state[f"pose.{name}"]) for name, value in pose.state_dict().items())


def test_a_trainings_folder_stands_for_its_best_checkpoint(
    record: ModelRecord, state: dict[str, torch.Tensor], tmp_path: Path
) -> None:
    kept = tmp_path / "run" / "checkpoints"
    kept.mkdir(parents=True)
    atomic_save({"state_dict": state, "saunet": record.to_plain()}, kept / "last.ckpt")
    assert locate(tmp_path / "run") == kept / "last.ckpt"
    shutil.copy(kept / "last.ckpt", kept / "best.ckpt")
    assert locate(str(tmp_path / "run")) == kept / "best.ckpt"
    assert saunet.load(tmp_path / "run").fingerprint == saunet.load(kept / "last.ckpt").fingerprint


def test_folders_that_are_no_model(exported: Path, tmp_path: Path) -> None:
    (exported / "config.json").rename(exported / "x.json")
    with pytest.raises(CheckpointError, match=r"cannot read .*config\.json: No such file"):
        saunet.load(exported)
    (exported / "config.json").write_text("{")
    with pytest.raises(CheckpointError, match=r"config\.json is not JSON"):
        saunet.load(exported)
    (exported / "config.json").write_text("{}")
    with pytest.raises(CheckpointError, match=r"config\.json: the model record is"):
        saunet.load(exported)
    (exported / "model.safetensors").unlink()
    with pytest.raises(CheckpointError, match=r"has no model\.safetensors"):
        saunet.load(exported)
    with pytest.raises(CheckpointError, match="is a folder; give the checkpoint file in it"):
        saunet.load(tmp_path)
    (tmp_path / "x.pt2").touch()
    with pytest.raises(CheckpointError, match="runs with torch alone"):
        saunet.load(tmp_path / "x.pt2")


@pytest.mark.parametrize("keep", [0, 4, 100, 0.5])
def test_truncated_weights(exported: Path, keep: float) -> None:
    path = exported / "model.safetensors"
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * keep) if isinstance(keep, float) else keep])
    with pytest.raises(CheckpointError, match="is damaged or truncated"):
        saunet.load(exported)


class TestNothingIsRun:
    def test_unregistered_target(self, exported: Path) -> None:
        plain = json.loads((exported / "config.json").read_text())
        plain["model"]["encoder"] = {"_target_": "os.system", "command": "true"}
        (exported / "config.json").write_text(json.dumps(plain))
        with pytest.raises(CheckpointError, match=r"'os\.system', which is not a registered encoder, so nothing is"):
            saunet.load(exported)

    def test_pickle_under_any_name(self, exported: Path, tmp_path: Path) -> None:
        marker = tmp_path / "ran"

        class Evil:
            def __reduce__(self) -> Any:
                return os.mkdir, (str(marker),)

        for path in (exported / "model.safetensors", tmp_path / "x.ckpt", tmp_path / "x.onnx"):
            path.write_bytes(pickle.dumps(Evil()))
            with pytest.raises((CheckpointError, ConfigError)):
                saunet.load(path)
        torch.save({"state_dict": {}, "saunet": Evil()}, tmp_path / "y.ckpt")
        with pytest.raises(CheckpointError, match="contains pickled objects, which could run code"):
            saunet.load(tmp_path / "y.ckpt")
        assert not marker.exists()


class TestHub:
    @pytest.fixture
    def fetched(self, exported: Path, monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str | None]]:
        hub = pytest.importorskip("huggingface_hub", reason="huggingface_hub is not installed")
        calls: list[tuple[str, str | None]] = []

        def snapshot_download(name: str, *, revision: str | None, allow_patterns: list[str]) -> str:
            assert all(pattern.endswith((".json", ".safetensors", ".onnx", ".md")) for pattern in allow_patterns)
            calls.append((name, revision))
            return str(exported)

        monkeypatch.setattr(hub, "snapshot_download", snapshot_download)
        return calls

    def test_fetched_and_loaded(self, fetched: list[tuple[str, str | None]], exported: Path) -> None:
        expected = saunet.load(exported).fingerprint
        for source in ("hf://someone/depth", "someone/depth", "hf://someone/depth@v1.2", "some.one/depth-v2@main"):
            assert saunet.load(source).fingerprint == expected
        assert fetched == [("someone/depth", None)] * 2 + [("someone/depth", "v1.2"), ("some.one/depth-v2", "main")]

    def test_paths_are_not_asked_for(self, fetched: list[tuple[str, str | None]], tmp_path: Path) -> None:
        (tmp_path / "runs").mkdir()
        for source in ("runs/last.ckpt", "absent/last.ckpt", "a/b/c", str(tmp_path / "runs" / "x"), Path("a/b")):
            assert locate(source) == Path(source)
        assert fetched == []
        with pytest.raises(CheckpointError, match=r"no checkpoint at absent/last\.ckpt"):
            saunet.load("absent/last.ckpt")
        with pytest.raises(ConfigError, match="is not a hub id"):
            saunet.load("hf://someone")

    def test_offline(self, monkeypatch: pytest.MonkeyPatch) -> None:
        hub = pytest.importorskip("huggingface_hub", reason="huggingface_hub is not installed")

        def offline(*_: object, **__: object) -> str:
            raise ConnectionError("no route to host\nand many more lines")

        monkeypatch.setattr(hub, "snapshot_download", offline)
        with pytest.raises(CheckpointError) as error:
            saunet.load("hf://someone/depth")
        text = str(error.value)
        assert "cannot fetch 'someone/depth' from the hub (ConnectionError: no route to host); check" in text
        assert "\n" not in text

    def test_an_export_is_pushed_and_loaded_again(
        self, exported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        hub = pytest.importorskip("huggingface_hub", reason="huggingface_hub is not installed")
        remote = tmp_path / "hub"

        def create_repo(self: Any, name: str, *, private: bool, exist_ok: bool) -> str:
            assert private
            assert exist_ok
            (remote / name).mkdir(parents=True)
            return f"https://hub/{name}"

        def upload_folder(
            self: Any, *, repo_id: str, folder_path: Path, allow_patterns: list[str], commit_message: str
        ) -> None:
            for name in allow_patterns:
                if (folder_path / name).is_file():
                    shutil.copy(folder_path / name, remote / repo_id)

        monkeypatch.setattr(hub.HfApi, "create_repo", create_repo)
        monkeypatch.setattr(hub.HfApi, "upload_folder", upload_folder)
        monkeypatch.setattr(hub, "snapshot_download", lambda name, **_: str(remote / name))
        out = tmp_path / "out"
        done = export(ExportOptions(checkpoint=exported, output=out, formats=["safetensors"], push="someone/depth"))
        assert done.address == "https://hub/someone/depth"
        files = {path.name for path in (remote / "someone/depth").iterdir()}
        assert files == {"config.json", "model.safetensors", "README.md"}
        assert 'saunet.load("someone/depth")' in (remote / "someone/depth/README.md").read_text()
        assert saunet.load("someone/depth").fingerprint == saunet.load(out).fingerprint

    def test_a_push_that_fails_leaves_the_export(
        self, exported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        hub = pytest.importorskip("huggingface_hub", reason="huggingface_hub is not installed")

        def offline(*_: object, **__: object) -> str:
            raise ConnectionError("no route to host\nand many more lines")

        monkeypatch.setattr(hub.HfApi, "create_repo", offline)
        with pytest.raises(CheckpointError, match=r"ConnectionError: no route to host\).*hf upload a/b") as error:
            export(ExportOptions(checkpoint=exported, output=tmp_path / "out", formats=["safetensors"], push="a/b"))
        assert "\n" not in str(error.value)
        assert saunet.load(tmp_path / "out").height > 0
        for wrong, words in (("ab", "organization/name"), ("a/b@v1", "organization/name")):
            with pytest.raises(ConfigError, match=words):
                ExportOptions(checkpoint=exported, output=tmp_path / "x", push=wrong)
        with pytest.raises(ConfigError, match="safetensors or onnx"):
            ExportOptions(checkpoint=exported, output=tmp_path / "x", push="a/b", formats=["program"])

    def test_package_that_is_missing(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "huggingface_hub", None)
        with pytest.raises(ConfigError, match=r"no file 'someone/depth'.* pip install 'saunet\[hub\]'"):
            saunet.load("someone/depth")


def test_onnx_has_one_size(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="takes images of one size; leave keep_aspect out"):
        saunet.load(tmp_path / "x.onnx", keep_aspect=True)


def test_a_resized_camera_is_that_of_the_geometry() -> None:
    from saunet.geometry.camera import scale_intrinsics

    camera = Camera.from_numbers((70.0, 65.0, 40.3, 20.0), 60, 80)
    expected = scale_intrinsics(torch.from_numpy(camera.K), 37 / 80, 23 / 60).numpy()
    assert np.allclose(camera.resized(23, 37).K, expected)
    assert np.allclose(Camera.from_numbers([90.0], 60, 80).K[0, 0], 40)


def test_a_name_near_that_of_a_shipped_model_is_a_slip(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(CheckpointError, match="no model 'stret'; did you mean 'street'"):
        saunet.load("stret")


def test_a_model_and_its_points_say_what_they_are_in_one_line() -> None:
    model = saunet.load("street")
    assert repr(model) == f"Predictor(street: input {model.width} x {model.height}, relative, cpu)"
    cloud = model.predict(np.zeros((32, 64, 3), np.uint8)).point_cloud(90)
    assert repr(cloud) == f"PointCloud({len(cloud.points)} points, relative)"


@pytest.mark.parametrize("source", [None, "", 3])
def test_what_names_no_model_is_refused(source: Any) -> None:
    with pytest.raises(CheckpointError, match=r"saunet\.load got .*; give the path of a checkpoint"):
        saunet.load(source)


def test_predicting_does_not_import_the_compiler(tmp_path: Path) -> None:
    """Neither the window encoders' index tensors, the bound on what a file may ask for, nor a runtime need it."""
    code = (
        "import sys, torch, saunet\n"
        "with torch.no_grad():\n"
        "    saunet.build('encoder', 'stratified_nano').eval()(torch.rand(1, 3, 32, 64))\n"
        "saunet.load('street').predict(torch.rand(3, 32, 64))\n"
        "image = torch.zeros(32, 64, 3, dtype=torch.uint8).numpy()\n"
        f"saunet.predict(saunet.PredictOptions(input=[image], output={str(tmp_path / 'out')!r}))\n"
        "print('torch._dynamo' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "False"
