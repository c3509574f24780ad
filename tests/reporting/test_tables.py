"""The tables: printed rows as printed, ours beside them, nothing made up."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from made_runs import ERRORS, make_evaluation, make_run

from saunet.reporting.figures import draw_ratio
from saunet.reporting.inputs import collect
from saunet.reporting.tables import comparable, explained_table, runs_table, table1, table2, table3
from saunet.runs.run import Run
from saunet.runs.sweep import labels


def test_measured_rows_stand_apart_from_published_ones(tmp_path: Path) -> None:
    runs = {name: make_run(tmp_path / name) for name in ("a", "b")}
    for name, folder in runs.items():
        make_evaluation(folder / "test", "x", abs_rel=0.25 if name == "a" else 0.3, protocol="eigen_lidar_x")
    table, missing = table1(dict(zip("ab", collect(list(runs.values())).runs, strict=True)))
    assert table is not None
    kinds = [row.kind for row in table.rows]
    assert kinds == sorted(kinds)  # ours first
    ours = [row for row in table.rows if row.kind == "measured"]
    assert [row.cells[0] for row in ours] == ["a", "b", "constant depth"]  # that one once, and last
    assert {row.group for row in ours} == {"Measured: synthetic, test split, protocol eigen_lidar_x, 6 images"}
    assert [table.best(row, 2) for row in ours] == [True, False, False]
    best = [row.cells[0] for row in table.rows if row.kind == "published" and table.best(row, 2)]
    assert best == ["DORN"]
    assert missing == []


def test_published_rows_stand_only_beside_scores_on_the_same_split(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "mine")
    make_evaluation(folder / "test", "x")
    table, missing = table1({"mine": collect([folder]).runs[0]})
    assert table is not None
    assert {row.kind for row in table.rows} == {"measured"}
    assert [one.what for one in missing] == ["Published errors to compare with"]


def test_validation_fills_in_and_says_so(tmp_path: Path) -> None:
    table, _ = table1({"a": collect([make_run(tmp_path / "a")]).runs[0]})
    assert table.rows[-1].group.startswith("Measured while training, best epoch: synthetic, validation split")


def test_a_run_without_a_score_is_listed_with_its_reason(tmp_path: Path) -> None:
    broken = make_run(tmp_path / "a", abs_rel=(), status="failed", error="the disk is full")
    (run,) = collect([broken]).runs
    table, missing = table1({"a": run})
    assert table is None
    assert [(one.what, one.why) for one in missing] == [("Errors and accuracy of a", "failed: the disk is full")]


def test_supervision_shows_in_the_pattern(tmp_path: Path) -> None:
    (run,) = collect([make_run(tmp_path / "a")]).runs
    config = {**run.config, "objective": {"gradient": {"target": "lidar"}}}
    table, _ = table1({"video": run, "lidar": Run(run.path, config=config, scores=run.scores)})
    assert [row.cells[1] for row in table.rows if row.kind == "measured"] == ["M", "D+M"]


def test_sizes_are_in_millions() -> None:
    table, missing = table2({"mine": (2_200_000, 0)})
    assert table is not None
    assert table.rows[0].cells == ("mine", 2.2, None, 2.2)
    assert {row.kind for row in table.rows[1:]} == {"published"}
    assert not missing
    assert table2({})[0] is None
    assert table2({})[1]


def test_the_ablation_needs_two_networks(tmp_path: Path) -> None:
    one = {"a": collect([make_run(tmp_path / "a")]).runs[0]}
    table, missing = table3(one)
    assert table is None
    assert "no two scored runs" in missing[0].why
    two = one | {"b": collect([make_run(tmp_path / "b", encoder="resnet18", decoder="unet")]).runs[0]}
    table, missing = table3(two)
    assert table is not None
    assert [row.cells[:3] for row in table.rows] == [
        ("stratified_nano + aunet", "✓", "✓"),
        ("resnet18 + unet", "", ""),
    ]
    assert not missing
    for run in two.values():
        make_evaluation(run.path / "test", "x", protocol="eigen_camera_z")
    table, _ = table3(dict(zip("ab", collect([run.path for run in two.values()]).runs, strict=True)))
    assert table is not None
    assert [row.kind for row in table.rows] == ["measured"] * 2 + ["published"] * 3


def test_a_failed_job_is_a_row_with_its_sentence_and_the_others_are_whole(sweep: Path) -> None:
    (found,) = collect([sweep]).sweeps
    table = runs_table("s", "Sweep", dict(zip("abc", found.runs, strict=True)), swept=True)
    headings = [column.heading for column in table.columns]
    assert headings == ["Run", "Status", "objective.beta", "α/β", "Epochs", "Loss", "Abs Rel", "RMSE", "δ1", "Minutes"]
    good, bad, last = table.rows
    assert good.cells == ("a", "finished", "10", 1.0, 1, pytest.approx(1.8), 0.3, ERRORS[2], ERRORS[4], 3.0)
    assert (bad.kind, bad.note, bad.cells[1], bad.cells[5:9]) == (
        "failed",
        "the loss became NaN",
        "failed",
        (None,) * 4,
    )
    assert last.cells[6] == pytest.approx(0.1)


SPEED = {"method": "speed", "factor": 2.0}
FLIP = "monodepth blend of two flips"


def test_other_images_flips_and_scales_are_other_groups(tmp_path: Path) -> None:
    run = make_run(tmp_path / "a")
    make_evaluation(run / "plain", "x", 0.25)
    make_evaluation(run / "again", "x", 0.25)  # nothing new
    make_evaluation(run / "flipped", "x", 0.24, post_processing=FLIP)
    make_evaluation(run / "elsewhere", "x", 0.20, drive="another drive")
    make_evaluation(run / "in_meters", "x", 0.22, scale=SPEED)
    make_evaluation(run / "unscaled", "x", 0.23, scale={"method": "auto", "factor": None}, post_processing=FLIP)
    table, _ = table1({"a": collect([run]).runs[0]})
    ours = [row for row in table.rows if row.kind == "measured" and row.cells[0] == "a"]
    told = {row.cells[2]: row.group for row in ours}
    plain, other = told[0.25], told[0.20]
    assert plain.startswith("Measured: synthetic, test split, protocol synthetic, 6 images (sha256 ")
    assert other.startswith("Measured: synthetic, test split, protocol synthetic, 6 images (sha256 ")
    assert plain != other
    assert told[0.24] == told[0.23] == "Measured: synthetic, test split, flip=true, protocol synthetic, 6 images"
    assert told[0.22] == "Measured: synthetic, test split, scale.method=speed, protocol synthetic, 6 images"
    assert len(ours) == 5
    assert [row.cells[2] for row in ours if row.cells[0] == "a" and table.best(row, 2)] == [0.25, 0.2, 0.23, 0.22]


def test_an_evaluation_that_does_not_say_its_images_stands_apart(tmp_path: Path) -> None:
    run = make_run(tmp_path / "a")
    make_evaluation(run / "new", "x", 0.25)
    old = make_evaluation(run / "old", "x", 0.2) / "metrics.json"
    old.write_text(json.dumps({**json.loads(old.read_text()), "images": {}}))
    table, _ = table1({"a": collect([run]).runs[0]})
    groups = {row.group for row in table.rows if row.kind == "measured"}
    assert len(groups) == 2
    assert any(group.endswith("6 images (the file does not say which)") for group in groups)


def test_another_systems_row_bears_its_name(tmp_path: Path) -> None:
    make_evaluation(tmp_path / "theirs", None, predictions="disps.npy")
    make_evaluation(tmp_path / "2026-01-01_00-00-00", None, 0.3, predictions="lite/disps.npy")
    make_run(tmp_path / "a")
    runs = collect([tmp_path]).runs
    assert sorted(run.name for run in runs) == ["a", "lite/disps.npy", "theirs"]
    names = labels([runs])[0]
    assert sorted(names)[1:] == ["lite/disps.npy", "theirs"]
    table, missing = table1(dict(zip(names, runs, strict=True)))
    assert {"theirs", "lite/disps.npy"} < {row.cells[0] for row in table.rows}
    assert "predictions" not in {row.cells[0] for row in table.rows}
    assert not [one for one in missing if "row of" in one.what]


def scored_jobs(sweep: Path) -> dict[str, Run]:
    """Three jobs, all validated, one of them also evaluated on images that flatter it."""
    make_run(sweep / "3", beta=0.01, job=3, abs_rel=(0.5,), status="finished", overrides=["objective.beta=0.01"])
    make_evaluation(sweep / "3" / "test", "x", 0.01)
    return dict(zip("abcd", collect([sweep]).sweeps[0].runs, strict=True))


def test_the_runs_of_a_table_are_scored_on_the_same_images(sweep: Path) -> None:
    runs = scored_jobs(sweep)
    table = runs_table("s", "Sweep", runs, swept=True)
    assert [row.cells[7] for row in table.rows] == [0.3, None, pytest.approx(0.1), 0.5]
    assert {row.group for row in table.rows} == {""}
    assert [table.best(row, 7) for row in table.rows] == [False, False, True, False]
    assert table.notes[-1].startswith("Errors — Measured while training, best epoch: synthetic, validation split")


def test_runs_that_share_no_images_are_not_set_against_each_other(tmp_path: Path) -> None:
    folders = [make_run(tmp_path / name, abs_rel=()) for name in "abcd"]
    for folder, value, drive in zip(folders[:3], (0.3, 0.1, 0.2), ("one", "two", "one"), strict=True):
        make_evaluation(folder / "test", "x", value, drive=drive)
    runs = dict(zip("abcd", collect(folders).runs, strict=True))
    table = runs_table("s", "Runs", runs, swept=False)
    column = [heading.heading for heading in table.columns].index("Abs Rel")
    assert [(row.cells[0], table.best(row, column)) for row in table.rows] == [
        ("a", False), ("c", True), ("b", False), ("d", False),
    ]  # fmt: skip
    assert len({row.group for row in table.rows}) == 3
    assert table.rows[-1].group == "Without a score"
    assert table.notes[-1] == "Errors in different groups cannot be compared."


def test_one_drawing_holds_what_compares(sweep: Path) -> None:
    runs = scored_jobs(sweep)
    drawn = {name: score.errors[0] for name, score in comparable(runs).items()}
    assert drawn == {"a": 0.3, "c": pytest.approx(0.1), "d": 0.5}
    pytest.importorskip("matplotlib")
    assert draw_ratio(runs)
    assert draw_ratio({name: runs[name] for name in "b"}) is None


def test_at_a_draw_evaluations_go_before_validations(tmp_path: Path) -> None:
    run = make_run(tmp_path / "a")
    make_evaluation(run / "test", "x", 0.6)
    assert comparable({"a": collect([run]).runs[0]})["a"].errors[0] == 0.6


def test_conditions_of_other_images_are_other_groups(tmp_path: Path) -> None:
    row = {"protocol": "campus", "predictor": "model", "condition": "sunny", "images": 3}
    row |= {"warped": 0.1, "unwarped": 0.2, "explained": 0.8}
    run = make_run(tmp_path / "a")
    for name, images in (("one", "aa"), ("two", "bb"), ("again", "aa")):
        folder = make_evaluation(run / name, "x")
        (folder / "metrics.json").write_text(json.dumps({"results": [], "views": [row], "images": {"campus": images}}))
    table = explained_table({"a": collect([run]).runs[0]})
    assert table is not None
    assert [row.group for row in table.rows] == [
        f"Measured: synthetic, test split, protocol campus (sha256 {images})" for images in ("aa", "bb")
    ]
