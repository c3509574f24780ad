"""Metric scale on the command line: measured, reported, applied, stored, and refused in one sentence."""

from __future__ import annotations

import inspect
import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import yaml
from videos import write_video

import saunet
from saunet.data.video.camera import CameraFile, write_camera
from saunet.errors import CheckpointError, ConfigError, DataError
from saunet.evaluation.tool import EvaluateOptions, _odometer, _scaled
from saunet.geometry.pose import pose_matrix
from saunet.io.images import write_image
from saunet.prediction.pointcloud import Camera
from saunet.prediction.prediction import ImagePredictor
from saunet.prediction.scaling import apply_scale as scale_predictor
from saunet.registry import Spec
from saunet.runs.checkpoint import read_checkpoint
from saunet.runs.record import Scale
from saunet.scale.estimate import ScaleEstimate, keep_scale
from saunet.scale.options import ScaleOptions
from saunet.scale.storing import scale_file, store_scale
from saunet.synthetic import SyntheticDrive
from saunet.weights import locate

Tool = Callable[..., Any]
UNKNOWN = 0.037


class TrueDepth(ImagePredictor):
    """Knows the depth of a drive's frames by heart, in a unit of its own."""

    def __init__(self, drive: SyntheticDrive) -> None:
        super().__init__(64, 192)
        self.drive = drive
        self.seen = [drive.image(i).transpose(2, 0, 1) for i in drive.indices]

    def disparity(self, images: Any) -> Any:
        found = []
        for image in np.rint(255 * images):
            index = int(np.argmin([np.abs(image - known).mean() for known in self.seen]))
            depth = self.drive.depth(index)
            found.append(1 / (UNKNOWN * np.where(depth > 0, depth, 1000.0)))
        return np.array(found, np.float32)

    @property
    def fingerprint(self) -> str:
        return "true"


@pytest.fixture(scope="module")
def street() -> SyntheticDrive:
    return SyntheticDrive(seed=31, frames=3, height=64, width=192)


@pytest.fixture
def recording(street: SyntheticDrive, tmp_path: Path) -> Path:
    """Both cameras' frames as folders."""
    for drive, folder in ((street, "left"), (street.stereo(), "right")):
        (tmp_path / folder).mkdir()
        for index in drive.indices:
            cv2.imwrite(str(tmp_path / folder / f"{index}.png"), drive.image(index)[..., ::-1])
    return tmp_path


def measure(
    recording: Path,
    street: SyntheticDrive,
    predictor: ImagePredictor,
    source: Any = None,
    camera: Any = "true",
    **scale: Any,
) -> None:
    K = street.intrinsics()
    known = Camera(K, 64, 192) if camera else None
    folder = recording / "out"
    scale_predictor(ScaleOptions(**scale), predictor, source or str(recording / "left"), known, folder, "unused.ckpt")


def test_the_height_in_a_camera_file_counts_unless_another_is_given(recording: Path, street: SyntheticDrive) -> None:
    (recording / "camera.yaml").write_text(
        yaml.safe_dump({"image_size": [192, 64], "K": street.intrinsics().tolist(), "camera_height": 1.65})
    )
    for given, height in ((None, 1.65), (3.3, 3.3)):
        options = saunet.PredictOptions(
            checkpoint="unused.ckpt", input=recording / "left", output=recording / f"out{height}", outputs=["npy"],
            camera=recording / "camera.yaml", scale=ScaleOptions(method="camera_height", camera_height=given),
        )  # fmt: skip
        predictor = TrueDepth(street)
        saunet.predict(options, predictor)
        assert predictor.scale is not None
        assert predictor.scale.factor == pytest.approx(height / 1.65 / UNKNOWN, rel=0.03)


@pytest.mark.parametrize(
    ("scale", "tolerance"),
    [
        ({"method": "camera_height", "camera_height": 1.65}, 0.03),
        ({"method": "stereo", "stereo": "right", "baseline": 0.54}, 0.08),
    ],
)
def test_predict_finds_the_unknown_factor(
    recording: Path, street: SyntheticDrive, scale: dict[str, Any], tolerance: float, capsys: Any
) -> None:
    if "stereo" in scale:
        scale = {**scale, "stereo": str(recording / scale["stereo"])}
    predictor = TrueDepth(street)
    measure(recording, street, predictor, **scale)
    assert predictor.scale is not None
    assert predictor.scale.factor == pytest.approx(1 / UNKNOWN, rel=tolerance)
    said = capsys.readouterr().out
    assert "middle half" in said
    assert "known to about" in said
    assert "measure on more frames" in said
    assert "scale.store=true keeps it" in said
    report = json.loads((recording / "out" / "scale.json").read_text())
    assert report["factor"] == predictor.scale.factor
    assert report["frames"] == 3
    true, found = street.depth(1), predictor.predict(recording / "left" / "1.png")
    near = (true > 0) & (true < 50)
    np.testing.assert_allclose(found.depth[near], true[near], rtol=tolerance)
    assert found.unit.startswith("meters (scale from ")


@pytest.mark.parametrize(
    ("scale", "message"),
    [
        ({"method": "hight"}, r"scale.method is 'hight'.*allowed: auto, none, stored, camera_height, speed, stereo"),
        ({"method": "camera_height"}, r"needs scale.camera_height"),
        ({"method": "stereo"}, r"scale.method=stereo needs scale.stereo: the other camera's images"),
        ({"method": "stored"}, r"the checkpoint stores no scale; measure one"),
        ({"method": "auto", "store": True}, r"scale.store=true stores what is measured and scale.method is 'auto'"),
        ({"method": "none", "frames": 0}, r"scale.frames is 0"),
        ({"method": "speed", "fps": 0.0}, r"scale.fps is 0.0"),
        (
            {"camera_height": 1.65},
            r"scale.camera_height is set and scale.method is 'auto'.*scale.method=camera_h",
        ),
        ({"method": "speed", "baseline": 0.5}, r"scale.baseline is set and scale.method is 'speed'"),
    ],
)
def test_what_is_missing_is_one_sentence(
    recording: Path, street: SyntheticDrive, scale: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message) as raised:
        measure(recording, street, TrueDepth(street), **scale)
    assert "\n" not in str(raised.value)


def test_camera_height_needs_the_camera(recording: Path, street: SyntheticDrive) -> None:
    with pytest.raises(ConfigError, match=r"needs camera: camera\.yaml, or \[fx,fy,cx,cy\] in pixels of the images"):
        measure(recording, street, TrueDepth(street), camera=None, method="camera_height", camera_height=1.65)


def test_a_live_camera_is_not_measured(recording: Path, street: SyntheticDrive) -> None:
    with pytest.raises(ConfigError, match="needs a whole recording, which a live camera does not have"):
        measure(recording, street, TrueDepth(street), source="0", method="camera_height", camera_height=1.65)


def test_stored_scale_is_used_or_left_out(recording: Path, street: SyntheticDrive) -> None:
    for method, expected in (("auto", 2.0), ("stored", 2.0), ("none", None)):
        predictor = TrueDepth(street)
        predictor.scale = Scale(2.0, "speed")
        measure(recording, street, predictor, method=method)
        assert (predictor.scale and predictor.scale.factor) == expected


@pytest.fixture
def checkpoint(smoke_run: Path, tmp_path: Path) -> Path:
    path = tmp_path / "model.ckpt"
    shutil.copyfile(smoke_run / "checkpoints" / "last.ckpt", path)
    return path


def test_a_stored_scale_changes_nothing_else(checkpoint: Path) -> None:
    before = read_checkpoint(checkpoint)
    store_scale(checkpoint, Scale(3.0, "speed"))
    after = read_checkpoint(checkpoint)
    assert after.record.scale == Scale(3.0, "speed")
    assert after.global_step == before.global_step
    assert all((after.state[key] == value).all() for key, value in before.state.items())
    with pytest.raises(CheckpointError, match="no checkpoint at"):
        store_scale(checkpoint.with_name("nowhere.ckpt"), Scale(3.0, "speed"))


def test_predict_stores_what_it_measures(
    recording: Path, street: SyntheticDrive, checkpoint: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    predictor, K = TrueDepth(street), Camera(street.intrinsics(), 64, 192)
    options = ScaleOptions(method="camera_height", camera_height=1.65, store=True)
    source, folder, store_in = str(recording / "left"), recording / "out", options.storable(checkpoint)
    scale_predictor(options, predictor, source, K, folder, checkpoint, store_in=store_in)
    assert read_checkpoint(checkpoint).record.scale == predictor.scale
    said = capsys.readouterr().out
    assert f"stored in {checkpoint}" in said
    assert "scale.store=true" not in said


def test_only_who_could_keep_a_factor_is_told_how(checkpoint: Path, capsys: pytest.CaptureFixture[str]) -> None:
    estimate = ScaleEstimate("camera_height", "camera height 1.65 m", ("frame 0",), (2.0,), 0)
    keep_scale(estimate, checkpoint, None, None)
    assert "scale.store=true keeps it" in capsys.readouterr().out
    keep_scale(estimate, "street", None, None)
    assert "scale.store=true" not in capsys.readouterr().out


def test_an_exported_folder_keeps_a_factor(
    recording: Path, street: SyntheticDrive, checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    exported, K = tmp_path / "exported", street.intrinsics()
    saunet.export(saunet.ExportOptions(checkpoint=checkpoint, output=exported, formats=["safetensors"]))
    before = json.loads((exported / "config.json").read_text())
    scale = ScaleOptions(method="camera_height", camera_height=1.65, store=True)
    options = saunet.PredictOptions(
        checkpoint=exported, input=recording / "left", output=tmp_path / "out", outputs=["npy"], scale=scale,
        camera=[K[0, 0], K[1, 1], K[0, 2], K[1, 2]],
    )  # fmt: skip
    predictor = TrueDepth(street)
    saunet.predict(options, predictor)
    assert f"stored in {exported / 'config.json'}" in capsys.readouterr().out
    factor = predictor.scale.factor if predictor.scale else None
    after = json.loads((exported / "config.json").read_text())
    assert after == {**before, "scale": {"factor": factor, "source": "camera height 1.65 m"}}
    loaded = saunet.load(exported)
    assert loaded.scale == predictor.scale
    card = (exported / "README.md").read_text()
    assert f"Network depth x {factor:g} is meters; the factor comes from camera height 1.65 m." in card
    assert "| unit of depth | meters (scale from camera height 1.65 m) |" in card
    assert "relative" not in card


def test_what_cannot_keep_a_factor_is_said_before_anything_is_measured(
    tool: Tool, recording: Path, checkpoint: Path, tmp_path: Path
) -> None:
    exported = tmp_path / "exported"
    saunet.export(saunet.ExportOptions(checkpoint=checkpoint, output=exported, formats=["safetensors"]))
    (exported / "model.onnx").write_bytes(b"a network")
    scale = ("scale.method=camera_height", "scale.camera_height=1.65", "scale.store=true")
    predict = ("predict", "input=left", "output=out", "camera=[90]", *scale)
    evaluate = ("evaluate", "data=synthetic_tiny", "output_dir=out", *scale)
    for command in (predict, evaluate):
        tool(*command, "checkpoint=street").says(
            "'street' comes with saunet", "saunet export street output=mystreet formats=[safetensors]",
            "scale.store=true checkpoint=mystreet",
        )  # fmt: skip
        outcome = tool(*command, f"checkpoint={exported / 'model.onnx'}")
        outcome.says("a folder exported with formats=[safetensors]", "model.onnx is neither", "then export that again")
        assert "damaged" not in outcome.err
        tool(*command, f"checkpoint={exported}").says("not that of model.onnx beside it", "formats=[safetensors]")
    assert not (tmp_path / "out").exists()
    (exported / "model.safetensors").unlink()
    with pytest.raises(CheckpointError, match="exported is neither"):
        scale_file(exported)


def test_one_factor_is_not_stored_for_two_cameras(tool: Tool, checkpoint: Path, tmp_path: Path) -> None:
    drive = SyntheticDrive(seed=8, frames=5, height=64, width=192)
    for clip, height in (("a", 1.65), ("b", 1.4)):
        for index in drive.indices:
            write_image(tmp_path / "clips" / clip / f"{index}.png", drive.image(index))
        file = tmp_path / "clips" / clip / "camera.yaml"
        write_camera(file, CameraFile(file, drive.intrinsics(0), (64, 192), fps=10.0, camera_height=height))
    command = ("evaluate", f"checkpoint={checkpoint}", "data=video", "data.root=clips", "data.frames_cache=cache",
               "data.workers=0", "output_dir=results", "scale.method=camera_height", "scale.camera_height=1.65",
               "scale.store=true")  # fmt: skip
    outcome = tool(*command, "data.test_clips=[a,b]")
    outcome.says("one factor, which belongs to one camera", "'a' and 'b'", "data.test_clips=[a]")
    assert read_checkpoint(checkpoint).record.scale is None
    shutil.copyfile(tmp_path / "clips" / "a" / "camera.yaml", tmp_path / "clips" / "b" / "camera.yaml")
    outcome = tool(*command, "data.test_clips=[a,b]")  # now one camera, which an untrained network may not measure
    assert "belongs to one camera" not in outcome.err


def test_a_model_of_the_hub_keeps_no_factor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(locate, "_fetch", lambda name: tmp_path)
    with pytest.raises(ConfigError, match=r"comes from the hub and stays as it is.*saunet export hf://someone/model"):
        scale_file("hf://someone/model")


def test_evaluate_measures_stores_and_predict_uses_it(tool: Tool, checkpoint: Path, tmp_path: Path) -> None:
    common = (f"checkpoint={checkpoint}", "data=synthetic_tiny", "baselines=false", "output_dir=results")
    outcome = tool("evaluate", *common, "scale.method=speed", "scale.store=true")
    assert outcome.code == 0, outcome.err
    assert "from speed: median of 4 frames" in outcome.out
    assert f"stored in {checkpoint}" in outcome.out
    report = json.loads((tmp_path / "results" / "scale.json").read_text())
    stored = read_checkpoint(checkpoint).record.scale
    assert stored is not None
    assert stored.factor == report["factor"]
    outcome = tool("evaluate", *common)
    assert outcome.code == 0, outcome.err
    settings = json.loads((tmp_path / "results" / "metrics.json").read_text())["settings"]
    assert settings["scale"]["factor"] == stored.factor
    cv2.imwrite(str(tmp_path / "road.png"), np.full((64, 96, 3), 99, np.uint8))
    outcome = tool("predict", f"checkpoint={checkpoint}", "input=road.png", "output=out", "outputs=[npy]")
    assert outcome.code == 0, outcome.err
    assert "depth is meters (scale from speed)" in outcome.out


def test_evaluate_with_a_table_of_speeds_and_with_stereo(tool: Tool, checkpoint: Path, tmp_path: Path) -> None:
    common = (f"checkpoint={checkpoint}", "data=synthetic_tiny", "baselines=false", "output_dir=results")
    (tmp_path / "speeds.csv").write_text("frame,speed\n0,8\n5,8\n")
    outcome = tool("evaluate", *common, "scale.method=speed", "scale.speeds=speeds.csv")
    assert outcome.code == 0, outcome.err
    outcome = tool("evaluate", *common, "scale.method=stereo", "scale.frames=3")
    assert outcome.code == 0, outcome.err
    assert "from stereo baseline: median of" in outcome.out


class StraightOn(torch.nn.Module):
    """Predicts one unit of way to every source."""

    def forward(self, target: torch.Tensor, sources: torch.Tensor) -> torch.Tensor:
        ways = torch.tensor([0.0, 0.0, 1.0]).expand(*sources.shape[:2], 3)
        return pose_matrix(torch.zeros_like(ways), ways)


class Flat(torch.nn.Module):
    """A depth network that nobody asks."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.ones(1))


@pytest.mark.parametrize(("given", "rate"), [(None, 30), (60.0, 60)], ids=["as recorded", "as set"])
def test_speeds_of_a_clip_of_which_every_third_frame_is_used(given: float | None, rate: int, tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (30, 200, 3), dtype=np.uint8)
    world = cv2.resize(noise, (800, 120), interpolation=cv2.INTER_CUBIC)
    clip = tmp_path / "campus" / "a clip"
    clip.mkdir(parents=True)
    for number in range(45):
        cv2.imwrite(str(clip / f"{number:02}.png"), world[:, 4 * number : 4 * number + 240])
    K = np.array([[200.0, 0, 120], [0, 200, 60], [0, 0, 1]])
    write_camera(tmp_path / "campus" / "camera.yaml", CameraFile(tmp_path, K, (120, 240), fps=30.0))
    data = saunet.build(
        "data", "video", root=str(tmp_path / "campus"), fps=10.0, height=32, width=64, workers=0, val_share=0.4
    )
    data.setup("test")
    (tmp_path / "speeds.csv").write_text("frame,speed\n0,0\n44,44\n")  # a meter a second more with each frame
    scale = ScaleOptions(method="speed", speeds=str(tmp_path / "speeds.csv"), fps=given)
    options = EvaluateOptions(data=Spec({}), checkpoint="x", scale=scale, output_dir=str(tmp_path / "out"))
    record = SimpleNamespace(scale=None, offsets=(-1, 1), intrinsics=None)
    inspect.unwrap(_scaled)(options, record, (Flat(), StraightOn()), data, torch.device("cpu"), first=True)
    found = json.loads((tmp_path / "out" / "scale.json").read_text())["per_frame"]
    (drive,) = data.datasets["test"].drives
    assert len(found) >= 3
    for name, factor in found.items():
        before, after = (int(drive.path(int(name.split()[-1]) + step).stem) for step in (-1, 1))
        assert after - before == 6
        assert factor == pytest.approx((after**2 - before**2) / 2 / rate / 2)  # the way to both, over two units


def test_speeds_of_other_drives_are_one_sentence(tool: Tool, checkpoint: Path, tmp_path: Path) -> None:
    (tmp_path / "speeds.csv").write_text("drive,frame,speed\nelsewhere,0,8\nelsewhere,5,8\n")
    common = (f"checkpoint={checkpoint}", "data=synthetic_tiny", "baselines=false", "output_dir=results")
    outcome = tool("evaluate", *common, "scale.method=speed", "scale.speeds=speeds.csv")
    outcome.says("speeds of the drives elsewhere, which are not needed; call them synthetic/020000")


@pytest.mark.parametrize("offsets", ["[]", "[-1,1]"])
def test_stereo_trainings_are_config_swaps(tool: Tool, offsets: str, tmp_path: Path) -> None:
    outcome = tool(
        "train",
        "experiment=smoke",
        "model/pose=posecnn",
        "data.stereo=true",
        f"data.offsets={offsets}",
        "logger=none",
        "output_dir=run",
    )
    assert outcome.code == 0, outcome.err
    record = read_checkpoint(tmp_path / "run" / "checkpoints" / "last.ckpt").record
    assert (record.pose is None) == (offsets == "[]")
    assert record.scale == Scale(1.0, "stereo training")


def test_no_source_at_all_is_one_sentence(tool: Tool) -> None:
    outcome = tool("train", "experiment=smoke", "data.offsets=[]")
    assert outcome.code == 1
    assert "data.offsets is empty and data.stereo is false" in outcome.err


def test_a_table_over_time_is_read_at_the_times_of_the_frames(tmp_path: Path) -> None:
    """20 frames a second, then 5: by the mean rate of 8, frame 10 would be at 1.25 s and not at 0.5 s."""
    (tmp_path / "r").mkdir()
    times = [*np.arange(10) / 20, *(0.5 + np.arange(10) / 5)]
    write_video(tmp_path / "r" / "a.mp4", 20, times=times)
    (tmp_path / "r" / "camera.yaml").write_text("image_size: [128, 96]\nK: [110, 110, 63.5, 47.5]\n")
    common = {"fps": None, "static": "keep", "workers": 0, "frames_cache": str(tmp_path / "cache"), "val_share": 0.0}
    data = saunet.build("data", "video", root=str(tmp_path / "r"), height=32, width=64, test_clips=["a.mp4"], **common)
    data.setup("test")
    (drive,) = data.datasets["test"].drives
    (tmp_path / "speeds.csv").write_text("time,speed\n0,0\n10,100\n")  # 10 m/s more each second
    scale = ScaleOptions(method="speed", speeds=str(tmp_path / "speeds.csv"))
    options = EvaluateOptions(data=Spec({}), checkpoint="x", scale=scale)
    assert _odometer(options, data)(drive, 8, 12) == pytest.approx(5 * (0.9**2 - 0.4**2), rel=1e-3)
    assert _odometer(options, data)(drive, 12, 8) == pytest.approx(5 * (0.9**2 - 0.4**2), rel=1e-3)
    with pytest.raises(ConfigError, match=r"data\.align_speeds=true"):
        _odometer(replace(options, scale=replace(scale, align=True)), data)


class OfTheColumn(torch.nn.Module):
    """A pose network that says how far the bright column has moved."""

    def forward(self, target: torch.Tensor, sources: torch.Tensor) -> torch.Tensor:
        columns = [image.mean((-3, -2)).argmax(-1).float() for image in (target[:, None], sources)]
        ways = torch.zeros(*sources.shape[:2], 3)
        ways[..., 2] = (columns[1] - columns[0]).abs() / 4
        return pose_matrix(torch.zeros_like(ways), ways)


def test_a_table_of_another_clock_is_aligned_by_the_pose_network(
    street: SyntheticDrive, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The column moves by whole pixels, four a unit, two units a meter, 5 frames a second; Unix time 70 s ahead."""
    at = np.arange(0, 60, 0.2)
    speed = np.interp(at, [0, 6, 9, 15, 18, 27, 29, 40, 43, 52, 60], [2, 2, 10, 10, 5, 5, 0, 0, 8, 8, 3])
    frames = []
    for place in np.cumsum(0.2 * 2 * 4 * speed).round().astype(int) % 300:
        picture = np.zeros((20, 320, 3), np.uint8)
        picture[:, place : place + 1] = 255
        frames.append(picture)
    video = write_video(tmp_path / "a.mp4", frames, fps=5, codec="libx264rgb", pixels="rgb24", options={"crf": "0"})
    ticks = np.arange(-10, 75, 0.5)
    lines = [
        f"{tick + 1_700_000_070:.2f},{value:.3f}"
        for tick, value in zip(ticks, np.interp(ticks, at, speed), strict=True)
    ]
    (tmp_path / "speeds.csv").write_text("\n".join(["time,speed", *lines]))
    model = SimpleNamespace(networks=lambda: (None, OfTheColumn()), record=SimpleNamespace(offsets=(-1, 1)))
    monkeypatch.setattr("saunet.weights.files.read_model", lambda checkpoint: model)
    predictor = TrueDepth(street)
    predictor.height, predictor.width = 20, 320
    options = ScaleOptions(method="speed", speeds=str(tmp_path / "speeds.csv"), align=True)
    scale_predictor(options, predictor, video, None, tmp_path, "x")
    said = re.search(r"its clock is \+(\S+) s off that of the frames", capsys.readouterr().out)
    assert float(said[1]) == pytest.approx(1_700_000_070, abs=0.3)
    assert predictor.scale.factor == pytest.approx(0.5, rel=0.1)
    with pytest.raises(DataError, match=r"scale\.align=true if their clock"):
        scale_predictor(replace(options, align=False), predictor, video, None, tmp_path, "x")
    with pytest.raises(ConfigError, match=r"scale\.align is set and scale\.method is 'none'"):
        ScaleOptions(method="none", align=True)
