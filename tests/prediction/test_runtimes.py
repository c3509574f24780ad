"""Another runtime than torch gives the same depth, is converted once, and is refused where depth would change."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tiny_checkpoint import write_checkpoint

import saunet
from saunet.errors import CheckpointError, ConfigError
from saunet.exporting import exporters
from saunet.io.images import write_image
from saunet.io.video import VideoWriter
from saunet.prediction import runtimes
from saunet.prediction.predictor import Predictor
from saunet.prediction.tool import PredictResult
from saunet.runs.checkpoint import atomic_save, build_networks
from saunet.runs.record import ModelRecord
from saunet.scale.options import ScaleOptions

Run = Callable[[np.ndarray], np.ndarray]


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "x.ckpt"
    write_checkpoint(path, height=32, width=64)
    return path


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "cache"))
    return tmp_path / "cache" / "saunet"


@pytest.fixture
def pretend(monkeypatch: pytest.MonkeyPatch, checkpoint: Path) -> Callable[[float, float], Predictor]:
    """Install a runtime that changes disparity by a factor and takes a fraction of torch's time."""

    def pretending(factor: float, time: float) -> Predictor:
        predictor = Predictor.from_checkpoint(checkpoint)
        eager = exporters.run_eager(predictor.network)
        monkeypatch.setattr(runtimes, "_PACKAGES", {"onnx": ("numpy",)})
        monkeypatch.setattr(runtimes, "_open", lambda *_: ("f32", lambda image: factor * eager(image)))
        monkeypatch.setattr(runtimes, "milliseconds", lambda *_, **__: [1.0, time])
        return predictor

    return pretending


def image() -> np.ndarray:
    return np.random.default_rng(1).integers(0, 255, (50, 100, 3), np.uint8)


def test_what_is_faster_and_the_same_is_chosen(
    pretend: Callable[[float, float], Predictor], checkpoint: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    original = pretend(1.00001, 0.5)
    chosen = runtimes.choose_runtime(original, checkpoint)
    assert isinstance(chosen, runtimes.ConvertedPredictor)
    assert "onnx f32, 0.50 of torch's time, depth changes by 1e-05" in capsys.readouterr().out
    assert chosen.fingerprint == original.fingerprint
    one, other = chosen.predict(image()).depth, original.predict(image()).depth
    np.testing.assert_allclose(one, other, rtol=2e-5)
    assert not np.array_equal(one, other)


@pytest.mark.parametrize(("factor", "time"), [(1.01, 0.5), (float("nan"), 0.5), (1.0, 1.2)])
def test_what_is_slower_or_gives_other_depth_is_not(
    factor: float,
    time: float,
    pretend: Callable[[float, float], Predictor],
    checkpoint: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    original = pretend(factor, time)
    assert runtimes.choose_runtime(original, checkpoint) is original
    assert "runtime: torch" in capsys.readouterr().out
    if time < 1:
        with pytest.raises(ConfigError, match="changes depth"):
            runtimes.choose_runtime(original, checkpoint, "onnx")


def test_one_pixel_that_is_far_off_is_enough(
    pretend: Callable[[float, float], Predictor], checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = pretend(1.0, 0.5)
    eager = exporters.run_eager(original.network)

    def spoiled(image: np.ndarray) -> np.ndarray:
        disparity = eager(image)
        disparity[..., 3, 5] *= 1.1
        return disparity

    monkeypatch.setattr(runtimes, "_open", lambda *_: ("f32", spoiled))
    change = runtimes.depth_change(eager, spoiled, np.zeros((1, 3, 32, 64), np.float32))
    assert change.mean < runtimes.LIMITS["f32"].mean
    assert change.largest == pytest.approx(1 - 1 / 1.1, rel=1e-4)
    assert runtimes.choose_runtime(original, checkpoint) is original


def test_few_frames_are_not_worth_a_conversion(
    pretend: Callable[[float, float], Predictor], checkpoint: Path, cache: Path
) -> None:
    original = pretend(1.0, 0.5)
    assert runtimes.choose_runtime(original, checkpoint, frames=3) is original
    assert runtimes.choose_runtime(original, checkpoint, "torch") is original
    path = runtimes._cached(original, "onnx")
    path.parent.mkdir(parents=True)
    path.touch()
    assert runtimes.choose_runtime(original, checkpoint, frames=3) is not original


def test_the_first_image_is_compared_too(checkpoint: Path) -> None:
    original = Predictor.from_checkpoint(checkpoint)
    eager = exporters.run_eager(original.network)
    wrong = runtimes.ConvertedPredictor(original, lambda images: 1.01 * eager(images), runtimes.LIMITS["f32"])
    with pytest.raises(CheckpointError, match="runtime=torch"):
        wrong.predict(image())


def test_what_cannot_be_converted_is_said(checkpoint: Path) -> None:
    for made in (Predictor.from_checkpoint(checkpoint, keep_aspect=True),):
        assert runtimes.choose_runtime(made, checkpoint) is made
        with pytest.raises(ConfigError, match="keep_aspect"):
            runtimes.choose_runtime(made, checkpoint, "openvino")


@pytest.mark.parametrize(("runtime", "package"), [("openvino", "openvino"), ("onnx", "onnxscript")])
def test_converted_once_with_the_same_depth(
    runtime: str, package: str, checkpoint: Path, cache: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip(package, reason=f"runtime={runtime} needs its extra")
    original = Predictor.from_checkpoint(checkpoint, flip=True)
    chosen = runtimes.choose_runtime(original, checkpoint, runtime)
    assert "converting" in capsys.readouterr().out
    one, two = (each.predict_batch([image(), image()[::-1]]) for each in (original, chosen))
    tolerance = 10 * runtimes.LIMITS["bf16" if runtime == "openvino" and runtimes.has_bf16() else "f32"].mean
    for wanted, got in zip(one, two, strict=True):
        np.testing.assert_allclose(got.depth, wanted.depth, rtol=tolerance)
    runtimes.choose_runtime(original, checkpoint, runtime)
    assert "converting" not in capsys.readouterr().out
    for path in cache.iterdir():
        path.write_bytes(b"damaged")
    runtimes.choose_runtime(original, checkpoint, runtime)
    assert "converting" in capsys.readouterr().out


def test_bfloat16_is_used_where_it_is_asked_for(
    pretend: Callable[[float, float], Predictor],
    checkpoint: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    original = pretend(1.0, 0.5)
    eager = exporters.run_eager(original.network)
    monkeypatch.setattr(runtimes, "_PACKAGES", {"openvino": ("numpy",)})
    monkeypatch.setattr(runtimes, "_open", lambda *_: ("bf16", lambda image: 1.01 * eager(image)))
    monkeypatch.setattr(runtimes, "run_openvino", lambda *_: eager)
    chosen = runtimes.choose_runtime(original, checkpoint, "openvino-bf16")
    assert "openvino bf16, 0.50 of torch's time, depth changes by 0.01" in capsys.readouterr().out
    np.testing.assert_allclose(1.01 * chosen.predict(image()).depth, original.predict(image()).depth, rtol=1e-5)
    for usual in ("openvino", "auto"):
        same = runtimes.choose_runtime(original, checkpoint, usual)
        told = capsys.readouterr().out
        assert "openvino f32" in told
        assert "bf16 would change it by 0.01 (runtime=openvino-bf16)" in told
        np.testing.assert_allclose(same.predict(image()).depth, original.predict(image()).depth, rtol=1e-6)
    monkeypatch.setattr(runtimes, "_open", lambda *_: ("bf16", lambda image: 1.1 * eager(image)))
    with pytest.raises(ConfigError, match=r"changes depth by 0.09.*only .*0.05 .*is allowed"):
        runtimes.choose_runtime(original, checkpoint, "openvino-bf16")
    monkeypatch.setattr(runtimes, "_open", lambda *_: ("f32", eager))
    with pytest.raises(ConfigError, match="needs a processor with bfloat16"):
        runtimes.choose_runtime(original, checkpoint, "openvino-bf16")


def test_openvino_refuses_weights_that_are_not_finite(checkpoint: Path) -> None:
    pytest.importorskip("openvino", reason="needs the extra openvino")
    original = Predictor.from_checkpoint(checkpoint)
    with torch.no_grad():
        next(original.network.parameters())[0, 0, 0, 0] = torch.nan
    with pytest.raises(CheckpointError, match="not finite"):
        runtimes.choose_runtime(original, checkpoint, "openvino")


def test_a_converted_model_undistorts_as_the_original_does(pretend: Callable[[float, float], Predictor]) -> None:
    original = pretend(1.0, 0.5)
    original.undistort, original.undistorted_by = (lambda picture: picture[5:]), "camera 1"
    chosen = runtimes.choose_runtime(original, "absent.ckpt")
    assert isinstance(chosen, runtimes.ConvertedPredictor)
    assert chosen.undistorted_by == "camera 1"
    assert chosen.predict(image()).depth.shape == (45, 100)


def test_a_runtime_is_chosen_once_nothing_can_be_refused(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[float] = []

    def choose(predictor: Predictor, checkpoint: Path, runtime: str, frames: float) -> Predictor:
        asked.append(frames)
        return predictor

    def predict(name: str, **more: Any) -> PredictResult:
        folder = tmp_path / "out"
        return saunet.predict(
            saunet.PredictOptions(checkpoint=checkpoint, input=tmp_path / name, output=folder, **more)
        )

    monkeypatch.setattr(runtimes, "choose_runtime", choose)
    for name in ("in/a.png", "in/b.png"):
        write_image(tmp_path / name, image())
    predict("in")
    assert asked == [2]
    assert predict("in").skipped == 2
    (tmp_path / "out" / "b_depth.png").unlink()
    predict("in")
    assert asked == [2, 1]  # nothing left to do the time before
    with pytest.raises(ConfigError, match=r"made with different settings \(colormap\)"):
        predict("in", colormap="turbo")
    scale = ScaleOptions(method="camera_height", camera_height=1.5)
    with pytest.raises(ConfigError, match=r"made with different settings \(colormap, camera\)"):  # not measured yet
        predict("in", colormap="turbo", scale=scale, camera=[90])
    with VideoWriter(tmp_path / "a.mp4", 10.0) as video:
        video.write(image())
    predict("a.mp4")
    assert asked[2:] == [1]
    with pytest.raises(ConfigError, match=r"a_disparity\.mp4 exists"):
        predict("a.mp4")
    assert len(asked) == 3


@pytest.mark.parametrize("encoder", ["resnet18", "stratified_nano"])
def test_exported_for_openvino_with_a_report(encoder: str, node: Callable[..., dict[str, Any]], tmp_path: Path) -> None:
    openvino = pytest.importorskip("openvino", reason="needs the extra openvino")
    chosen = {"resnet18": {"blocks": [1, 1, 1, 1]}, "stratified_nano": {"depths": [2, 1, 1, 1], "dim": 8}}[encoder]
    decoder = {**node("decoder", "unet"), "channels": [8] * 5}
    record = ModelRecord({**node("encoder", encoder), **chosen}, decoder, None, 0.1, 100.0, 64, 96)
    depth, _ = build_networks(record)
    state = {f"depth.{name}": value for name, value in depth.state_dict().items()}
    atomic_save({"state_dict": state, "saunet": record.to_plain()}, tmp_path / "x.ckpt")
    options = saunet.ExportOptions(checkpoint=tmp_path / "x.ckpt", output=tmp_path / "out", formats=["openvino"])
    (report,) = saunet.export(options).reports
    assert (report.file, report.batch) == ("model.xml", "any")
    assert report.difference < 1e-5
    compiled = openvino.compile_model(str(tmp_path / "out" / "model.xml"), "CPU", {"INFERENCE_PRECISION_HINT": "f32"})
    images = np.random.default_rng(0).random((3, 3, 64, 96), dtype=np.float32)
    np.testing.assert_allclose(
        compiled({"image": images})["disparity"], exporters.run_eager(depth.eval())(images), rtol=1e-3, atol=1e-4
    )
