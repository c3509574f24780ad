"""From folders to the page, whole; and two runs against each other."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from browsing import barriers
from made_runs import ERRORS, add_checkpoint, make_evaluation, make_run
from rich.console import Console

from saunet.errors import ConfigError, DataError
from saunet.evaluation.files import write_results
from saunet.evaluation.result import EvaluationResult
from saunet.evaluation.rows import ViewRow
from saunet.metrics.protocols import protocol
from saunet.reporting import ReportOptions, collect, report
from saunet.reporting.compare import compared
from saunet.reporting.figures import speed
from saunet.reporting.page import Document, Section, as_html, as_markdown, write
from saunet.reporting.scenes import Seen, look
from saunet.reporting.tables import networks, with_pose
from saunet.reporting.tool import build
from saunet.runs.run import read_run
from saunet.tables import Column, Row, Table, show


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    path = tmp_path / "street.png"
    cv2.imwrite(str(path), rng.integers(0, 255, (40, 90, 3), dtype=np.uint8))
    return path


@pytest.fixture
def everything(tmp_path: Path, sweep: Path) -> list[Path]:
    """A run with a checkpoint and an evaluation, a sweep, and a benchmark of that run's network."""
    file = add_checkpoint(make_run(tmp_path / "run", status="finished"))
    parameters = sum(value.numel() for value in _state(file).values())
    row = {"model": "mine", "size": "32x64", "device": "cpu", "precision": "fp32", "mode": "eager", "batch_size": 2}
    row |= {"depth_parameters": parameters, "pose_parameters": 0, "median": 0.02}
    (tmp_path / "bench").mkdir()
    (tmp_path / "bench" / "benchmark.json").write_text(json.dumps({"machine": {}, "results": [row]}))
    return [tmp_path / "run", make_evaluation(tmp_path / "e", file), sweep, tmp_path / "bench"]


def _state(file: Path) -> dict[str, object]:
    from saunet.runs.checkpoint import read_checkpoint

    depth, _ = read_checkpoint(file).networks()
    return dict(depth.named_parameters())


@pytest.mark.slow  # fast, but only the session of the slow tests installs playwright
def test_a_report_is_readable_in_both_color_schemes(
    browser: Any, everything: list[Path], picture: Path, tmp_path: Path
) -> None:
    result = report(ReportOptions(runs=tuple(everything), scenes={"kitti": str(picture)}))
    files = write(result.document, tmp_path / "report")
    (tmp_path / "notebook.html").write_text(
        f"<!doctype html><html lang=en><title>output</title><main><h1>output</h1>{result._repr_html_()}</main>"
    )
    page = browser.new_page()
    for file in (files["report.html"], tmp_path / "notebook.html"):
        page.goto(file.as_uri())
        assert barriers(page) == []


def test_a_report_of_everything(everything: list[Path], picture: Path, tmp_path: Path) -> None:
    options = ReportOptions(scenes={"kitti": str(picture), "campus_sunny": [str(picture)]})
    document = build(collect(everything), options)
    files = write(document, tmp_path / "report")
    page = files["report.html"].read_text()
    assert [section.title for section in document.sections] == [
        "Accuracy", "Runs", "Training", "Depth side by side", "Networks", "Accuracy and time",
    ]  # fmt: skip
    for words in (
        "Loss during training (the paper’s Fig. 4)",
        "Accuracy during training (the paper’s Fig. 5)",
        "Models side by side: kitti (the paper’s Fig. 8)",
        "Models side by side: campus sunny (the paper’s Fig. 9)",
        "Accuracy against time of run (cpu, fp32, eager, batch 2)",
        "the loss became NaN",
        "α/β",
        "SAU-Net",
        "constant depth",
    ):
        assert words in page
    assert {
        "tables/table1.csv",
        "tables/sweep_alpha_beta.csv",
        "tables/figure10.csv",
        "figures/sweep_alpha_beta_ratio.svg",
    } <= files.keys()
    rows = list(csv.DictReader(io.StringIO(files["tables/figure10.csv"].read_text())))
    assert [(row["Method"], row["ms per image"]) for row in rows] == [("run", "10.0"), ("Mono R18", "2.8")]
    methods = [row["Method"] for row in csv.DictReader(io.StringIO(files["tables/table1.csv"].read_text()))]
    assert not any(method.startswith("α/β") for method in methods)
    missing = {one.what: one.why for one in document.missing}
    assert "in the tables of their sweeps" in missing["Errors and accuracy of the jobs of sweeps"]
    assert missing["Loss functions side by side (the paper’s Fig. 7)"] == "no group of runs differs only in its loss"
    assert "Models side by side (the paper’s Fig. 8)" not in missing
    text = files["report.md"].read_text()
    for reference in re.findall(r"\]\((figures/[^)]+)\)", text):
        assert (tmp_path / "report" / reference).is_file()


def test_what_looked_sick_in_training_is_in_the_report(tmp_path: Path) -> None:
    said = "the predicted depth is flat, the same at every pixel"
    runs = [
        make_run(tmp_path / "well", status="finished"),
        make_run(tmp_path / "sick", status="finished", health={"x": said}),
    ]
    assert said in as_html(build(collect(runs)))
    assert "Health warnings" not in as_html(build(collect(runs[:1])))


def test_the_page_fetches_nothing(everything: list[Path], picture: Path) -> None:
    page = as_html(build(collect(everything), ReportOptions(scenes={"kitti": str(picture)})))
    links = re.findall(r"""(?<![-\w])(?:src|href)=["']?([^"'\s>]+)""", page)
    assert links
    assert all(link.startswith(("data:", "#")) for link in links)
    assert "<script" not in page
    assert "@import" not in page
    assert "url(" not in page
    assert "default-src 'none'" in page


def test_losses_side_by_side_are_figure_7(sweep: Path, picture: Path) -> None:
    for job in (0, 2):
        add_checkpoint(sweep / str(job))
    document = build(collect([sweep]), ReportOptions(scenes={"kitti": str(picture)}, figures=False))
    titles = [block.title for section in document.sections for block in section.blocks]
    assert "Loss functions side by side: kitti (the paper’s Fig. 7)" in titles
    missing = {one.what: one.why for one in document.missing}
    assert missing["Curves, and accuracy against time"] == "figures=false"
    assert not any(what.startswith("Loss functions side") for what in missing)


def test_one_run_of_ones_own_comes_first_and_by_its_folders_name(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "town", abs_rel=(), status="finished")
    for place in (folder / ".hydra" / "config.yaml", folder / "run.json"):
        place.write_text(place.read_text().replace("name: town", "name: quick").replace('"town"', '"quick"'))
    add_checkpoint(folder)
    _explained(folder / "test", 0.1)
    document = build(collect([folder]), ReportOptions(figures=False))
    assert [section.title for section in document.sections] == ["Accuracy", "Runs", "Networks"]
    names = [table.rows[0].cells[0] for table in document.tables]
    assert names == ["town", "town", "stratified_nano + aunet"]
    assert all(row.kind == "measured" for table in document.tables[:2] for row in table.rows)
    dated = folder.rename(tmp_path / "2026-01-31_12-00-00")
    (run,) = collect([dated]).runs
    assert (run.name, run.called) == ("quick", "quick")


def test_what_has_no_data_is_listed(tmp_path: Path) -> None:
    document = build(collect([make_run(tmp_path / "a", abs_rel=())]))
    what = {one.what for one in document.missing}
    assert {"Size and pictures of a", "Errors and accuracy of a", "Depth side by side", "Accuracy against time"} <= what
    assert "Loss during training of runs" in what


def test_without_matplotlib_the_page_has_no_drawings_and_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("saunet.reporting.tool.find_spec", lambda name: None)
    result = report(ReportOptions(runs=(make_run(tmp_path / "a"),), output_dir=tmp_path / "page"))
    (told,) = (sentence for sentence in result.left_out if sentence.startswith("Curves, and accuracy against time: "))
    assert "pip install 'saunet[plot]'" in told
    assert (tmp_path / "page" / "report.html").is_file()
    assert not list((tmp_path / "page").rglob("*.svg"))


def test_a_damaged_checkpoint_costs_its_pictures_only(tmp_path: Path, picture: Path) -> None:
    folder = make_run(tmp_path / "a")
    (folder / "checkpoints").mkdir()
    (folder / "checkpoints" / "best.ckpt").write_bytes(b"PK broken")
    document = build(collect([folder]), ReportOptions(scenes={"kitti": str(picture)}))
    why = {one.what: one.why for one in document.missing}
    assert "damaged" in why["Size and pictures of a"]
    assert any(row.kind == "measured" for row in document.tables[0].rows)


@pytest.mark.parametrize(("names", "words"), [(("x",), "1 names for 2"), (("x", "x"), "have the same name twice")])
def test_labels_must_fit(tmp_path: Path, names: tuple[str, ...], words: str) -> None:
    inputs = collect([make_run(tmp_path / name) for name in "ab"])
    with pytest.raises(ConfigError, match=words):
        build(inputs, ReportOptions(labels=names, figures=False))


def test_a_foreign_json_is_no_benchmark(tmp_path: Path) -> None:
    (tmp_path / "benchmark.json").write_text("{}")
    make_run(tmp_path / "a")
    with pytest.raises(DataError, match="not a result of saunet benchmark"):
        build(collect([tmp_path / "a", tmp_path / "benchmark.json"]), ReportOptions(figures=False))


def test_names_from_outside_cannot_become_markup() -> None:
    table = Table("t", "<b>", (Column("a|b"), Column("Status")), (Row(("<script>|", "failed"), "failed", note="<i>"),))
    document = Document("<img>", (), (Section("S", (table,)),), ())
    page, text = as_html(document), as_markdown(document)
    assert not {"<script>", "<img>", "<i>"} & set(re.findall(r"<\w+>", page))
    assert "&lt;script>\\|" in text


def _compared(*paths: Path) -> str:
    stream = io.StringIO()
    tables, left_out, _ = compared(collect(list(paths)), ())
    show(tables, Console(file=stream, width=200))
    return stream.getvalue() + "".join(f"left out: {sentence}\n" for sentence in left_out)


def test_two_runs_are_compared_image_by_image(tmp_path: Path) -> None:
    runs = [make_run(tmp_path / name, beta=beta, status="finished") for name, beta in (("a", 0.1), ("b", 0.2))]
    for folder, value in zip(runs, (0.25, 0.3), strict=True):
        make_evaluation(folder / "test", "x", value)
    text = _compared(*runs)
    assert re.search(r"objective\.beta\s+0\.1\s+0\.2", text)
    assert "synthetic: 'b' minus 'a'" in text
    assert re.search(r"Abs Rel ↓\s+0\.2750\s+0\.3250\s+\+0\.0500\s+\+0\.0500\s+\+0\.0500\s+0%\s+–", text)


def test_a_comparison_writes_every_image_of_each_run(tmp_path: Path) -> None:
    one, two = (make_run(tmp_path / name, beta=beta) for name, beta in (("a", 0.1), ("b", 0.2)))
    make_evaluation(one / "test", "x", 0.25)
    make_evaluation(two / "test", "x", 0.3)
    _explained(one / "views", 0.1)
    _explained(two / "views", 0.2)
    report(ReportOptions(runs=(one, two), compare=True, output_dir=tmp_path / "out"))
    lines = list(csv.DictReader((tmp_path / "out" / "images.csv").read_text().splitlines()))
    assert [line["protocol"] for line in lines] == ["campus"] * 6 + ["synthetic"] * 6
    assert [float(line["warped b"]) for line in lines[:3]] == pytest.approx([0.2, 0.21, 0.22])
    assert [line["warped a"] for line in lines[6:]] == [""] * 6  # of depth, not of views
    assert all(float(line["abs_rel b"]) - float(line["abs_rel a"]) == pytest.approx(0.05) for line in lines[6:])


def test_every_evaluation_that_is_paired_has_its_images(tmp_path: Path) -> None:
    """The plain one and the flipped one, of the same images under one protocol."""
    runs = [make_run(tmp_path / name, beta=beta) for name, beta in (("a", 0.1), ("b", 0.2))]
    for folder, value in zip(runs, (0.2, 0.3), strict=True):
        make_evaluation(folder / "plain", "x", value)
        make_evaluation(folder / "flipped", "x", value + 0.5, post_processing="monodepth blend of two flips")
    report(ReportOptions(runs=tuple(runs), compare=True, output_dir=tmp_path / "out"))
    lines = list(csv.DictReader((tmp_path / "out" / "images.csv").read_text().splitlines()))
    assert len(lines) == 12
    for line in lines:
        assert float(line["abs_rel a"]) > 0.6 if "flip=true" in line["evaluation"] else float(line["abs_rel a"]) < 0.3


def test_two_evaluations_of_one_model_are_told_what_compares_them(tmp_path: Path) -> None:
    folders = [make_evaluation(tmp_path / name, "street", 0.25) for name in ("one", "two")]
    with pytest.raises(DataError, match=r"are of one model, street; .* run the second again with compare=.*one"):
        compared(collect(folders, strangers=False), ())


def test_curves_are_not_missed_where_nothing_was_trained(tmp_path: Path) -> None:
    page = report(ReportOptions(runs=(_explained(tmp_path / "before", 0.2),)))
    assert not [said for said in page.left_out if "during training" in said]


def test_up_to_four_runs_are_compared_each_with_each_and_more_with_the_first(tmp_path: Path) -> None:
    names = "abcde"
    runs = [make_run(tmp_path / name, beta=0.1 + 0.1 * place) for place, name in enumerate(names)]
    for folder in runs[:4]:
        make_evaluation(folder / "test", "x", 0.25)
    pairs = re.findall(r"'(\w)' minus '(\w)'", _compared(*runs[:3]))
    assert pairs == [("b", "a"), ("c", "a"), ("c", "b")]
    text = _compared(*runs[:3], runs[4])
    assert text.count("not evaluated") == 1  # with the first alone
    assert len(re.findall(r"minus '[abc]'", text)) == 3
    pairs = re.findall(r"'(\w)' minus '(\w)'", _compared(*runs))
    assert pairs == [("b", "a"), ("c", "a"), ("d", "a")]


def test_what_cannot_be_paired_is_said(tmp_path: Path) -> None:
    runs = [make_run(tmp_path / name, beta=beta) for name, beta in (("a", 0.1), ("b", 0.2), ("c", 0.3))]
    make_evaluation(runs[0] / "test", "x")
    make_evaluation(runs[1] / "test", "x", images=5)
    text = " ".join(_compared(*runs).split())
    assert "cannot be paired" in text
    assert "are not compared (c not evaluated)" in text
    with pytest.raises(DataError, match="not enough to compare"):
        _compared(runs[0])


def _two(tmp_path: Path) -> list[Path]:
    return [make_run(tmp_path / name, beta=beta, status="finished") for name, beta in (("a", 0.1), ("b", 0.2))]


def _explained(folder: Path, warped: float, images: int = 6, **more: object) -> Path:
    """Write an evaluation of clips without ground truth."""
    rows = tuple(
        ViewRow("model", "campus", f"seq {index:06d}", "seq", warped + 0.01 * index, 0.3, 0.8, 0.9)
        for index in range(images)
    )
    settings: dict[str, object] = {"data": "video", **more}
    write_results(EvaluationResult((protocol("campus"),), ("model",), (), views=rows, settings=settings), folder)
    return folder


def test_runs_on_clips_without_ground_truth_are_compared_frame_by_frame(tmp_path: Path) -> None:
    one, two = _two(tmp_path)
    _explained(one / "test", 0.1)
    _explained(two / "test", 0.2)
    text = _compared(one, two)
    assert "campus: 'b' minus 'a'" in text
    assert re.search(r"warped ↓\s+0\.1250\s+0\.2250\s+\+0\.1000\s+\+0\.1000\s+\+0\.1000\s+0%", text)
    assert re.search(r"explained ↑\s+0\.8000\s+0\.8000\s+\+0\.0000", text)
    assert "left out" not in text
    assert "status" not in text  # both are finished
    assert re.search(r"a\s+3\s+1\.2000", text)  # the loss of the last of nine steps, in epoch 3
    assert "these losses cannot be compared" in " ".join(text.split())  # their objectives have other weights


def test_a_model_without_a_pose_network_is_compared_and_the_motion_of_both_is_said(tmp_path: Path) -> None:
    """As `street` with a run that was adapted from it: by tracked motion for both, if both have it."""
    before = _explained(tmp_path / "before", 0.2, motion="tracked")
    after = make_run(tmp_path / "after", status="finished")
    _explained(after / "network", 0.12)
    text = " ".join(_compared(before, after).split())
    assert "campus: 'after' minus 'before'" in text  # as they are named
    assert not {"unknown", "None"} & set(text.split())
    text = " ".join(_compared(after, before).split())
    assert "after with the pose network's motion, before with motion=tracked" in text
    assert re.search(r"warped ↓ 0\.1450 0\.2250 \+0\.0800", text)
    assert "video, test split, motion=tracked" in text  # the heading of its row among the conditions
    _explained(after / "tracked", 0.1, motion="tracked")
    text = " ".join(_compared(after, before).split())
    assert text.count("6 images, paired") == 1
    assert re.search(r"warped ↓ 0\.1250 0\.2250 \+0\.1000", text)
    assert "to compare depth alone" not in text


def test_runs_scored_at_other_sizes_are_said_not_to_be_comparable(tmp_path: Path) -> None:
    one, two = _two(tmp_path)
    _explained(one / "test", 0.1, size=[96, 320])
    _explained(two / "test", 0.2, size=[128, 416])
    text = " ".join(_compared(one, two).split())
    assert "a was scored at 96x320 (height x width) and b at 128x416" in text
    assert "not comparable; compare models trained at one size, such as size=96x320" in text
    assert "images of 96x320, protocol campus" in text  # two groups among the conditions
    assert "images of 128x416, protocol campus" in text
    street = _explained(tmp_path / "before", 0.2, size=[128, 416], checkpoint="street")
    assert "such as size=128x416" in " ".join(_compared(one, street).split())  # the shipped model's cannot be changed
    _explained(one / "test", 0.1)  # an older evaluation, of a run whose settings say 32x64
    assert "a was scored at 32x64 (height x width) and b at 128x416" in " ".join(_compared(one, two).split())
    _explained(two / "test", 0.2, size=[32, 64])
    assert "not comparable" not in _compared(one, two)


def test_what_is_not_compared_names_the_commands_after_which_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    one, two = _two(tmp_path)
    for folder in (one, two):
        add_checkpoint(folder)
    _explained(one / "test", 0.1)
    _explained(two / "test", 0.2, images=5)
    commands = [f"`saunet evaluate {name} data=synthetic output_dir={name}/compared`" for name in "ab"]
    text = _compared(one, two)
    assert "6 of video, test split against 5 of video, test split" in text
    assert " and ".join(commands) in text
    file = one / ".hydra" / "config.yaml"
    config = yaml.safe_load(file.read_text())
    file.write_text(yaml.safe_dump({**config, "data": {**config["data"], "track_motion": True}}))
    assert _compared(one, two).count("motion=tracked") == 2  # the motion that the training had
    for folder, warped in ((one, 0.1), (two, 0.2)):
        _explained(folder / "compared", warped, images=8)
    text = _compared(one, two)
    assert "8 images, paired" in text
    assert "left out" not in text


def test_among_all_evaluations_those_of_the_same_images_are_paired(tmp_path: Path) -> None:
    one, two = _two(tmp_path)
    make_evaluation(one / "test", "x", 0.25)
    make_evaluation(one / "zzz_other", "x", 0.9, drive="another drive")
    make_evaluation(two / "test", "x", 0.3)
    text = _compared(one, two)
    assert text.count("minus") == 1
    assert re.search(r"Abs Rel ↓\s+0\.2750\s+0\.3250\s+\+0\.0500", text)
    assert "left out" not in text


def test_a_flipped_evaluation_is_not_paired_with_a_plain_one(tmp_path: Path) -> None:
    one, two = _two(tmp_path)
    make_evaluation(one / "flipped", "x", 0.25, post_processing="monodepth blend of two flips")
    make_evaluation(two / "test", "x", 0.3)
    text = " ".join(_compared(one, two).split())
    assert "paired;" not in text
    assert "the first was evaluated with flip=true and the second with no flip or scale" in text
    make_evaluation(two / "flipped", "x", 0.26, post_processing="monodepth blend of two flips")
    text = _compared(one, two)
    assert text.count("6 images, paired") == 1
    assert re.search(r"Abs Rel ↓\s+0\.2750\s+0\.2850", text)
    assert "synthetic, test split, flip=true" in text


def test_other_systems_are_compared_under_their_names(tmp_path: Path) -> None:
    ours = make_run(tmp_path / "ours", status="finished")
    make_evaluation(ours / "test", "x", 0.25)
    theirs = [make_evaluation(tmp_path / f"foreign_{key}", None, 0.3, predictions=f"{key}.npy") for key in "ab"]
    text = _compared(ours, *theirs)
    assert "'foreign_a' minus 'ours'" in text
    assert "'foreign_b' minus 'ours'" in text
    assert "?" not in text
    assert "predictions" not in text


def test_jobs_that_were_evaluated_without_ground_truth_are_not_asked_to_be(sweep: Path) -> None:
    def left_out() -> set[str]:
        return {one.what for one in build(collect([sweep]), ReportOptions(figures=False)).missing}

    assert "Errors and accuracy of the jobs of sweeps" in left_out()
    for job in sweep.iterdir():
        if job.is_dir():
            _explained(job / "evaluation", 0.1)
    assert "Errors and accuracy of the jobs of sweeps" not in left_out()


def test_figure_10_has_a_point_where_a_run_was_timed_at_its_own_size(everything: list[Path], tmp_path: Path) -> None:
    place = tmp_path / "bench" / "benchmark.json"
    row = {**json.loads(place.read_text())["results"][0], "batch_size": 1, "median": 0.01}
    rows = [row, {**row, "size": "64x128", "median": 0.04}, {**row, "batch_size": 2}, {**row, "mode": "compiled"}]
    place.write_text(json.dumps({"results": [*rows, {**row, "median": 0.02}]}))
    inputs = collect(everything)
    (run,) = inputs.runs
    seen = look(run, ())
    assert isinstance(seen, Seen)
    points, table, missing = speed(inputs.benchmarks, {"run": run}, {"run": seen})
    accuracy = ERRORS[4]
    assert [(one.name, one.accuracy, one.seconds, one.setting) for one in points] == [
        ("run", accuracy, 0.02, "cpu, fp32, eager"),
        ("run", accuracy, 0.01, "cpu, fp32, compiled"),
    ]
    assert table is not None
    assert [(row.cells[0], row.cells[2], row.cells[3]) for row in table.rows[:-1]] == [
        *[("run", "32x64", accuracy)] * 4,
        ("mine", "64x128", None),
    ]
    told = {one.what: one.why for one in missing}
    assert "at 64x128" in told["Accuracy of mine (64x128, cpu, fp32, eager, batch 1)"]
    assert "several images at once" in told["Accuracy against time of run (cpu, fp32, eager, batch 2)"]


def test_the_shipped_model_is_compared_with_a_run_under_its_own_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run = add_checkpoint(make_run(tmp_path / "town", status="finished")).parents[1]
    text = " ".join(_compared(Path("street"), run).split())
    assert "only a training has settings to compare" in text
    commands = (
        "`saunet evaluate street data=synthetic output_dir=town/compared_street`",
        "`saunet evaluate town data=synthetic output_dir=town/compared`",
    )
    assert " and ".join(commands) in text
    make_evaluation(run / "compared", "x", 0.25)
    make_evaluation(run / "compared_street", "street", 0.3)
    text = _compared(Path("street"), run)
    assert "'town' minus 'street'" in text
    assert "left out" not in text
    document = build(collect([run]), ReportOptions(figures=False))  # which shows both
    parameters = next(table for table in document.tables if table.name == "table2")
    assert "2 runs: 1 finished, 1 shipped" in document.facts
    assert [row.cells[0] for row in parameters.rows][:2] == ["stratified_nano + aunet", "street"]
    with pytest.raises(DataError, match=r"nothing at nowhere; .* shipped model: street"):
        collect(["nowhere"])


def test_runs_of_folders_alike_are_told_apart_by_the_folders_above(tmp_path: Path) -> None:
    runs = [make_run(tmp_path / place / "first", status="finished") for place in ("a", "b")]
    other = make_run(tmp_path / "b" / "second", status="finished")
    text = _compared(*runs, other)
    assert re.search(r"key\s+a/first\s+b/first\s+second", text)


def test_a_whole_model_goes_by_its_name_unless_a_part_was_changed(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path / "a"))
    for encoder, name in (("efficientnet_lite0", "street"), ("resnet18", "resnet18 + unet_narrow")):
        parts = {"model": "street", "model/encoder": encoder, "model/decoder": "unet_narrow", "model/pose": "posecnn"}
        chosen = dataclasses.replace(run, choices={**run.choices, **parts})
        assert (networks(chosen), with_pose(chosen)) == (name, f"{name}, pose posecnn")
    parts |= {"model/encoder": "efficientnet_lite0", "model/pose": "efficientnet_lite0"}
    assert with_pose(dataclasses.replace(run, choices=parts)) == "street"
