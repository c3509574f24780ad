"""The tables: printed rows as printed, ours beside them, nothing made up."""

from __future__ import annotations

from pathlib import Path

import pytest
from made_runs import ERRORS, make_evaluation, make_run

from saunet.report.inputs import collect
from saunet.report.runs import Run
from saunet.report.tables import runs_table, table1, table2, table3


def test_measured_rows_stand_apart_from_published_ones(tmp_path: Path) -> None:
    runs = {name: make_run(tmp_path / name) for name in ("a", "b")}
    for name, folder in runs.items():
        make_evaluation(folder / "test", "x", abs_rel=0.25 if name == "a" else 0.3)
    table, missing = table1(dict(zip("ab", collect(list(runs.values())).runs, strict=True)))
    ours = [row for row in table.rows if row.kind == "measured"]
    assert [row.cells[0] for row in ours] == ["a", "b", "constant depth"]  # that one once, and last
    assert {row.group for row in ours} == {"Measured: synthetic, test split, protocol synthetic, 6 images"}
    assert [table.best(row, 2) for row in ours] == [True, False, False]
    best = [row.cells[0] for row in table.rows if row.kind == "published" and table.best(row, 2)]
    assert best == ["DORN"]
    assert missing == []


def test_validation_fills_in_and_says_so(tmp_path: Path) -> None:
    table, _ = table1({"a": collect([make_run(tmp_path / "a")]).runs[0]})
    assert table.rows[-1].group.startswith("Measured while training, best epoch: synthetic, validation split")


def test_a_run_without_a_score_is_listed_with_its_reason(tmp_path: Path) -> None:
    broken = make_run(tmp_path / "a", abs_rel=(), status="failed", error="the disk is full")
    (run,) = collect([broken]).runs
    table, missing = table1({"a": run})
    assert all(row.kind == "published" for row in table.rows)
    assert [(one.what, one.why) for one in missing] == [("Table 1, row of a", "failed: the disk is full")]


def test_supervision_shows_in_the_pattern(tmp_path: Path) -> None:
    (run,) = collect([make_run(tmp_path / "a")]).runs
    config = {**run.config, "objective": {"gradient": {"target": "lidar"}}}
    table, _ = table1({"video": run, "lidar": Run(run.path, config=config, scores=run.scores)})
    assert [row.cells[1] for row in table.rows if row.kind == "measured"] == ["M", "D+M"]


def test_sizes_are_in_millions() -> None:
    table, missing = table2({"mine": (2_200_000, 0)})
    assert table.rows[-1].cells == ("mine", 2.2, None, 2.2)
    assert not missing
    assert table2({})[1]


def test_the_ablation_needs_two_networks(tmp_path: Path) -> None:
    one = {"a": collect([make_run(tmp_path / "a")]).runs[0]}
    table, missing = table3(one)
    assert len(table.rows) == 3
    assert "no two scored runs" in missing[0].why
    two = one | {"b": collect([make_run(tmp_path / "b", encoder="resnet18", decoder="unet")]).runs[0]}
    table, missing = table3(two)
    assert [row.cells[:3] for row in table.rows[3:]] == [
        ("stratified_nano + aunet", "✓", "✓"),
        ("resnet18 + unet", "", ""),
    ]
    assert not missing


def test_a_failed_job_is_a_row_with_its_sentence_and_the_others_are_whole(sweep: Path) -> None:
    (found,) = collect([sweep]).sweeps
    table = runs_table("s", "Sweep", dict(zip("abc", found.runs, strict=True)), swept=True)
    headings = [column.heading for column in table.columns]
    assert headings == [
        "Run",
        "Status",
        "objective.beta",
        "α/β",
        "Epochs",
        "Loss",
        "Abs Rel",
        "RMSE",
        "δ < 1.25",
        "Minutes",
    ]
    good, bad, last = table.rows
    assert good.cells == ("a", "finished", "10", 1.0, 1, pytest.approx(1.8), 0.3, ERRORS[2], ERRORS[4], 3.0)
    assert (bad.kind, bad.note, bad.cells[1], bad.cells[5:9]) == (
        "failed",
        "the loss became NaN",
        "failed",
        (None,) * 4,
    )
    assert last.cells[6] == pytest.approx(0.1)
