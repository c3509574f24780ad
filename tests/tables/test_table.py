"""One table in four forms, and the drawing of time against accuracy."""

from __future__ import annotations

import csv
import doctest
import io
import math
from pathlib import Path

import cv2
import pytest
from rich.console import Console

from saunet.tables import Column, Row, Table, columns, csv_text, show, table
from saunet.tables.drawing import Point, draw_speed, save, svg

COLUMNS = columns("method", "Abs Rel ↓|.3f", "δ1 ↑|.3f", "images")
ROWS = (
    Row(("ours", 0.1234, 0.9, 697), group="one"),
    Row(("theirs", 0.1231, 0.8, 697), group="one", marks={2: "bad"}),
    Row(("empty", math.nan, None, 1234), "failed", "two", "the loss became NaN"),
    Row(("alone", 0.3, 0.1, 5), group="two"),
)
TABLE = Table("scores", "Scores: a test", COLUMNS, ROWS, ("A note.",))


def printed(shown: Table, width: int = 80, color: bool = False) -> str:
    stream = io.StringIO()
    show([shown], Console(file=stream, width=width, force_terminal=color, color_system="standard" if color else None))
    return stream.getvalue()


def test_examples() -> None:
    assert doctest.testmod(table).attempted > 3
    assert doctest.testmod(table).failed == 0


def test_best_is_within_a_group_and_as_printed() -> None:
    assert [TABLE.best(row, 1) for row in ROWS] == [True, True, False, False]  # 0.123 twice; one alone is no best
    assert [TABLE.best(row, 2) for row in ROWS] == [True, False, False, False]
    assert not any(TABLE.best(row, 3) for row in ROWS)
    assert not any(Table("t", "T", COLUMNS, ROWS, bold_best=False).best(row, 2) for row in ROWS)


def test_terminal_shows_every_number_in_eighty_columns() -> None:
    text = printed(TABLE)
    assert max(map(len, text.splitlines())) <= 80
    words = "Scores: a test|Abs|Rel ↓|δ1 ↑|0.123|1,234|–|one|two|A note.|empty: the loss became NaN"
    assert all(word in text for word in words.split("|"))
    assert "nan" not in text
    theirs = next(line for line in printed(TABLE, color=True).splitlines() if "theirs" in line)
    assert "\x1b[1m 0.123" in theirs
    assert "\x1b[1;31m 0.800" in theirs


def test_markup_in_a_name_stays_text() -> None:
    odd = Table("t", "T", (Column("a|b"), Column("Status")), (Row(("[red]<script>|", "failed"), note="<i>"),))
    assert "[red]<script>|" in printed(odd)
    assert "&lt;script>\\|" in odd.markdown()
    html = odd.html()
    assert "<script>" not in html
    assert "<i>" not in html
    assert '<span class="chip failed">' in html


def test_markdown_and_html_have_the_groups_the_best_and_the_reasons() -> None:
    lines = TABLE.markdown().splitlines()
    assert lines[0] == "**Scores**: a test"
    assert lines[2:4] == ["| method | Abs Rel ↓ | δ1 ↑ | images |", "|---|---:|---:|---:|"]
    assert lines[4] == "| *one* |  |  |  |"
    assert lines[5] == "| ours | **0.123** | **0.900** | 697 |"
    assert lines[6] == "| theirs | **0.123** | **0.800** | 697 |"  # a mark stands out too
    assert lines[8] == "| empty | –: the loss became NaN | – | 1,234 |"
    html = TABLE.html()
    assert html.count('<tr class="group ') == 2
    assert "<b class=bad>0.800</b>" in html
    assert '<tr class="failed why"><td colspan=4>the loss became NaN</td></tr>' in html


def test_csv_keeps_full_numbers_and_its_sources() -> None:
    rows = list(csv.DictReader(io.StringIO(TABLE.csv())))
    assert rows[0] == {"method": "ours", "Abs Rel": "0.1234", "δ1": "0.9", "images": "697", "Source": "one", "Note": ""}
    assert (rows[2]["Abs Rel"], rows[2]["δ1"], rows[2]["Note"]) == ("", "", "the loss became NaN")
    assert csv_text(["a"], [[1 / 3], [None], [math.nan]]) == 'a\n0.3333333333333333\n""\n""\n'


def test_a_drawing_has_a_point_for_each_measurement(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    points = [
        Point("ours", 0.1, 0.02, "192x640, cpu"),
        Point("ours", 0.1, 0.05, "320x1024, cpu"),
        Point("unknown", None, 0.04, "192x640, cpu"),
        Point("theirs, published", 0.12, 0.003, published=True),
    ]
    figure = draw_speed(points, "Abs Rel")
    known, unknown = figure.axes
    assert [label.get_text() for label in unknown.get_xticklabels()] == ["unknown"]
    spots = sorted(line.get_ydata()[0] for axis in figure.axes for line in axis.lines if len(line.get_ydata()))
    assert spots == [0.003, 0.02, 0.04, 0.05]
    assert [text.get_text() for text in known.texts] == ["ours", "theirs, published"]
    assert svg(draw_speed(points, "Abs Rel")) == svg(draw_speed(points, "Abs Rel"))
    save(figure, tmp_path / "deep" / "speed.png")
    assert cv2.imread(str(tmp_path / "deep" / "speed.png")).shape[1] > 900


def test_a_printed_table_is_readable() -> None:
    table = Table("scores", "Scores", columns("model", "Abs Rel ↓|.3f"), (Row(("ours", 0.1)), Row(("theirs", 0.25))))
    lines = str(table).splitlines()
    assert lines[0] == "Scores"
    assert lines[-2:] == ["ours    0.100", "theirs  0.250"]
