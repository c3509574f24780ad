"""What the paths on the command line turn out to be."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import torch
import yaml
from made_runs import add_checkpoint, make_evaluation, make_run

from saunet.errors import ConfigError, DataError
from saunet.reporting import ReportOptions
from saunet.reporting.inputs import collect
from saunet.reporting.tables import explained_table
from saunet.runs.sweep import write_plan


def test_a_sweep_holds_its_jobs_in_order_and_the_one_that_left_nothing(sweep: Path) -> None:
    planned = [[f"objective.beta={beta}"] for beta in (10, 1, 0.1, 0.01)]
    write_plan(sweep, planned)
    (found,) = collect([sweep]).sweeps
    assert [run.status for run in found.runs] == ["finished", "failed", "finished", "failed"]
    assert [run.job for run in found.runs] == [0, 1, 2, 3]
    assert found.runs[1].error == "the loss became NaN"
    assert found.runs[3].error is not None
    assert "left no folder" in found.runs[3].error
    assert found.runs[3].overrides == {"objective.beta": "0.01"}


def test_jobs_of_a_running_sweep_wait(sweep: Path) -> None:
    make_run(sweep / "3", job=3, status="running", host="another-machine")
    write_plan(sweep, [[f"seed={job}"] for job in range(5)])
    (found,) = collect([sweep]).sweeps
    assert [run.status for run in found.runs[3:]] == ["running", "unfinished"]
    assert found.runs[4].error == "it is not started yet"


def test_a_gap_in_a_sweep_is_a_failed_job_even_without_its_plan(sweep: Path) -> None:
    (sweep / "1" / ".hydra" / "config.yaml").unlink()
    (found,) = collect([sweep]).sweeps
    assert [run.status for run in found.runs] == ["finished", "failed", "finished"]


def test_a_checkpoint_stands_for_its_run(tmp_path: Path) -> None:
    file = add_checkpoint(make_run(tmp_path / "a", status="finished"))
    (run,) = collect([file]).runs
    assert (run.path, run.checkpoint, run.status) == (tmp_path / "a", file, "finished")


def test_a_checkpoint_alone_is_a_run_of_its_own(tmp_path: Path) -> None:
    file = add_checkpoint(make_run(tmp_path / "a")).rename(tmp_path / "mine.ckpt")
    (run,) = collect([file]).runs
    assert (run.name, run.checkpoint, run.status) == ("mine", file, "unknown")


@pytest.mark.parametrize("given", ["absolute", "relative"])
def test_an_evaluation_belongs_to_the_run_of_its_checkpoint(tmp_path: Path, given: str) -> None:
    file = add_checkpoint(make_run(tmp_path / "a"))
    checkpoint = file if given == "absolute" else Path("a/checkpoints/best.ckpt")
    evaluation = make_evaluation(tmp_path / "e", checkpoint)
    (run,) = collect([tmp_path / "a", evaluation]).runs
    assert [(score.predictor, score.validation) for score in run.scores] == [
        ("model", False),
        ("constant depth", False),
        ("model", True),
    ]
    assert run.scores[0].data == "synthetic, test split"
    assert run.evaluations == (evaluation,)


def test_an_evaluation_inside_the_run_is_found(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "a")
    make_evaluation(folder / "test", "gone.ckpt")
    (run,) = collect([folder]).runs
    assert run.scores[0].errors[0] == 0.25


def test_data_without_ground_truth_are_read_by_condition(tmp_path: Path) -> None:
    folder = make_evaluation(make_run(tmp_path / "a") / "campus", "x")
    row = {"protocol": "campus", "images": 3, "warped": 0.1, "unwarped": 0.2, "explained": 0.8, "visible": 0.9}
    views = [{**row, "predictor": who, "condition": "sunny"} for who in ("model", "constant depth")]
    (folder / "metrics.json").write_text(
        json.dumps({"results": [{"predictor": "model", "abs_rel": None}], "views": views})
    )
    (run,) = collect([tmp_path / "a"]).runs
    assert [score.validation for score in run.scores] == [True]
    (one,) = run.explained
    assert (one.condition, one.images, one.warped, one.explained) == ("sunny", 3, 0.1, 0.8)
    table = explained_table({"a": run})
    assert table is not None
    assert table.rows[0].cells == ("a", "sunny", 3, 0.1, 0.2, 0.8)
    assert explained_table({}) is None


def test_an_evaluation_without_its_run_stands_alone(tmp_path: Path) -> None:
    (run,) = collect([make_evaluation(tmp_path / "e", "/gone/best.ckpt")]).runs
    assert (run.name, run.checkpoint, len(run.scores)) == ("e", None, 2)


def test_a_comparison_of_named_runs_takes_no_others(tmp_path: Path) -> None:
    runs = [make_run(tmp_path / name) for name in "ab"]
    foreign = make_evaluation(tmp_path / "of_others" / "e", "/gone/best.ckpt")
    assert len(collect([*runs, foreign.parent], strangers=False).runs) == 2
    assert len(collect([*runs, foreign.parent]).runs) == 3
    assert len(collect([runs[0], foreign.parent], strangers=False).runs) == 2
    assert len(collect([*runs, foreign], strangers=False).runs) == 3  # named itself: street's, for example


def test_a_folder_of_runs_is_looked_through(tmp_path: Path, sweep: Path) -> None:
    make_run(tmp_path / "outputs" / "train" / "b")
    make_run(tmp_path / "outputs" / "train" / "a")
    (tmp_path / "outputs" / "bench").mkdir()
    (tmp_path / "outputs" / "bench" / "benchmark.json").write_text("{}")
    inputs = collect([tmp_path])
    assert [run.name for run in inputs.runs] == ["a", "b"]
    assert (len(inputs.sweeps), len(inputs.benchmarks)) == (1, 1)
    assert len(inputs.all_runs) == 5


def test_a_path_given_twice_counts_once(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "a")
    assert len(collect([folder, str(folder), tmp_path]).runs) == 1


@pytest.mark.parametrize(("name", "words"), [("gone", "there is nothing at"), ("empty", "no run, sweep")])
def test_a_path_without_a_run_is_refused(tmp_path: Path, name: str, words: str) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match=words):
        collect([tmp_path / name])


def test_another_checkpoint_than_best_or_last_is_refused() -> None:
    with pytest.raises(ConfigError, match="checkpoint is 'first'"):
        ReportOptions(checkpoint="first")


def test_no_path_at_all_is_refused() -> None:
    with pytest.raises(DataError, match="no run given"):
        collect([])


def test_an_evaluation_led_elsewhere_by_output_dir_belongs_to_the_run_of_its_checkpoint(tmp_path: Path) -> None:
    add_checkpoint(make_run(tmp_path / "a"))
    evaluation = make_evaluation(tmp_path / "scores" / "e", Path("unused.ckpt"))
    shutil.rmtree(evaluation / ".hydra")  # it stays in the folder that Hydra chose
    file = evaluation / "metrics.json"
    settings = {"checkpoint": "a/checkpoints/best.ckpt", "data": "kitti", "split": "val"}
    file.write_text(json.dumps({**json.loads(file.read_text()), "settings": settings}))
    (run,) = collect([tmp_path / "a", evaluation]).runs
    assert run.evaluations == (evaluation,)
    assert {score.data for score in run.scores if not score.validation} == {"kitti, val split"}


@pytest.mark.parametrize("given", ["runs/smoke", "runs/${name}"])
def test_a_run_led_elsewhere_by_output_dir_is_one_run(tmp_path: Path, given: str) -> None:
    record = {"choices": {"data": "kitti", "model/encoder": "resnet18"}, "protocol": "eigen_camera_z"}
    record |= {"config": {"name": "smoke"}, "overrides": ["experiment=smoke"], "splits": {"val": "abc"}}
    place = make_run(tmp_path / "runs" / "smoke")
    (place / "run.json").write_text(json.dumps({"status": "finished", **record}))
    left = tmp_path / "outputs" / "smoke" / "today"
    shutil.move(place / ".hydra", left / ".hydra")
    config = yaml.safe_load((left / ".hydra" / "config.yaml").read_text()) | {"output_dir": given}
    (left / ".hydra" / "config.yaml").write_text(yaml.safe_dump(config))
    hydra = {"hydra": {"runtime": {"cwd": str(tmp_path)}}}
    (left / ".hydra" / "hydra.yaml").write_text(yaml.safe_dump(hydra))
    file = add_checkpoint(place)
    for paths in ([tmp_path / "outputs"], [tmp_path / "outputs", place], [tmp_path], [file]):
        (run,) = collect(paths).runs
        assert (run.path, run.status, run.component("model/encoder")) == (place, "finished", "resnet18")
        assert run.overrides == {"experiment": "smoke"}
        (score,) = run.scores
        assert (score.data, score.protocol) == ("kitti, validation split", "eigen_camera_z")
        assert score.fingerprint == "abc"
    shutil.rmtree(place)
    with pytest.raises(DataError, match="no run"):
        collect([tmp_path / "outputs"])


def test_an_evaluation_of_another_system_in_a_runs_folder_is_not_the_runs(tmp_path: Path) -> None:
    run = make_run(tmp_path / "a")
    make_evaluation(run / "theirs", None, predictions="x.npy")
    mine, theirs = collect([run]).runs
    assert [score.validation for score in mine.scores] == [True]
    assert (theirs.name, len(theirs.scores)) == ("theirs", 2)


def test_jobs_led_elsewhere_by_output_dir_are_read_there(tmp_path: Path, sweep: Path) -> None:
    place = make_run(tmp_path / "runs" / "0.001", job=3, status="finished")
    left = sweep / "3" / ".hydra"
    shutil.move(place / ".hydra", left)
    config = yaml.safe_load((left / "config.yaml").read_text())
    config["objective"]["beta"] = 0.001
    (left / "config.yaml").write_text(yaml.safe_dump(config | {"output_dir": str(tmp_path / "runs/${objective.beta}")}))
    (found,) = collect([sweep]).sweeps
    assert (found.runs[3].path, found.runs[3].status) == (place, "finished")


@pytest.mark.parametrize("resumed", [None, "checkpoints/last.ckpt"])
def test_a_resumed_run_is_reported_with_the_rate_that_it_kept(tmp_path: Path, resumed: str | None) -> None:
    """Its config asks for 0.001; the optimizer's state, which a resumed run continues, says 0.0001."""
    folder = make_run(tmp_path / "a", overrides=["optim.lr=0.001"], resumed=resumed)
    groups = [{"lr": 0.00003, "initial_lr": 0.0001, "weight_decay": 0.0}]
    (folder / "checkpoints").mkdir()
    torch.save({"optimizer_states": [{"state": {}, "param_groups": groups}]}, folder / "checkpoints" / "last.ckpt")
    (run,) = collect([folder]).runs
    rate = 0.0001 if resumed else 0.001
    assert run.config["optim"]["lr"] == rate
    assert run.overrides["optim.lr"] == str(rate)


def test_a_damaged_checkpoint_leaves_a_resumed_run_as_it_says(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "a", resumed="last.ckpt")
    (folder / "checkpoints").mkdir()
    (folder / "checkpoints" / "last.ckpt").write_bytes(b"PK broken")
    (run,) = collect([folder]).runs
    assert run.config["optim"]["lr"] == 0.001
