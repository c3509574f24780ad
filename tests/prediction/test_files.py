"""Folders in, folders out: resumable, whole files only, originals untouched."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from predicting import run

from saunet.errors import ConfigError, DataError
from saunet.io.images import read_image, write_image
from saunet.models.depth import DepthNet
from saunet.prediction.pointcloud import Camera
from saunet.prediction.predictor import Predictor
from saunet.prediction.sinks import MANIFEST
from saunet.prediction.sources import find_sources
from saunet.prediction.tool import PredictOptions


def names(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def digest(folder: Path) -> dict[str, str]:
    return {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in names(folder)}


def test_folder_with_all_outputs(predictor: Predictor, folder: Path, tmp_path: Path) -> None:
    before = digest(folder)
    summary = run(predictor, folder, tmp_path / "out", ("color", "png16", "npy"), batch_size=2)
    stems = ["a", "b", "deep/c"]
    kinds = ["_depth.npy", "_depth.png", "_disparity.png"]
    assert names(tmp_path / "out") == sorted([stem + kind for stem in stems for kind in kinds] + [MANIFEST])
    assert len(summary.written) == 9
    assert (summary.skipped, summary.failures, summary.exit_code) == (0, (), 0)
    assert "before" not in str(summary)
    assert digest(folder) == before
    depth = np.load(tmp_path / "out" / "deep" / "c_depth.npy")
    assert np.allclose(depth, predictor.predict(folder / "deep" / "c.png").depth, rtol=1e-5)
    import cv2

    stored = cv2.imread(str(tmp_path / "out" / "deep" / "c_depth.png"), cv2.IMREAD_UNCHANGED)
    assert stored.dtype == np.uint16
    assert np.abs(stored / 256 - depth).max() <= 0.5 / 256 + 1e-5
    assert read_image(tmp_path / "out" / "a_disparity.png").shape == (40, 90, 3)


def test_pairs_are_read_back_as_training_data(predictor: Predictor, folder: Path, tmp_path: Path) -> None:
    from saunet.data.loading.module import DepthDataModule
    from saunet.registry import datamodules
    from saunet.runs.record import Scale

    out = tmp_path / "out"
    with pytest.raises(ConfigError, match=r"'pairs', which need depth in meters.*relative; set scale\.method"):
        run(predictor, folder, out, ("pairs",))
    assert not out.exists()
    predictor.scale = Scale(20.0, "camera height 1.65 m")
    summary = run(predictor, folder, out, ("pairs",), camera=[60, 60, 44.5, 19.5])
    stems = ("a", "b", "deep/c")
    files = [each for stem in stems for each in (f"images/{stem}.png", f"depth/{stem}.npy")]
    assert names(out) == sorted([*files, MANIFEST, "camera.yaml"])
    assert len(summary.written) == 6
    again = run(predictor, folder, out, ("pairs",), camera=[60, 60, 44.5, 19.5])
    assert (again.written, again.skipped) == ((), 3)
    (out / "depth" / "b.npy").unlink()
    assert len(run(predictor, folder, out, ("pairs",), camera=[60, 60, 44.5, 19.5]).written) == 2
    data = datamodules.build("pairs", root=str(out), height=32, width=64, batch_size=1, workers=0, val_drives=["*"])
    assert isinstance(data, DepthDataModule)
    data.setup("test")
    drives = {drive.name: drive for drive in data.datasets["test"].drives}
    assert list(drives) == ["images", "images/deep"]
    depth = drives["images/deep"].depth(0)
    assert np.array_equal(depth, predictor.predict(folder / "deep" / "c.png").depth)
    assert np.array_equal(drives["images"].image(0), read_image(folder / "a.png"))
    assert drives["images"].intrinsics(0)[0, 0] == 60


def test_second_run_skips_and_third_goes_on(predictor: Predictor, folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    run(predictor, folder, out)
    before = digest(out)
    again = run(predictor, folder, out)
    assert (again.written, again.skipped) == ((), 3)
    (out / "a_depth.png").unlink()
    more = run(predictor, folder, out)
    assert [path.name for path in more.written] == ["a_depth.png"]
    assert digest(out) == before
    assert len(run(predictor, folder, out, overwrite=True).written) == 6


def test_changed_image_is_predicted_again(predictor: Predictor, folder: Path, tmp_path: Path) -> None:
    run(predictor, folder, tmp_path / "out")
    write_image(folder / "a.png", np.zeros((8, 8, 3), np.uint8))
    import os

    future = (tmp_path / "out" / "a_depth.png").stat().st_mtime + 10
    os.utime(folder / "a.png", (future, future))
    assert len(run(predictor, folder, tmp_path / "out").written) == 2


def test_interrupt_leaves_whole_files_and_resumes(
    predictor: Predictor, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, calls = tmp_path / "out", []
    original = predictor.predict_batch

    def interrupted(images: Any, names: Any = None) -> Any:
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return original(images, names)

    monkeypatch.setattr(predictor, "predict_batch", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(predictor, folder, out)
    assert names(out) == ["a_depth.png", "a_disparity.png", "b_depth.png", "b_disparity.png", MANIFEST]
    assert run(predictor, folder, out).skipped == 2
    assert len(names(out)) == 7


def test_broken_images_are_reported_and_the_rest_is_done(predictor: Predictor, folder: Path, tmp_path: Path) -> None:
    (folder / "0_broken.png").write_bytes(b"nothing")
    (folder / "z_empty.jpg").touch()
    summary = run(predictor, folder, tmp_path / "out", batch_size=2)
    assert len(summary.written) == 6
    assert len(summary.failures) == 2
    assert "0_broken.png is not an image" in summary.failures[0]
    with pytest.raises(DataError, match=r"0_broken\.png is not an image"):
        run(predictor, folder / "0_broken.png", tmp_path / "other")
    assert not (tmp_path / "other").exists()


def test_camera_numbers_belong_to_the_first_image_that_can_be_read(
    predictor: Predictor, folder: Path, tmp_path: Path
) -> None:
    (folder / "0_broken.png").write_bytes(b"nothing")
    numbers = (80.0, 80.0, 44.5, 19.5)
    assert len(run(predictor, folder, tmp_path / "out", ["ply"], camera=numbers).written) == 3
    with pytest.raises(DataError, match=r"0_broken\.png is not an image"):
        run(predictor, folder / "0_broken.png", tmp_path / "other", ["ply"], camera=numbers)
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize("pattern", ["", "frame_*.png"])
def test_frames_come_in_the_order_of_their_numbers(picture: NDArray[np.uint8], tmp_path: Path, pattern: str) -> None:
    for number in range(1, 13):
        write_image(tmp_path / "in" / f"frame_{number}.png", picture)
    found = find_sources(tmp_path / "in" / pattern, tmp_path / "out")
    assert [source.stem for source in found] == [f"frame_{number}" for number in range(1, 13)]


def test_stamps_of_seconds_come_in_order_of_time(picture: NDArray[np.uint8], tmp_path: Path) -> None:
    stamps = ["1403636579.5", "1403636579.55", "1403636579.6", "1403636579.65", "1403636579.7"]  # .5 < .55, .6 < .65
    for stamp in stamps:
        write_image(tmp_path / "in" / f"{stamp}.png", picture)
    assert [source.stem for source in find_sources(tmp_path / "in", tmp_path / "out")] == stamps


def test_links_are_followed_and_files_of_other_programs_skipped(picture: NDArray[np.uint8], tmp_path: Path) -> None:
    folder = tmp_path / "in"
    for name in ("store/0.png", "in/drive/1.png", "in/drive/@eaDir/1.png/SYNOPHOTO_THUMB_M.jpg",
                 "in/drive/.ipynb_checkpoints/1-checkpoint.png", "in/__MACOSX/1.png"):  # fmt: skip
        write_image(tmp_path / name, picture)
    (folder / "drive" / "._1.png").write_bytes(b"\0\5\x16\7\0\2\0\0Mac OS X        ")
    (folder / "linked").symlink_to(tmp_path / "store")
    (folder / "drive" / "again").symlink_to(folder)  # a circle
    assert [source.stem for source in find_sources(folder, tmp_path / "out")] == ["drive/1", "linked/0"]


def test_single_image_glob_and_several(predictor: Predictor, folder: Path, tmp_path: Path) -> None:
    assert len(run(predictor, folder / "a.png", tmp_path / "1").written) == 2
    assert len(run(predictor, str(folder / "**" / "*.png"), tmp_path / "2").written) == 4
    assert (tmp_path / "2" / "deep" / "c_depth.png").exists()
    both = run(predictor, [folder / "a.png", str(folder / "*.jpg")], tmp_path / "3", ["npy"])
    assert [path.name for path in both.written] == ["a_depth.npy", "b_depth.npy"]


def test_same_name_with_two_endings(
    predictor: Predictor, folder: Path, tmp_path: Path, picture: NDArray[np.uint8]
) -> None:
    write_image(folder / "a.jpg", picture)
    run(predictor, folder, tmp_path / "out", ["color"])
    assert "a_jpg_disparity.png" in names(tmp_path / "out")
    assert "a_png_disparity.png" in names(tmp_path / "out")


def test_output_below_the_input_is_not_read_back(predictor: Predictor, folder: Path) -> None:
    run(predictor, folder, folder / "depth")
    assert run(predictor, folder, folder / "depth").skipped == 3


def test_point_clouds(predictor: Predictor, folder: Path, tmp_path: Path) -> None:
    camera = Camera.from_numbers((80.0, 80.0, 44.5, 19.5), 40, 90)
    with pytest.raises(ConfigError, match="'ply', which needs the camera's true intrinsics"):
        run(predictor, folder, tmp_path / "out", ["ply"])
    summary = run(predictor, folder / "a.png", tmp_path / "out", ["ply"], camera=camera)
    assert [path.name for path in summary.written] == ["a_points.ply"]
    assert b"comment unit: relative" in summary.written[0].read_bytes()
    numbers = run(predictor, folder, tmp_path / "2", ["ply"], camera=(80.0, 80.0, 44.5, 19.5))
    assert numbers.written[0].read_bytes() == summary.written[0].read_bytes()
    with pytest.raises(ConfigError, match="intrinsics have 3 numbers"):
        run(predictor, folder, tmp_path / "3", ["ply"], camera=(80.0, 80.0, 44.5))
    assert not (tmp_path / "3").exists()
    other = Camera.from_numbers((90.0, 80.0, 44.5, 19.5), 40, 90)
    with pytest.raises(ConfigError, match=r"made with different settings \(camera\);"):
        run(predictor, folder / "a.png", tmp_path / "out", ["ply"], camera=other)


class TestRefused:
    def test_output_folder_of_the_originals(self, predictor: Predictor, folder: Path, tmp_path: Path) -> None:
        link = tmp_path / "link"
        link.symlink_to(folder)
        for output in (folder, link):
            with pytest.raises(ConfigError, match="contains the input images"):
                run(predictor, str(folder / "*.png"), output)
        assert names(folder) == ["a.png", "b.jpg", "deep/c.png"]

    def test_output_folder_that_is_the_input_folder(self, predictor: Predictor, folder: Path) -> None:
        """Results would lie among the originals of a deeper folder, and be predicted by the next run."""
        for original in ("a.png", "b.jpg"):
            (folder / original).unlink()
        for given in (folder, str(folder / "*" / "*.png"), [folder / "deep", folder]):
            with pytest.raises(
                ConfigError, match=r"contains the input images \(.*c\.png\); choose another, such as .*depth"
            ):
                run(predictor, given, folder)
        assert names(folder) == ["deep/c.png"]

    def test_results_that_would_lie_beside_an_original(
        self, predictor: Predictor, tmp_path: Path, picture: NDArray[np.uint8]
    ) -> None:
        for name in ("a/x.png", "a/a/y.png"):
            write_image(tmp_path / name, picture)
        with pytest.raises(ConfigError, match="contains the input images"):
            run(predictor, tmp_path / "a", tmp_path)

    def test_output_that_is_a_file(self, predictor: Predictor, folder: Path) -> None:
        with pytest.raises(ConfigError, match=r"a\.png is a file"):
            run(predictor, folder, folder / "a.png")

    @pytest.mark.parametrize(("name", "kind"), [("depth.mp4", "mp4"), ("depth.PNG", "color"), ("depth.npy", "npy")])
    def test_output_that_is_named_like_a_file(self, tmp_path: Path, name: str, kind: str) -> None:
        with pytest.raises(ConfigError, match=rf"is the folder .* output=\S+depth outputs=\[{kind}\]"):
            PredictOptions(input="in.mp4", output=tmp_path / name)
        (tmp_path / name).mkdir()
        PredictOptions(input="in.mp4", output=tmp_path / name)

    def test_inputs(self, predictor: Predictor, tmp_path: Path) -> None:
        (tmp_path / "empty").mkdir()
        for given, message in [
            (tmp_path / "empty", "no images in .*empty; looked for files ending in"),
            (tmp_path / "absent", "no file or folder at .*absent"),
            (str(tmp_path / "*.png"), r"no images in .*\*\.png"),
            ([], "no input given"),
        ]:
            with pytest.raises(DataError, match=message):
                run(predictor, given, tmp_path / "out")
        assert not (tmp_path / "out").exists()

    def test_two_images_for_one_result(self, folder: Path, tmp_path: Path, picture: NDArray[np.uint8]) -> None:
        write_image(tmp_path / "second" / "a.png", picture)
        with pytest.raises(ConfigError, match="would both be written as 'a_png'; predict them into different folders"):
            find_sources([folder, tmp_path / "second"], tmp_path / "out")

    def test_outputs_and_colormap(self, predictor: Predictor, folder: Path, tmp_path: Path) -> None:
        with pytest.raises(ConfigError, match="outputs is 'colour'; did you mean 'color'"):
            run(predictor, folder, tmp_path / "out", ["colour"])
        for said, meant in (("video", "mp4"), ("image", "color"), ("png", "png16")):
            with pytest.raises(ConfigError, match=f"outputs is '{said}'; did you mean '{meant}'"):
                run(predictor, folder, tmp_path / "out", [said])
        with pytest.raises(ConfigError, match="outputs is empty"):
            run(predictor, folder, tmp_path / "out", [])
        with pytest.raises(ConfigError, match="colormap is 'jet'"):
            run(predictor, folder, tmp_path / "out", colormap="jet")

    @pytest.mark.parametrize("max_depth", [0.0, float("inf")])
    def test_farthest_depth(self, predictor: Predictor, folder: Path, tmp_path: Path, max_depth: float) -> None:
        with pytest.raises(ConfigError, match="max_depth is"):
            run(predictor, folder, tmp_path / "out", max_depth=max_depth)
        assert not (tmp_path / "out").exists()

    def test_results_of_another_model(
        self, predictor: Predictor, network: DepthNet, folder: Path, tmp_path: Path
    ) -> None:
        run(predictor, folder, tmp_path / "out")
        other = Predictor(network, 32, 64, flip=True)
        with pytest.raises(
            ConfigError, match=r"made with different settings \(model or scale\); choose another output folder"
        ):
            run(other, folder, tmp_path / "out")
        with pytest.raises(ConfigError, match=r"made with different settings \(colormap\);"):
            run(predictor, folder, tmp_path / "out", colormap="turbo")
        run(other, folder, tmp_path / "out", overwrite=True)
        assert json.loads((tmp_path / "out" / MANIFEST).read_text())["model"] == other.fingerprint

    def test_damaged_manifest(self, predictor: Predictor, folder: Path, tmp_path: Path) -> None:
        (tmp_path / "out").mkdir()
        (tmp_path / "out" / MANIFEST).write_text("{")
        with pytest.raises(DataError, match=r"predictions\.json cannot be read"):
            run(predictor, folder, tmp_path / "out")

    def test_folder_that_cannot_be_written(self, predictor: Predictor, folder: Path, tmp_path: Path) -> None:
        (tmp_path / "file").touch()
        with pytest.raises(DataError, match="cannot write"):
            run(predictor, folder, tmp_path / "file" / "out")
