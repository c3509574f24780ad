"""The camera.yaml that belongs to what is predicted: found, passed over, and refused where there are several."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from predicting import run

import saunet
from saunet.data.video.camera import CameraFile, write_camera
from saunet.errors import ConfigError
from saunet.io.images import write_image
from saunet.prediction.predictor import Predictor
from saunet.scale.options import ScaleOptions


def describe(path: Path, focal: float, distortion: tuple[float, ...] = ()) -> None:
    K = np.array([[focal, 0, 44.5], [0, focal, 19.5], [0, 0, 1]])
    write_camera(path, CameraFile(path, K, (40, 90), distortion))


@pytest.fixture
def clips(tmp_path: Path) -> Path:
    """Two clips of one camera, whose file lies above both."""
    rng = np.random.default_rng(0)
    for clip in ("a", "b"):
        for index in range(2):
            write_image(tmp_path / "clips" / clip / f"{index}.png", rng.integers(0, 255, (40, 90, 3), dtype=np.uint8))
    describe(tmp_path / "clips" / "camera.yaml", 80.0)
    return tmp_path / "clips"


def cloud(folder: Path, stem: str) -> bytes:
    return (folder / f"{stem}_points.ply").read_bytes()


@pytest.mark.parametrize("named", ["clips", "clips/a", "clips/a/0.png", "clips/a/*.png"])
def test_the_nearest_file_up_to_the_input_is_found(
    predictor: Predictor, clips: Path, named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, stem = str(tmp_path / named), "a/0" if named == "clips" else "0"
    run(predictor, source, tmp_path / "found", ["ply"])
    assert capsys.readouterr().out.count(f"camera: {clips / 'camera.yaml'}\n") == 1
    run(predictor, source, tmp_path / "given", ["ply"], camera=clips / "camera.yaml")
    assert cloud(tmp_path / "found", stem) == cloud(tmp_path / "given", stem)
    describe(clips / "a" / "camera.yaml", 60.0)
    run(predictor, clips / "a", tmp_path / "nearer", ["ply"])
    assert f"camera: {clips / 'a' / 'camera.yaml'}" in capsys.readouterr().out
    assert cloud(tmp_path / "nearer", "0") != cloud(tmp_path / "given", stem)


def test_it_is_looked_for_only_where_it_is_needed(
    predictor: Predictor, clips: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    describe(clips / "camera.yaml", 80.0, (0.1, 0.0, 0.0, 0.0))
    run(predictor, clips, tmp_path / "depth", ["npy"])
    assert "camera:" not in capsys.readouterr().out
    shutil.move(clips / "camera.yaml", tmp_path)
    with pytest.raises(ConfigError, match=r"'ply', which needs the camera's true intrinsics.*camera\.yaml beside"):
        run(predictor, clips, tmp_path / "points", ["ply"])


def test_a_video_has_the_file_beside_it(
    predictor: Predictor, clips: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with saunet.io.video.VideoWriter(clips / "drive.mp4", 10.0) as video:
        for index in range(2):
            video.write(saunet.io.images.read_image(clips / "a" / f"{index}.png"))
    run(predictor, clips / "drive.mp4", tmp_path / "out", ["html"])
    assert f"camera: {clips / 'camera.yaml'}" in capsys.readouterr().out


def test_a_lens_with_distortion_leads_to_undistort(predictor: Predictor, clips: Path, tmp_path: Path) -> None:
    describe(clips / "camera.yaml", 80.0, (0.1, 0.0, 0.0, 0.0))
    for needs in ({"outputs": ["html"]}, {"scale": ScaleOptions(method="camera_height", camera_height=1.0)}):
        with pytest.raises(ConfigError, match=r"a lens with distortion.*undistort=.*camera\.yaml instead"):
            run(predictor, clips, tmp_path / "out", **needs)


def test_clips_of_different_cameras_are_not_given_one_of_them(
    predictor: Predictor, clips: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copyfile(clips / "camera.yaml", clips / "b" / "camera.yaml")
    run(predictor, clips, tmp_path / "same", ["ply"])  # one camera, described twice
    describe(clips / "b" / "camera.yaml", 60.0)
    for needs in ({"outputs": ["ply"]}, {"scale": ScaleOptions(method="camera_height", camera_height=1.0)}):
        with pytest.raises(ConfigError, match=r"needs one camera.*a: .*b: .*predict the clips of each camera"):
            run(predictor, clips, tmp_path / "out", **needs)
    assert not (tmp_path / "out").exists()
    capsys.readouterr()
    run(predictor, clips, tmp_path / "given", ["ply"], camera=clips / "camera.yaml")
    said = capsys.readouterr().out
    assert f"camera={clips / 'camera.yaml'} is used for every frame; passed over: {clips / 'b' / 'camera.yaml'}" in said
    run(predictor, clips / "a", tmp_path / "one", ["ply"], camera=clips / "camera.yaml")
    assert "passed over" not in capsys.readouterr().out
    run(predictor, clips / "a", tmp_path / "numbers", ["ply"], camera=[90])
    assert f"camera=[90] is used for every frame; passed over: {clips / 'camera.yaml'}" in capsys.readouterr().out
