"""Joining, summarizing and writing results; files appear whole or not at all."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import math
import os
from pathlib import Path

import pytest
from rich.console import Console

from saunet.errors import ConfigError, DataError
from saunet.evaluation.files import as_json, markdown, read_rows, write_results
from saunet.evaluation.result import EvaluationResult
from saunet.evaluation.rows import ImageRow, ViewRow
from saunet.metrics.functional import ERROR_HEADINGS
from saunet.metrics.protocols import protocol
from saunet.tables import show

NAN = (math.nan,) * 7


def result(predictors=("model", "constant"), protocols=("eigen_camera_z", "metric"), blank=True):
    rows = []
    for p, predictor in enumerate(predictors):
        for name in protocols:
            for i in range(3):
                errors = tuple(0.1 * (i + 1) + 0.01 * p + 0.001 * k for k in range(7))
                rows.append(ImageRow(predictor, name, f"drive, {i}", 50 + i, 2.0 + i, errors))
            if blank:
                rows.append(ImageRow(predictor, name, "drive, 3", 0, math.nan, NAN))
    return EvaluationResult(tuple(map(protocol, protocols)), tuple(predictors), tuple(rows))


def test_summary_is_the_mean_over_images():
    summary = result().summaries()[0]
    assert (summary.predictor, summary.protocol) == ("model", "eigen_camera_z")
    assert summary.errors == pytest.approx([0.2 + 0.001 * k for k in range(7)])
    assert (summary.scale, summary.scale_std) == pytest.approx((3.0, math.sqrt(2 / 3)))
    assert (summary.images, summary.images_without_truth) == (3, 1)


def test_summary_of_blank_images_only():
    blank = ImageRow("m", "metric", "a", 0, math.nan, NAN)
    (summary,) = EvaluationResult((protocol("metric"),), ("m", "no rows"), (blank,)).summaries()
    assert (summary.images, summary.images_without_truth) == (0, 1)
    assert all(map(math.isnan, (*summary.errors, summary.scale, summary.scale_std)))


def test_select_names_the_nearest():
    with pytest.raises(ConfigError, match="did you mean 'model'"):
        result().select("modell", "metric")


def test_joined_protocols_and_predictors():
    joined = result(protocols=("metric",)).joined(result(protocols=("eigen_lidar_x",)))
    assert [rules.name for rules in joined.protocols] == ["metric", "eigen_lidar_x"]
    joined = joined.joined(result(predictors=("other",), protocols=("metric",)))
    assert joined.predictors == ("model", "constant", "other")
    assert len(joined.summaries()) == 5


def test_joined_refuses_what_does_not_belong_together():
    with pytest.raises(ConfigError, match="both results hold predictor 'constant'"):
        result().joined(result())
    other = result(predictors=("other",))
    changed = dataclasses.replace(
        other, protocols=tuple(dataclasses.replace(rules, max_depth=50.0) for rules in other.protocols)
    )
    with pytest.raises(ConfigError, match="different rules for protocol 'eigen_camera_z'"):
        result().joined(changed)
    with pytest.raises(ConfigError, match=r"different images \(4 and 3\)"):
        result().joined(result(predictors=("other",), blank=False))


@pytest.mark.parametrize("width", [80, 140])
def test_terminal_table_is_whole_on_a_narrow_terminal(width):
    stream = io.StringIO()
    show(result(predictors=("mean depth map", "[odd] name")).tables(), Console(file=stream, width=width))
    text = stream.getvalue()
    assert max(map(len, text.splitlines())) <= width
    assert "…" not in text
    for predictor in ("mean depth map", "[odd] name"):
        (line, *_) = (line for line in text.splitlines() if line.startswith(predictor))
        assert len(line.removeprefix(predictor).split()) == 7 + 3
    assert "0.200" in text
    assert "3 ± 0.82" in text
    assert "3 images; 1 more without ground-truth pixels" in text
    words = [heading.split()[-2:] for heading in ERROR_HEADINGS]
    assert all(word in text for pair in words for word in pair)


def test_best_value_is_bold():
    stream = io.StringIO()
    console = Console(file=stream, width=140, force_terminal=True, color_system="standard")
    show(result(protocols=("metric",)).tables(), console)
    lines = stream.getvalue().splitlines()
    model, constant = (line for line in lines if line.startswith(("model", "constant")))
    assert model.count("\x1b[1m") == 4
    assert constant.count("\x1b[1m") == 3


def test_markdown():
    lines = markdown(result(protocols=("metric",))).splitlines()
    assert lines[2] == f"| predictor | {' | '.join(ERROR_HEADINGS)} | scale |"
    assert lines[4].startswith("| model | **0.200** | **0.201** |")
    assert lines[4].endswith(" 0.206 | 3 ± 0.82 |")
    assert lines[5].endswith(" **0.216** | 3 ± 0.82 |")


def test_a_model_that_explains_nothing_is_said():
    """Doubled frames: a photometric error of 0 with and without warping is no proof of anything."""

    def views(warped):
        rows = tuple(ViewRow("model", "campus", f"d {i}", "day", warped, 0.1, 0.5, 1.0) for i in range(3))
        return EvaluationResult((protocol("campus"),), ("model",), (), views=rows)

    for warped in (0.1, 0.2):
        (sentence,) = views(warped).warnings
        assert "nothing was learned" in sentence
        assert sentence in markdown(views(warped))
        assert as_json(views(warped))["warnings"] == [sentence]
    assert views(0.09).warnings == ()
    assert "warnings" not in as_json(views(0.09))


def test_files(tmp_path):
    found = result()
    paths = write_results(found, tmp_path / "new" / "folder")
    assert sorted(p.name for p in (tmp_path / "new" / "folder").iterdir()) == sorted(paths)
    data = json.loads(paths["metrics.json"].read_text())
    assert data == as_json(found)
    assert data["protocols"][0]["max_depth"] == 80.0
    assert data["results"][0]["abs_rel"] == pytest.approx(0.2)
    with paths["metrics.csv"].open(newline="") as file:
        table = list(csv.DictReader(file))
    assert [float(row["a3"]) for row in table] == pytest.approx([s.errors[6] for s in found.summaries()])
    rows = read_rows(paths["per_image.csv"])
    assert rows[:3] == found.rows[:3]
    assert rows[3].pixels == 0
    assert math.isnan(rows[3].errors[0])


def test_the_means_without_ground_truth_are_in_the_table_too(tmp_path):
    about = ("model", "campus")
    rows = (ViewRow(*about, "d 0", "day", 0.1, 0.2, 0.5, 1.0), ViewRow(*about, "d 1", "night", 1.1, 0.2, 0.5, 1.0))
    rules = (*result().protocols, protocol("campus"))
    for scored in (False, True):
        found = result() if scored else EvaluationResult((), ("model",), ())
        found = dataclasses.replace(found, protocols=rules, views=rows)
        with write_results(found, tmp_path)["metrics.csv"].open(newline="") as file:
            reader = csv.DictReader(file)
            table = [row for row in reader if row["protocol"] == "campus"]
        assert [row["condition"] for row in table] == ["day", "night", "all"]
        assert [float(row["warped"]) for row in table] == pytest.approx([0.1, 1.1, 0.6])
        assert [row["images"] for row in table] == ["1", "1", "2"]
        assert list(reader.fieldnames)[:2] == ["predictor", "protocol"]
        assert ("abs_rel" in reader.fieldnames) is scored


def test_json_has_no_nan():
    blank = EvaluationResult((protocol("metric"),), ("m",), (ImageRow("m", "metric", "a", 0, math.nan, NAN),))
    assert json.loads(json.dumps(as_json(blank), allow_nan=False))["results"][0]["abs_rel"] is None


def test_nothing_is_left_behind_when_writing_fails(tmp_path, monkeypatch):
    (tmp_path / "metrics.json").write_text("old")

    def full(path, data):
        with path.open("wb") as file:
            file.write(data[:10])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(DataError, match=r"cannot write .*: No space left"):
        write_results(result(), tmp_path)
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]
    assert (tmp_path / "metrics.json").read_text() == "old"


def test_unwritable_place(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(DataError, match="cannot write"):
        write_results(result(), tmp_path / "file" / "below")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_no_permission(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(DataError, match="Permission denied"):
        write_results(result(), tmp_path)


def test_reading_rows_that_are_none(tmp_path):
    with pytest.raises(DataError, match="cannot read"):
        read_rows(tmp_path / "missing.csv")
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    with pytest.raises(DataError, match="has no column 'predictor'"):
        read_rows(tmp_path / "other.csv")
    path = write_results(result(), tmp_path)["per_image.csv"]
    path.write_text(path.read_text().replace(",50,", ",many,"))
    with pytest.raises(DataError, match="not a row of numbers"):
        read_rows(path)


def test_worst_images_and_a_plot():
    found = result(blank=True)
    worst = found.worst(2)
    assert [row.cells[0] for row in worst.rows] == ["drive, 2", "drive, 1"]
    assert worst.rows[0].cells[1] == pytest.approx(0.3)
    by_a1 = found.worst(1, error="a1", predictor="constant")  # larger is better there
    assert by_a1.rows[0].cells[0] == "drive, 0"
    assert "'constant'" in by_a1.title
    with pytest.raises(ConfigError, match="did you mean 'abs_rel'"):
        found.worst(error="absrel")
    assert found.plot()._repr_svg_().lstrip().startswith("<?xml")
    assert "<table>" in found._repr_html_()
    with pytest.raises(ConfigError, match="ground truth"):
        EvaluationResult((protocol("campus"),), ("model",), ()).worst()
