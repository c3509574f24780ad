"""Exported files compute what the network computes, carry their record, and predict without torch."""

from __future__ import annotations

import dataclasses
import json
import shutil
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch
from networks import buildable_encoders, small_network
from numpy.typing import NDArray
from processes import python
from safetensors.torch import load_file
from torch import Tensor

import saunet
from saunet.errors import CheckpointError, ConfigError, DataError
from saunet.exporting import exporters
from saunet.exporting import tool as module
from saunet.exporting.card import fingerprint
from saunet.exporting.exporters import export_onnx, export_program
from saunet.exporting.onnx import OnnxPredictor, open_session
from saunet.exporting.parity import Parity
from saunet.exporting.tool import ExportOptions, export
from saunet.io.images import write_image
from saunet.models.depth import DepthNet
from saunet.prediction.predictor import Predictor
from saunet.registry import decoders, encoders
from saunet.runs.checkpoint import atomic_save, build_networks
from saunet.runs.record import ModelRecord, Scale
from saunet.weights.files import read_model

Picture = NDArray[np.uint8]
Node = Callable[..., dict[str, Any]]
onnx = pytest.importorskip("onnx", reason="ONNX export needs saunet[export]")
pytest.importorskip("onnxscript", reason="ONNX export needs saunet[export]")
pytest.importorskip("onnxruntime", reason="ONNX export needs saunet[export]")


TRACED: dict[str, Any] = {}
"""What torch.export made of the network of `checkpoint`, once for each kind of batch."""


def exported_files(checkpoint: Path, output: Path, formats: Any = None, **more: Any) -> list[Parity]:
    """Export `checkpoint`, whose network is traced only the first time: that takes longest."""
    trace = exporters.depth_program

    def traced(network: DepthNet, record: ModelRecord, batch: str) -> Any:
        if batch not in TRACED:
            TRACED[batch] = trace(network, record, batch)
        return TRACED[batch]

    chosen = {} if formats is None else {"formats": formats}
    with mock.patch.object(exporters, "depth_program", traced):
        return list(export(ExportOptions(checkpoint=checkpoint, output=output, **chosen, **more)).reports)


@pytest.fixture(scope="module")
def record(node: Node) -> ModelRecord:
    return ModelRecord(
        {**node("encoder", "resnet50"), "blocks": [1, 1, 1, 1]},
        {**node("decoder", "unet"), "channels": [8] * 5, "scales": [0]},
        None, 0.1, 100.0, 32, 64,
        scale=Scale(12.5, "camera height 1.65 m"), data={"name": "synthetic", "seed": 3},
    )  # fmt: skip


@pytest.fixture(scope="module")
def checkpoint(record: ModelRecord, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "last.ckpt"
    depth, _ = build_networks(record)
    state = {f"depth.{name}": value for name, value in depth.state_dict().items()}
    trained = dataclasses.replace(record, data={**record.data, "root": "/home/someone/data"})
    atomic_save({"state_dict": state, "saunet": trained.to_plain()}, path)
    return path


@pytest.fixture(scope="module")
def exported(checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Parity]]:
    folder = tmp_path_factory.mktemp("export")
    y, x = np.mgrid[0:50, 0:100]
    write_image(folder / "road.png", np.stack([x * 2, y * 5, x + y], axis=-1).astype(np.uint8))
    row = {
        "predictor": "model",
        "protocol": "eigen_lidar_x",
        "abs_rel": 0.111,
        "sq_rel": 0.9,
        "a1": None,
        "images": 697,
    }
    (folder / "metrics.json").write_text(json.dumps({"protocols": [], "results": [row]}))
    with warnings.catch_warnings():  # of what torch says of itself, users need to hear nothing
        warnings.filterwarnings("error", message=r".*(LeafSpec|No complete tensor)")
        reports = exported_files(checkpoint, folder / "model", images=folder / "road.png", evaluation=folder)
    return folder / "model", reports


def test_folder_has_files_config_report_and_card(exported: tuple[Path, list[Parity]], record: ModelRecord) -> None:
    folder, reports = exported
    assert sorted(path.name for path in folder.iterdir()) == [
        "README.md", "config.json", "model.onnx", "model.pt2", "model.safetensors", "report.json",
    ]  # fmt: skip
    assert [report.file for report in reports] == ["model.onnx", "model.pt2", "model.safetensors"]
    for report in reports:
        assert report.difference < 1e-5
        assert report.depth_difference < 1e-3
        assert (report.batch, report.random, report.real) == ("any", 2, 1)
        assert min(report.eager_ms, report.exported_ms, report.megabytes) > 0
        assert report.eager_ms == reports[0].eager_ms
    assert ModelRecord.from_plain(json.loads((folder / "config.json").read_text())) == record
    stored = json.loads((folder / "report.json").read_text())
    assert stored["files"] == [dataclasses.asdict(report) for report in reports]
    assert stored["versions"]["torch"] == torch.__version__
    card = (folder / "README.md").read_text()
    for text in (
        "ResNet(",
        "64 x 32",
        "Network depth x 12.5 is meters",
        "camera height 1.65 m",
        "synthetic",
        "model.onnx",
        f"`{fingerprint(record.to_plain()['data'])}`",
        "| model | eigen_lidar_x | 0.111 | 0.900 |",
    ):
        assert text in card, text


def test_safetensors_hold_the_depth_network_and_a_pose_network(
    exported: tuple[Path, list[Parity]], record: ModelRecord, node: Node, tmp_path: Path
) -> None:
    assert {name.partition(".")[0] for name in load_file(exported[0] / "model.safetensors")} == {"depth"}
    posed = dataclasses.replace(record, pose=node("pose", "posecnn"))
    depth, pose = build_networks(posed)
    assert pose is not None
    state = module.named_state({"depth": depth, "pose": pose})
    atomic_save({"state_dict": state, "saunet": posed.to_plain()}, tmp_path / "last.ckpt")
    export(ExportOptions(checkpoint=tmp_path / "last.ckpt", output=tmp_path / "out", formats=["safetensors"]))
    restored = read_model(tmp_path / "out").networks()[1]
    assert restored is not None
    assert all(torch.equal(value, pose.state_dict()[name]) for name, value in restored.state_dict().items())


def test_onnx_predicts_what_the_checkpoint_predicts(
    exported: tuple[Path, list[Parity]], checkpoint: Path, picture: Picture
) -> None:
    onnx_predictor = OnnxPredictor(exported[0] / "model.onnx")
    images = [picture, picture[:, ::-1].copy(), picture[:30]]
    expected = Predictor.from_checkpoint(checkpoint).predict_batch(images)
    for got, wanted in zip(onnx_predictor.predict_batch(images), expected, strict=True):
        assert np.allclose(got.disparity, wanted.disparity, atol=1e-5)
        assert got.unit == wanted.unit == "meters (scale from camera height 1.65 m)"
    assert len(onnx_predictor.fingerprint) == 16


def test_program_runs_without_saunet(exported: tuple[Path, list[Parity]], checkpoint: Path) -> None:
    image = torch.rand(3, 3, 32, 64)
    program = torch.export.load(exported[0] / "model.pt2")
    network = Predictor.from_checkpoint(checkpoint).network
    assert torch.allclose(program.module()(image), network(image).disparity[0], atol=1e-5)


def test_predicting_from_onnx_does_not_import_torch(exported: tuple[Path, list[Parity]], tmp_path: Path) -> None:
    write_image(tmp_path / "in" / "x.png", np.zeros((20, 30, 3), np.uint8))
    code = (
        "import sys, saunet\n"
        "from saunet.prediction import PredictOptions, predict\n"
        "outputs = ('color', 'png16', 'npy', 'ply')\n"
        "options = PredictOptions(checkpoint=sys.argv[1], input=sys.argv[2], output=sys.argv[3], outputs=outputs, "
        "camera=(30, 30, 15, 10))\n"
        "predict(options, saunet.load(sys.argv[1]))\n"
        "print([name for name in ('torch', 'lightning', 'onnx') if name in sys.modules])"
    )
    arguments = [str(exported[0] / "model.onnx"), str(tmp_path / "in"), str(tmp_path / "out")]
    result = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=True)
    assert result.stdout.splitlines()[-1] == "[]"
    assert (tmp_path / "out" / "x_disparity.png").exists()


def test_the_comparison_leaves_the_cores_to_the_original(
    exported: tuple[Path, list[Parity]], monkeypatch: pytest.MonkeyPatch
) -> None:
    sessions: list[Any] = []

    def noted(*arguments: Any, **settings: Any) -> Any:
        sessions.append(open_session(*arguments, **settings))
        return sessions[-1]

    monkeypatch.setattr(exporters, "open_session", noted)
    exporters.run_onnx(exported[0] / "model.onnx")
    assert sessions[0].get_session_options().get_session_config_entry("session.intra_op.allow_spinning") == "0"


def test_fixed_batch_is_filled_up(network: DepthNet, record: ModelRecord, tmp_path: Path, picture: Picture) -> None:
    export_onnx(network, record, tmp_path / "x.onnx", batch="one")
    images = [picture, picture[:20], picture[:, ::-1].copy()]
    expected = Predictor(network, 32, 64, scale=record.scale).predict_batch(images)
    for got, wanted in zip(OnnxPredictor(tmp_path / "x.onnx").predict_batch(images), expected, strict=True):
        assert np.allclose(got.disparity, wanted.disparity, atol=1e-5)


def test_flip_averaging_is_that_of_the_network(
    exported: tuple[Path, list[Parity]], checkpoint: Path, picture: Picture
) -> None:
    flipping = saunet.load(exported[0] / "model.onnx", flip=True)
    expected = Predictor.from_checkpoint(checkpoint, flip=True).predict(picture).disparity
    assert np.allclose(flipping.predict(picture).disparity, expected, atol=1e-5)
    assert flipping.fingerprint != saunet.load(exported[0] / "model.onnx").fingerprint


def test_older_opsets(checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first: list[Any] = []  # of opset 18, from which 17 is made too
    write = torch.onnx.export

    def once(*arguments: Any, **settings: Any) -> Any:
        if not first:
            first.append(write(*arguments, **settings))
        return first[0]

    monkeypatch.setattr(torch.onnx, "export", once)
    for opset in (18, 17):
        (report,) = exported_files(checkpoint, tmp_path / str(opset), ["onnx"], opset=opset)
        assert report.difference < 1e-5
        made = onnx.load(tmp_path / str(opset) / "model.onnx")
        onnx.checker.check_model(made, full_check=True)
        assert [(each.domain, each.version) for each in made.opset_import] == [("", opset)]
        assert made.ir_version == 8
    with pytest.raises(ConfigError, match="opset is '19', allowed: 17, 18, 20"):
        exported_files(checkpoint, tmp_path, ["onnx"], opset=19)


def test_a_folder_with_another_export_is_not_mixed(
    exported: tuple[Path, list[Parity]], checkpoint: Path, tmp_path: Path
) -> None:
    shutil.copytree(exported[0], tmp_path / "out")
    with pytest.raises(ConfigError, match=r"already has config\.json; choose another output folder"):
        exported_files(checkpoint, tmp_path / "out", ["safetensors"])
    with pytest.raises(ConfigError, match="contains the model itself"):
        exported_files(tmp_path / "out", tmp_path / "out", ["safetensors"], overwrite=True)
    exported_files(exported[0], tmp_path / "out", ["safetensors"], overwrite=True)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "README.md", "config.json", "model.safetensors", "report.json",
    ]  # fmt: skip
    assert saunet.load(tmp_path / "out").fingerprint == saunet.load(checkpoint).fingerprint


def test_a_file_that_gives_nan_is_not_written(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runners = module._RUNNERS
    monkeypatch.setitem(runners, "safetensors", lambda *_: lambda image: image[:, :1] * np.float32("nan"))
    with pytest.raises(CheckpointError, match=r"model\.safetensors gives NaN where .*so it is not written"):
        exported_files(checkpoint, tmp_path / "out", ["safetensors"])
    assert list((tmp_path / "out").iterdir()) == []


def test_settings_that_the_folder_cannot_hold(checkpoint: Path, tmp_path: Path) -> None:
    content = torch.load(checkpoint, weights_only=True)
    content["saunet"]["data"]["far"] = float("inf")
    atomic_save(content, tmp_path / "far.ckpt")
    with pytest.raises(ConfigError, match=r"config\.json cannot hold the model's settings .*give finite numbers"):
        exported_files(tmp_path / "far.ckpt", tmp_path / "out", ["safetensors"])
    assert not (tmp_path / "out").exists()


def test_a_file_that_differs_is_not_written(checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(module._RUNNERS, "safetensors", lambda *_: lambda image: image[:, :1] * 0 + 1)
    with pytest.raises(
        CheckpointError, match=r"model\.safetensors differs from the network by .* so it is not written"
    ):
        exported_files(checkpoint, tmp_path / "out", ["safetensors"])
    assert list((tmp_path / "out").iterdir()) == []


def test_network_that_fixes_its_batch_size(network: DepthNet, record: ModelRecord, tmp_path: Path) -> None:
    class FixedBatch(torch.nn.Module):
        def forward(self, image: Tensor) -> tuple[Tensor, ...]:
            return (image.view(int(image.shape[0]), 3, 32, 64)[:, :, ::2, ::2],)

    network.encoder = FixedBatch()
    with pytest.raises(ConfigError, match="fixes its batch size on export; export with batch=one"):
        export_program(network, record, tmp_path / "x.pt2", batch="any")
    for batch in ("one", "auto"):
        export_program(network, record, tmp_path / f"{batch}.pt2", batch=batch)
        program = torch.export.load(tmp_path / f"{batch}.pt2").module()
        assert program(torch.zeros(1, 3, 32, 64)).shape == (1, 1, 32, 64)


def test_full_disk(checkpoint: Path, tmp_path: Path) -> None:
    """A file size limit in a process of its own stands for a full disk; the compiler is left out.

    One convolution stands for the network: exporters write it sooner.
    """
    code = (
        "import resource, signal, sys, torch\n"
        "from saunet.errors import DataError\n"
        "from saunet.exporting import ExportOptions, export, exporters\n"
        "program = torch.export.export(torch.nn.Conv2d(3, 64, 5), (torch.zeros(1, 3, 8, 8),))\n"
        "exporters.depth_program = lambda *_: (program, 'one')\n"
        "def compiled(program, package_path):\n"
        "    package_path.write(bytes(50000))\n"
        "torch._inductor.aoti_compile_and_package = compiled\n"
        "import shutil; shutil.which = lambda name: name\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (10000, 10000))\n"
        "for name in ('onnx', 'program', 'compiled', 'safetensors'):\n"
        "    try:\n"
        "        export(ExportOptions(checkpoint=sys.argv[1], output=sys.argv[2], formats=[name]))\n"
        "    except DataError as error:\n        print(error)\n"
    )
    result = python("-c", code, str(checkpoint), str(tmp_path / "out"))
    assert result.returncode == 0, result.stderr
    said = result.stdout.splitlines()
    for line, file in zip(said, ("onnx", "pt2", "aoti.pt2", "safetensors"), strict=True):
        assert line.startswith(f"cannot write {tmp_path / 'out'}/model.{file}")
        assert "File too large; check the folder, its permissions and free space" in line
    assert list((tmp_path / "out").iterdir()) == []


def short_network() -> DepthNet:
    """Return the paper's network with two stages of four: tracing takes time with every layer."""
    encoder = encoders.build("stratified_tiny", dim=8, depths=(2, 1), heads=(1, 1), window=(4, 4))
    return DepthNet(encoder, decoders.partial("aunet", scales=(0, 1))).eval()


HANDFUL: list[tuple[str, str, Callable[..., DepthNet]]] = [
    ("stratified_tiny", "aunet", lambda *_: short_network()),
    ("lite_mono", "lite_mono", small_network),
]
"""Beside resnet50 with unet, which is that of `exported`."""


def check_pair(
    node: Node,
    encoder: str,
    decoder: str,
    record: ModelRecord,
    folder: Path,
    build: Callable[..., DepthNet] = small_network,
) -> None:
    """Export to ONNX with any number of images and compare, in disparity, with 1, 2 and 3."""
    network = build(encoder, decoder)
    height, width = 2 * network.size_divisor, 3 * network.size_divisor
    own = dataclasses.replace(
        record, encoder=node("encoder", encoder), decoder=node("decoder", decoder), height=height, width=width
    )
    assert export_onnx(network, own, folder / "x.onnx") == "any"
    predictor = OnnxPredictor(folder / "x.onnx")
    for batch in (1, 2, 3):
        image = torch.rand(batch, 3, height, width)
        with torch.no_grad():
            expected = network(image).disparity[0][:, 0].numpy()
        assert np.abs(predictor.disparity(image.numpy()) - expected).max() < 1e-4


@pytest.mark.parametrize(("encoder", "decoder", "build"), HANDFUL)
def test_networks_export_to_onnx(
    node: Node, encoder: str, decoder: str, build: Callable[..., DepthNet], record: ModelRecord, tmp_path: Path
) -> None:
    check_pair(node, encoder, decoder, record, tmp_path, build)


@pytest.mark.slow
@pytest.mark.parametrize("decoder", decoders.names())
@pytest.mark.parametrize("encoder", buildable_encoders())
def test_every_pair_exports_to_onnx(
    node: Node, encoder: str, decoder: str, record: ModelRecord, tmp_path: Path
) -> None:
    check_pair(node, encoder, decoder, record, tmp_path)


@pytest.mark.slow
def test_compiled_package(checkpoint: Path, tmp_path: Path) -> None:
    if shutil.which("g++") is None:
        pytest.skip("AOTInductor needs a C++ compiler")
    (report,) = exported_files(checkpoint, tmp_path / "out", ["compiled"], batch="one")
    assert report.file == "model.aoti.pt2"
    assert report.difference < 1e-5
    image = torch.rand(1, 3, 32, 64)
    compiled = torch._inductor.aoti_load_package(str(tmp_path / "out" / "model.aoti.pt2"))
    expected = Predictor.from_checkpoint(checkpoint).network(image).disparity[0]
    assert torch.allclose(compiled(image), expected, atol=1e-5)


def test_refused(
    network: DepthNet, record: ModelRecord, checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ConfigError, match="formats is 'onx'; did you mean 'onnx'"):
        exported_files(checkpoint, tmp_path, ["onx"])
    with pytest.raises(CheckpointError, match="no checkpoint at"):
        exported_files(tmp_path / "absent.ckpt", tmp_path)
    with pytest.raises(ConfigError, match="formats is empty"):
        exported_files(checkpoint, tmp_path, [])
    with pytest.raises(DataError, match=r"cannot read .*metrics\.json: No such file"):
        exported_files(checkpoint, tmp_path, evaluation=tmp_path)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match="needs the package onnx; run: pip install"):
        export_onnx(network, record, tmp_path / "x.onnx")
    assert list(tmp_path.iterdir()) == []


class TestOnnxFile:
    def test_missing_broken_foreign(self, tmp_path: Path) -> None:
        with pytest.raises(CheckpointError, match="no ONNX model at"):
            OnnxPredictor(tmp_path / "x.onnx")
        (tmp_path / "x.onnx").write_bytes(b"nothing")
        with pytest.raises(CheckpointError, match="not an ONNX model that onnxruntime can read"):
            OnnxPredictor(tmp_path / "x.onnx")
        value = onnx.helper.make_tensor_value_info
        graph = onnx.helper.make_graph(
            [onnx.helper.make_node("Identity", ["image"], ["disparity"])], "g",
            [value("image", 1, [1, 3, 8, 8])], [value("disparity", 1, [1, 3, 8, 8])],
        )  # fmt: skip
        model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 18)], ir_version=9)
        onnx.save(model, tmp_path / "y.onnx")
        with pytest.raises(CheckpointError, match="not one that saunet exported"):
            OnnxPredictor(tmp_path / "y.onnx")

    def test_truncated(self, exported: tuple[Path, list[Parity]], tmp_path: Path) -> None:
        data = (exported[0] / "model.onnx").read_bytes()
        (tmp_path / "x.onnx").write_bytes(data[: len(data) // 2])
        with pytest.raises(CheckpointError, match="is damaged, or not an ONNX model"):
            OnnxPredictor(tmp_path / "x.onnx")

    def test_device(self, exported: tuple[Path, list[Parity]]) -> None:
        with pytest.raises(ConfigError, match=r"device 'tpu' is not supported by this onnxruntime; available: .*cpu"):
            OnnxPredictor(exported[0] / "model.onnx", device="tpu")
