"""Models of other systems: what they mean by their numbers, whatever file they come in; each made here."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper
from torch import nn

from saunet.errors import CheckpointError, ConfigError
from saunet.evaluation import EvaluateOptions, evaluate
from saunet.evaluation.tool import runs_alone
from saunet.prediction.foreign import PRESETS, ForeignOptions, ForeignPredictor, is_foreign
from saunet.prediction.prediction import load
from saunet.prediction.tool import PredictOptions, predict
from saunet.registry import Spec
from saunet.scale.options import ScaleOptions

SIZE = (8, 12)


def write_onnx(path: Path, gain: float = 1.0, bias: float = 0.0, size: tuple[object, object] = SIZE) -> Path:
    """Write a model that gives the mean over the channels of its input, times a number, plus another."""
    numbers = [helper.make_tensor(name, TensorProto.FLOAT, [], [value]) for name, value in (("a", gain), ("b", bias))]
    nodes = [
        helper.make_node("ReduceMean", ["x"], ["mean"], axes=[1], keepdims=1),
        helper.make_node("Mul", ["mean", "a"], ["scaled"]),
        helper.make_node("Add", ["scaled", "b"], ["y"]),
    ]
    shapes = ("n", 3, *size), ("n", 1, *size)
    x, y = (
        helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in zip("xy", shapes, strict=True)
    )
    graph = helper.make_graph(nodes, "mean", [x], [y], numbers)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.save(model, path)
    return path


class Mean(nn.Module):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x.mean(1)


def write_script(path: Path) -> Path:
    torch.jit.trace(Mean(), torch.rand(1, 3, *SIZE)).save(str(path))
    return path


def images(count: int = 2) -> np.ndarray:
    return np.random.default_rng(1).uniform(0.2, 1, (count, 3, *SIZE)).astype(np.float32)


@pytest.mark.parametrize("kind", ["onnx", "ts"])
@pytest.mark.parametrize("output", ["depth", "log_depth", "disparity", "affine_disparity"])
def test_numbers_mean_what_is_said(tmp_path: Path, kind: str, output: str) -> None:
    path = write_onnx(tmp_path / "m.onnx") if kind == "onnx" else write_script(tmp_path / "m.ts")
    mean, std = (0.1, 0.0, -0.1), (0.5, 1.0, 2.0)
    options = ForeignOptions(output=output, mean=mean, std=std, height=SIZE[0], width=SIZE[1], run_code=True)
    batch = images()
    given = ((batch - np.array(mean)[:, None, None]) / np.array(std)[:, None, None]).mean(1)
    expected = {"depth": 1 / given, "log_depth": np.exp(-given)}.get(output, given)
    predictor = load(path, foreign=options)
    np.testing.assert_allclose(predictor.disparity(batch), expected, rtol=1e-5)
    metric = predictor.predict(np.full((20, 30, 3), 255, np.uint8)).metric
    assert metric == (output in ("depth", "log_depth"))
    assert ("unknown shift" in predictor.unit) == (output == "affine_disparity")


def test_affine_disparity_is_raw_for_alignment_positive_for_people_and_metric_with_its_numbers(tmp_path: Path) -> None:
    path = write_onnx(tmp_path / "m.onnx", gain=2.0, bias=-1.5)
    batch = images()
    raw = 2 * batch.mean(1) - 1.5
    assert (raw < 0).any()
    relative = ForeignPredictor(path, ForeignOptions(output="affine_disparity"))
    np.testing.assert_allclose(relative.raw_disparity(batch), raw, rtol=1e-4, atol=1e-6)
    assert relative.disparity(batch).min() > 0
    known = ForeignPredictor(path, ForeignOptions(output="affine_disparity", factor=0.1, shift=0.2))
    np.testing.assert_allclose(known.disparity(batch), 0.1 * raw + 0.2, rtol=1e-4)
    assert known.scale is not None
    assert not known.shifted


def test_flip_blends_and_changes_the_fingerprint(tmp_path: Path) -> None:
    path = write_onnx(tmp_path / "m.onnx")
    one, two = (ForeignPredictor(path, ForeignOptions(output="disparity"), flip=flip) for flip in (False, True))
    batch = images()
    np.testing.assert_allclose(one.disparity(batch), two.disparity(batch), rtol=1e-5)  # a mean sees no left and right
    assert one.fingerprint != two.fingerprint


def test_sizes_are_the_files_the_users_or_the_presets(tmp_path: Path) -> None:
    free, fixed = write_onnx(tmp_path / "free.onnx", size=("h", "w")), write_onnx(tmp_path / "fixed.onnx")
    assert (ForeignPredictor(fixed, ForeignOptions(output="depth")).height) == SIZE[0]
    assert ForeignPredictor(fixed, ForeignOptions(preset="midas")).width == SIZE[1]
    assert ForeignPredictor(free, ForeignOptions(preset="depth_anything")).height == 518
    own = ForeignPredictor(free, ForeignOptions(preset="depth_anything", height=28, width=56), keep_aspect=True)
    assert own.input_size(100, 100) == (42, 42)
    with pytest.raises(ConfigError, match=r"any size; set foreign\.height"):
        ForeignPredictor(free, ForeignOptions(output="depth"))
    with pytest.raises(ConfigError, match=r"8x12 .* only"):
        ForeignPredictor(fixed, ForeignOptions(output="depth", height=16, width=24))
    with pytest.raises(ConfigError, match="leave keep_aspect out"):
        ForeignPredictor(fixed, ForeignOptions(output="depth"), keep_aspect=True)
    with pytest.raises(ConfigError, match="nearest valid size is 28x56"):
        ForeignPredictor(free, ForeignOptions(preset="depth_anything", height=30, width=56))


def test_what_is_not_said_or_not_allowed_is_one_sentence(tmp_path: Path) -> None:
    path, script = write_onnx(tmp_path / "m.onnx"), write_script(tmp_path / "m.pt")
    assert is_foreign(script)
    with pytest.raises(CheckpointError, match=r"not one that saunet exported.*foreign\.preset"):
        load(path)
    with pytest.raises(ConfigError, match=r"another system; say what it is with foreign\.preset=depth_anything"):
        load(script)
    with pytest.raises(ConfigError, match=r"a program that could do anything.*foreign\.run_code=true"):
        load(script, foreign=ForeignOptions(preset="midas"))
    with pytest.raises(ConfigError, match="neither"):
        load(tmp_path / "model.ckpt", foreign=ForeignOptions(preset="midas"))
    with pytest.raises(ConfigError, match="did you mean 'midas'"):
        ForeignOptions(preset="mides")
    with pytest.raises(ConfigError, match="belong together"):
        ForeignOptions(height=5)
    with pytest.raises(ConfigError, match="three numbers"):
        ForeignOptions(std=(1.0, 0.0, 1.0))
    (tmp_path / "broken.ts").write_bytes(b"nothing")
    with pytest.raises(CheckpointError, match="not a TorchScript file"):
        load(tmp_path / "broken.ts", foreign=ForeignOptions(preset="midas", run_code=True))


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_whole(name: str) -> None:
    preset = PRESETS[name]
    assert preset.output is not None
    assert preset.height is not None
    assert preset.height % (preset.multiple or 1) == 0
    assert not preset.run_code


def test_evaluated_under_protocols_that_can_align_it(tmp_path: Path) -> None:
    path = write_onnx(tmp_path / "m.onnx", gain=1.0, bias=-0.4)
    data = Spec.of("data", "synthetic_tiny", frames_per_drive=2)
    options = {"data": data, "checkpoint": str(path), "baselines": False, "device": "cpu"}
    result = evaluate(EvaluateOptions(**options, foreign=ForeignOptions(output="affine_disparity")))
    assert [rules.name for rules in result.protocols] == ["synthetic/least_squares_disparity"]
    assert result.settings["foreign"]["output"] == "affine_disparity"
    # Any gain and shift of the model give the same errors, for they are fitted.
    other = write_onnx(tmp_path / "n.onnx", gain=-3.0, bias=5.0)
    again = evaluate(
        EvaluateOptions(**{**options, "checkpoint": str(other)}, foreign=ForeignOptions(output="affine_disparity"))
    )
    for first, second in zip(result.rows, again.rows, strict=True):
        assert first.errors == pytest.approx(second.errors, rel=1e-4)
    with pytest.raises(ConfigError, match="unknown shift"):
        evaluate(
            EvaluateOptions(**options, protocols=("synthetic",), foreign=ForeignOptions(output="affine_disparity"))
        )
    scaled = evaluate(
        EvaluateOptions(**options, protocols=("synthetic",), foreign=ForeignOptions(preset="ultralytics_depth"))
    )
    assert scaled.rows[0].pixels > 0
    scale = ScaleOptions(method="stored")
    measuring = EvaluateOptions(**options, foreign=ForeignOptions(output="depth"), scale=scale)
    with pytest.raises(ConfigError, match=r"scale\.method=stored"):
        runs_alone(measuring)


def test_predicts_files(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "road.png"), np.full((20, 30, 3), 128, np.uint8))
    path = write_onnx(tmp_path / "m.onnx", gain=10.0)
    options = PredictOptions(
        checkpoint=path,
        input=str(tmp_path / "road.png"),
        output=tmp_path / "out",
        outputs=["npy"],
        foreign=ForeignOptions(output="depth"),
        device="cpu",
    )
    predict(options)
    (written,) = (tmp_path / "out").glob("*.npy")
    np.testing.assert_allclose(np.load(written), 10 * 128 / 255, rtol=1e-5)
