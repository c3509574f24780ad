"""``saunet evaluate`` and ``saunet odometry``: protocols side by side, predictions of other systems, paths."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from saunet.data.kitti.raw import KittiRaw
from saunet.io.images import write_image
from saunet.io.trajectories import read_kitti
from saunet.metrics.functional import ERROR_NAMES
from saunet.synthetic import SyntheticDrive

Tool = Callable[..., Any]
RAW = ("data=kitti", "data.split=all", "data.cameras=[left]", "data.workers=0", "baselines=false")


def checkpoint(run: Path) -> str:
    return f"checkpoint={run / 'checkpoints' / 'best.ckpt'}"


def results(folder: Path) -> dict[str, dict[str, Any]]:
    content = json.loads((folder / "metrics.json").read_text())
    return {row["protocol"]: row for row in content["results"] if row["predictor"] in ("model", "predictions")}


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_run_is_scored_on_its_own_data(tool: Tool, smoke_run: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    (run / "checkpoints").mkdir(parents=True)
    shutil.copy(smoke_run / "checkpoints" / "best.ckpt", run / "checkpoints")
    record = json.loads((smoke_run / "run.json").read_text())
    record["config"]["data"]["train_drives"] = 3  # as if given on the command line
    (run / "run.json").write_text(json.dumps(record))
    for source in (str(run), checkpoint(run)):
        outcome = tool("evaluate", source, "baselines=false", "output_dir=out")
        assert outcome.code == 0, outcome.err
        said = next(line for line in outcome.out.splitlines() if line.startswith("data: those of "))
        assert "run: data=synthetic_tiny" in said
        assert "data.train_drives=3" in said
        assert len(table(tmp_path / "out" / "per_image.csv")) == 6
    outcome = tool("evaluate", str(run), "output_dir=out")  # a baseline reads the training split
    assert "train (3 of 3 drives)" in outcome.err + outcome.out
    outcome = tool("evaluate", str(run), "data=synthetic_tiny", "baselines=false", "output_dir=out")
    assert "also has data.train_drives=3; without it, frames that it was trained on" in outcome.out
    outcome = tool("evaluate", str(run), "data=synthetic_tiny", "data.train_drives=3", "output_dir=out")
    assert "trained on" not in outcome.out + outcome.err


def test_a_run_on_the_data_set_of_a_plugin_names_it(tool: Tool, smoke_run: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(smoke_run, run)
    record = json.loads((run / "run.json").read_text())
    record["choices"]["data"] = "my_drives"
    record["overrides"] = ["plugins=[my_data.py]", "data=my_drives"]
    (run / "run.json").write_text(json.dumps(record))
    outcome = tool("evaluate", str(run), "output_dir=out")
    outcome.says("trained on data=my_drives", "add plugins=[my_data.py]", "or choose data=...")
    assert tool("evaluate", str(run), "data=synthetic_tiny", "output_dir=out").code == 0


def test_without_a_run_the_default_data_are_named(tool: Tool, smoke_run: Path, tmp_path: Path) -> None:
    shutil.copy(smoke_run / "checkpoints" / "best.ckpt", tmp_path / "alone.ckpt")
    few = ("data.frames_per_drive=3", "data.train_drives=1", "baselines=false")
    outcome = tool("evaluate", "alone.ckpt", *few, "output_dir=out")
    assert "data: rendered streets, data=synthetic; to score on others, give data=..." in outcome.out
    shutil.copy(smoke_run / "run.json", tmp_path)  # of the folder that the command happens to stand in
    assert "data: rendered streets" in tool("evaluate", "street", *few, "output_dir=out").out


def test_protocols_side_by_side_each_on_its_own_truth(
    tool: Tool, smoke_run: Path, raw_root: Path, tmp_path: Path
) -> None:
    outcome = tool(
        "evaluate",
        checkpoint(smoke_run),
        *RAW,
        f"data.root={raw_root}",
        "data.test_split=all",
        "protocols=[eigen_lidar_x,eigen_camera_z]",
        "truth_cache=truth",
        "buckets=true",
        "flip=true",
        "output_dir=out",
    )
    assert outcome.code == 0, outcome.err
    assert outcome.out.index("eigen_lidar_x") < outcome.out.index("eigen_camera_z")
    assert "±" in outcome.out
    assert "near an edge" in outcome.out
    found = results(tmp_path / "out")
    assert list(found) == ["eigen_lidar_x", "eigen_camera_z"]
    assert found["eigen_lidar_x"]["abs_rel"] != found["eigen_camera_z"]["abs_rel"]
    for row in found.values():
        assert row["abs_rel_low"] <= row["abs_rel"] <= row["abs_rel_high"]
        assert row["images"] == 12
    assert {row["protocol"] for row in table(tmp_path / "out" / "buckets.csv")} == set(found)
    assert len(list((tmp_path / "truth").rglob("*.npz"))) == 24
    settings = json.loads((tmp_path / "out" / "metrics.json").read_text())["settings"]
    assert settings["post_processing"] == "monodepth blend of two flips"


def test_an_array_in_the_order_of_a_list_of_frames(tool: Tool, raw_root: Path, tmp_path: Path) -> None:
    """Every prediction is right but for its own factor, which only the right order gives back to its image."""
    raw = KittiRaw(raw_root)
    name = next(iter(raw.drives))
    drive = raw.drive(name)
    frames = [3, 0, 5, 1]
    (tmp_path / "test_files.txt").write_text("".join(f"{name} {frame:010d} l\n" for frame in frames))
    truths = [drive.depth(frame) for frame in frames]
    factors = np.array([0.9, 0.7, 0.98, 0.8])  # below 1, so that the cap at 80 m does not bite
    disparities = [1 / np.where(t > 0, f * t, 1.0) for t, f in zip(truths, factors, strict=True) if t is not None]
    np.save(tmp_path / "disps.npy", np.stack(disparities).astype(np.float32))
    arguments = (
        "evaluate",
        "predictions=disps.npy",
        *RAW,
        f"data.root={raw_root}",
        "data.test_split=test_files.txt",
        "protocols=[metric]",
        "output_dir=out",
    )
    outcome = tool(*arguments)
    assert outcome.code == 0, outcome.err
    rows = table(tmp_path / "out" / "per_image.csv")
    assert [row["name"] for row in rows] == [f"{name} {frame:010d} l" for frame in frames]
    for row, factor in zip(rows, factors, strict=True):
        assert float(row["abs_rel"]) == pytest.approx(1 - factor, rel=1e-4)
    drive.depth_file(0).unlink()  # an image without ground truth is left out and does not shift the others
    assert tool(*arguments).code == 0
    left = table(tmp_path / "out" / "per_image.csv")
    assert [float(row["abs_rel"]) for row in left] == pytest.approx([0.1, 0.02, 0.2], rel=1e-4)


def test_exported_predictions_score_the_same_and_compare(tool: Tool, smoke_run: Path, tmp_path: Path) -> None:
    data = ("data=synthetic_tiny", "baselines=false")
    outcome = tool("evaluate", checkpoint(smoke_run), *data, "export=png", "output_dir=a")
    assert outcome.code == 0, outcome.err
    assert len(list((tmp_path / "png").glob("*.png"))) == 6
    outcome = tool("evaluate", "predictions=png", "match=name", *data, "compare=a", "output_dir=b")
    assert outcome.code == 0, outcome.err
    first, second = results(tmp_path / "a")["synthetic"], results(tmp_path / "b")["synthetic"]
    assert [second[name] for name in ERROR_NAMES] == pytest.approx([first[name] for name in ERROR_NAMES], rel=2e-3)
    assert "'predictions' minus 'model of a'" in outcome.out
    assert [row["error"] for row in table(tmp_path / "b" / "comparison.csv")] == list(ERROR_NAMES)


def test_exported_depth_is_scaled_by_the_first_protocol(
    tool: Tool, smoke_run: Path, raw_root: Path, tmp_path: Path
) -> None:
    arguments = (checkpoint(smoke_run), *RAW, f"data.root={raw_root}", "data.test_split=all")
    for folder, more in (("alone", ""), ("first", ",eigen_camera_z")):
        outcome = tool("evaluate", *arguments, f"protocols=[eigen_lidar_x{more}]", f"export={folder}", "output_dir=out")
        assert outcome.code == 0, outcome.err
        assert f"export: 12 images, scaled as in 'eigen_lidar_x'; in {folder}" in outcome.out
    alone, first = (
        {path.name: path.read_bytes() for path in (tmp_path / each).iterdir()} for each in ("alone", "first")
    )
    assert alone == first


def test_without_ground_truth_by_how_the_neighbors_are_explained(tool: Tool, smoke_run: Path, tmp_path: Path) -> None:
    outcome = tool(
        "evaluate", checkpoint(smoke_run), "data=synthetic_tiny", "protocols=[campus,synthetic]", "output_dir=out"
    )
    assert outcome.code == 0, outcome.err
    assert "explained ↑" in outcome.out
    rows = table(tmp_path / "out" / "views.csv")
    assert len(rows) == 4
    assert all(0 < float(row["warped"]) < 1 and 0 <= float(row["explained"]) <= 1 for row in rows)
    assert {row["condition"] for row in rows} == {"synthetic/020000"}
    assert results(tmp_path / "out")["synthetic"]["images"] == 6


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ((), "neither is set"),
        (("checkpoint=x.ckpt", "predictions=y.npy"), "both are set"),
        (("predictions=y.npy", "flip=true"), "leave it out with predictions"),
        (("predictions=y.npy", "baselines=false"), "no predictions at 'y.npy'"),
        (("predictions=y.npy", "protocols=[eigen_lidar]"), "did you mean 'eigen_lidar_x'?"),
        (("predictions=y.npy", "protocols=[campus]", "baselines=false"), "needs the motion of the camera"),
        # What is known to be wrong beforehand is said before anything is read.
        (("predictions=y.npy", "compare=nosuch"), "cannot read 'nosuch'"),
        (("predictions=y.npy", "intervals=95"), "intervals is 95; it must lie between 0 and 1, such as intervals=0.95"),
        (("predictions=y.npy", "output_dir=file/x"), "cannot write to file/x: "),
        (("predictions=y.npy", "predicted=disp"), "predicted is 'disp'"),
        (("predictions=y.npy", "device=gpu"), "device 'gpu' cannot be used here; available: cpu"),
        (("predictions=y.npy", "protocols=synthetik"), "did you mean 'synthetic'?"),  # one is a list of one
    ],
)
def test_what_cannot_be_evaluated(tool: Tool, overrides: tuple[str, ...], words: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    outcome = tool("evaluate", "data=synthetic_tiny", *overrides)
    assert outcome.code == 1
    assert "Traceback" not in outcome.err
    assert words in outcome.err
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("before", ["", "eigen_lidar_x,"], ids=["alone", "after another"])
def test_truth_that_the_data_cannot_give(tool: Tool, raw_root: Path, before: str) -> None:
    arguments = ("predictions=y.npy", *RAW, f"data.root={raw_root}", f"protocols=[{before}synthetic]")
    outcome = tool("evaluate", *arguments)
    outcome.says("protocols names 'synthetic', which is defined on 'exact' ground truth", "camera_z or lidar_x or impr")


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
@pytest.mark.parametrize("name", ["evaluate", "odometry", "predict"])
def test_a_gpu_that_is_not_there(tool: Tool, smoke_run: Path, tmp_path: Path, name: str) -> None:
    (tmp_path / "x.png").touch()
    data = ("input=x.png", "output=out") if name == "predict" else ("data=synthetic_tiny",)
    tool(name, checkpoint(smoke_run), *data, "device=cuda").says("device 'cuda' cannot be used here; available: cpu")
    assert [path.name for path in tmp_path.iterdir()] == ["x.png"]


def test_an_evaluation_of_other_images_is_not_compared(tool: Tool, smoke_run: Path, tmp_path: Path) -> None:
    (tmp_path / "per_image.csv").write_text(
        f"predictor,protocol,name,pixels,scale,{','.join(ERROR_NAMES)}\nmodel,metric,x 1 l,9,1,1,1,1,1,1,1,1\n"
    )
    arguments = (checkpoint(smoke_run), "data=synthetic_tiny", "baselines=false", "compare=per_image.csv")
    outcome = tool("evaluate", *arguments)
    assert outcome.code == 1
    assert "has no protocol in common with this evaluation (its protocols: metric)" in outcome.err
    (scores,) = tmp_path.rglob("metrics.json")  # what was computed is there all the same
    assert results(scores.parent)["synthetic"]["images"] == 6


def test_odometry_writes_paths_errors_and_a_picture(tool: Tool, smoke_run: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    outcome = tool("odometry", checkpoint(smoke_run), "data=synthetic_tiny", "output_dir=out")
    assert outcome.code == 0, outcome.err
    row, straight = json.loads((tmp_path / "out" / "odometry.json").read_text())["results"]
    assert (row["frames"], row["snippet"]) == (6, 5)
    assert straight["predictor"] == "constant motion straight ahead"
    assert (straight["sequence"], straight["frames"]) == (row["sequence"], 6)
    assert row["ate"] > 0
    (folder,) = (path for path in (tmp_path / "out").iterdir() if path.is_dir())
    names = {f"{kind}_{style}.txt" for kind in ("predicted", "aligned", "true") for style in ("kitti", "tum")}
    assert {path.name for path in folder.iterdir()} == names | {"path.png"} | {p.name for p in folder.glob(".hydra")}
    assert len(read_kitti(folder / "predicted_kitti.txt")) == 6
    assert "ATE" in outcome.out


def test_points_are_tracked_in_the_place_of_a_pose_network_where_that_is_asked_for(
    tool: Tool, smoke_run: Path, tmp_path: Path
) -> None:
    drive = SyntheticDrive(seed=8, frames=5, height=64, width=192)
    (tmp_path / "clip").mkdir()
    for index in drive.indices:
        write_image(tmp_path / "clip" / f"{index}.png", drive.image(index))
    K = drive.intrinsics(0)
    camera = f"camera=[{K[0, 0]},{K[1, 1]},{K[0, 2]},{K[1, 2]}]"
    paths = {}
    for motion in ("auto", "tracked"):
        common = (checkpoint(smoke_run), f"motion={motion}")
        outcome = tool("odometry", *common, "data=synthetic_tiny", f"output_dir=path_{motion}", "figure=false")
        assert outcome.code == 0, outcome.err
        assert ("requested by motion=tracked" in outcome.out) == (motion == "tracked")
        settings = json.loads((tmp_path / f"path_{motion}" / "odometry.json").read_text())["settings"]
        assert settings.get("motion") == (None if motion == "auto" else motion)
        predicted = tool("predict", "clip", *common, camera, f"output=out_{motion}", "outputs=[trajectory]")
        assert predicted.code == 0, predicted.err
        assert ("requested by motion=tracked" in predicted.out) == (motion == "tracked")
        paths[motion] = read_kitti(tmp_path / f"out_{motion}" / "clip_trajectory.txt")
    assert not np.allclose(paths["auto"], paths["tracked"], atol=1e-3)
    tool("predict", "clip", *common, "output=o", "outputs=[trajectory]").says("motion is 'tracked'", "set camera=")
    tool("predict", "clip", *common, "output=o").says("outputs has no trajectory", "outputs=[trajectory]")
    tool("odometry", checkpoint(smoke_run), "motion=points").says("motion is 'points'", "auto, tracked")


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("snippet=1", "snippet is 1; it counts frames and must be at least 2 (published numbers use 5)"),
        ("lengths=[-5,0]", "lengths is -5.0; it must be greater than 0"),
        ("batch_size=0", "batch_size is 0; it must be greater than 0"),
    ],
)
def test_odometry_checks_its_settings_before_the_data(
    tool: Tool, smoke_run: Path, tmp_path: Path, override: str, words: str
) -> None:
    outcome = tool("odometry", checkpoint(smoke_run), "data=kitti_odometry", "data.root=gone", "output_dir=o", override)
    outcome.says(words)
    assert not (tmp_path / "o").exists()


def test_odometry_runs_on_a_plain_install(
    tool: Tool, smoke_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without matplotlib, the default `figure=true` draws nothing and says so once."""
    monkeypatch.setattr("saunet.evaluation.paths.find_spec", lambda name: None)
    outcome = tool("odometry", checkpoint(smoke_run), "data=synthetic_tiny", "output_dir=out")
    assert outcome.code == 0, outcome.err
    assert outcome.out.count("pip install 'saunet[plot]'") == 1
    assert not list((tmp_path / "out").rglob("*.png"))


def test_odometry_of_a_recording_without_poses(tool: Tool, smoke_run: Path, raw_root: Path, tmp_path: Path) -> None:
    outcome = tool("odometry", checkpoint(smoke_run), *RAW[:4], f"data.root={raw_root}", "figure=false", "output_dir=o")
    assert outcome.code == 0, outcome.err
    assert "no true poses, so the path is written but not compared" in outcome.out
    assert "times of its frames are unknown" not in outcome.out  # timestamps.txt is there
    written = sorted(path.stem for path in (tmp_path / "o").rglob("*.txt"))
    assert written == ["predicted_kitti"] * 2 + ["predicted_tum"] * 2
    assert json.loads((tmp_path / "o" / "odometry.json").read_text())["results"] == []
