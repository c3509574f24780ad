"""A table of plain values that becomes text for a terminal, Markdown, HTML or CSV."""

from __future__ import annotations

import csv
import io
import itertools
import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from saunet.tables.templates import markdown_text, rendered

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table as RichTable

Cell = str | float | int | None
Kind = Literal["plain", "published", "measured", "failed", "dim"]
Mark = Literal["good", "bad"]

_STYLES = {"": "", "best": "bold", "good": "bold green", "bad": "bold red"}
_NOTEBOOK = """<style>
.saunet table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
.saunet th, .saunet td { padding: 3px 10px; text-align: left; }
.saunet thead th { border-bottom: 1px solid; vertical-align: bottom; }
.saunet .number { text-align: right; white-space: nowrap; }
.saunet .scroll { overflow-x: auto; }
.saunet .note { margin: 4px 0; font-size: smaller; }
</style>"""
_PLAIN_WIDTH = 160
"""Characters in a line where the output is not a terminal."""


@dataclass(frozen=True, slots=True)
class Column:
    """A column: its heading, with an arrow towards better numbers if any are, and how its numbers are written."""

    label: str
    """Such as ``Abs Rel ↓``."""
    format: str = ""
    """Such as ``.3f``; empty for text and whole numbers."""

    @property
    def arrow(self) -> str:
        return self.label[-1] if self.label.endswith((" ↓", " ↑")) else ""

    @property
    def heading(self) -> str:
        return self.label[:-2] if self.arrow else self.label

    @property
    def better(self) -> int:
        """Whether smaller (-1) or larger (1) numbers are better, or neither (0)."""
        return {"↓": -1, "": 0, "↑": 1}[self.arrow]

    def text(self, value: Cell) -> str:
        """Return a value as people read it; a dash where there is none."""
        if value is None or (isinstance(value, float) and math.isnan(value)):
            return "–"
        if isinstance(value, str):
            return value
        if self.format:
            return format(value, self.format)
        return f"{value:,}" if isinstance(value, int) else f"{value:.4g}"


def columns(*labels: str) -> tuple[Column, ...]:
    """Return columns, each from its label and, behind a ``|``, its format, such as ``Abs Rel ↓|.3f``."""
    return tuple(Column(*label.split("|")) for label in labels)


@dataclass(frozen=True, slots=True)
class Row:
    """A row of a table."""

    cells: tuple[Cell, ...]
    kind: Kind = "plain"
    group: str = ""
    """Rows of one group stand together under this heading and are compared with each other only."""
    note: str = ""
    """A sentence about the row, such as why a run failed."""
    marks: Mapping[int, Mark] = field(default_factory=dict)
    """Cells, by their column, that are clearly good or bad."""


@dataclass(frozen=True, slots=True)
class Table:
    r"""A table of plain values.

    Examples:
        >>> rows = (Row(("ours", 0.1)), Row(("theirs", 0.25)))
        >>> table = Table("scores", "Scores", columns("model", "Abs Rel ↓|.3f"), rows)
        >>> print(table.markdown())
        **Scores**
        <BLANKLINE>
        | model | Abs Rel ↓ |
        |---|---:|
        | ours | **0.100** |
        | theirs | 0.250 |
        >>> table.csv()
        'model,Abs Rel\nours,0.1\ntheirs,0.25\n'
    """

    name: str
    """Name of its CSV file."""
    title: str
    """What stands before a colon is bold."""
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()
    bold_best: bool = True
    """Whether the best value of each column that has a better side is bold."""

    def text(self, row: Row, column: int) -> str:
        return self.columns[column].text(row.cells[column])

    def best(self, row: Row, column: int) -> bool:
        """Return whether a cell is the best, as printed, of at least two in its group."""
        better, value = self.columns[column].better, row.cells[column]
        if not self.bold_best or not better or not isinstance(value, int | float):
            return False
        rivals = [other.cells[column] for other in self.rows if other.group == row.group]
        numbers = [number for number in rivals if isinstance(number, int | float) and not math.isnan(number)]
        top = max(numbers) if better > 0 else min(numbers)
        return len(numbers) > 1 and self.columns[column].text(top) == self.text(row, column)

    def cells(self, row: Row) -> list[tuple[str, str]]:
        """Return each cell as people read it, and whether it is ``best``, ``good`` or ``bad``, or nothing of these."""
        marks = [row.marks.get(index) or "best" * self.best(row, index) for index in range(len(row.cells))]
        return [(self.text(row, index), mark) for index, mark in enumerate(marks)]

    def numeric(self, column: int) -> bool:
        """Return whether a column holds numbers and is aligned to the right."""
        return bool(self.columns[column].format) or any(isinstance(row.cells[column], int | float) for row in self.rows)

    def grouped(self) -> list[tuple[str, list[Row]]]:
        """Return neighboring rows of one group together."""
        return [(group, list(rows)) for group, rows in itertools.groupby(self.rows, lambda row: row.group)]

    def width(self) -> int:
        """Return how many characters wide the table is on a terminal where nothing wraps, its title aside."""
        from rich.console import Console

        shown = self.rich()
        shown.title = shown.caption = None
        return Console(width=1000).measure(shown).maximum

    def __str__(self) -> str:
        """Return it as a terminal shows it, as wide as it is."""
        from rich.console import Console

        text = io.StringIO()
        Console(file=text, width=max(80, self.width()), color_system=None).print(self.rich())
        return "\n".join(line.rstrip() for line in text.getvalue().splitlines())

    def rich(self) -> RichTable:
        """Return the table for a terminal, narrow enough for 80 columns where its texts are short."""
        from rich.box import HORIZONTALS
        from rich.table import Table as RichTable
        from rich.text import Text

        head, colon, rest = self.title.partition(": ")
        title = Text.assemble((head, "bold"), colon + rest)
        shown = RichTable(title=title, box=HORIZONTALS, padding=0, show_edge=False, title_justify="left")
        shown.title_style, shown.caption_justify = "", "left"
        for index, column in enumerate(self.columns):
            if self.numeric(index):
                heading = "\n".join(textwrap.wrap(column.heading, 6, break_long_words=False))
                label = f"{heading} {column.arrow}".rstrip()
                shown.add_column(Text(label), justify="right", no_wrap=True, min_width=6)
            else:
                shown.add_column(Text(column.label), overflow="fold", min_width=min(9, len(column.label)))
        for group, rows in self.grouped():
            if group:
                shown.add_row(Text(group, "italic"))
            for row in rows:
                cells = [Text(text, _STYLES[mark]) for text, mark in self.cells(row)]
                shown.add_row(*cells, style="dim" if row.kind == "dim" else None)
        notes = [*self.notes, *(f"{self.text(row, 0)}: {row.note}" for row in self.rows if row.note)]
        if notes:
            shown.caption = Text("\n".join(notes))
        return shown

    def markdown(self) -> str:
        """Return the table as Markdown; the sentence about a row follows its second cell."""
        head, colon, rest = map(markdown_text, self.title.partition(": "))
        aligned = ("---:|" if self.numeric(index) else "---|" for index in range(len(self.columns)))
        labels = _markdown_line(markdown_text(column.label) for column in self.columns)
        lines = [f"**{head}**{colon}{rest}", "", labels, "|" + "".join(aligned)]
        for group, rows in self.grouped():
            if group:
                lines.append(_markdown_line([f"*{markdown_text(group)}*", *[""] * (len(self.columns) - 1)]))
            for row in rows:
                marked = ((markdown_text(text), mark) for text, mark in self.cells(row))
                cells = [f"**{text}**" if text and mark else text for text, mark in marked]
                if row.note:
                    cells[1] += f": {markdown_text(row.note)}"
                lines.append(_markdown_line(cells))
        notes = [f"{markdown_text(note)}  " for note in self.notes]
        return "\n".join([*lines, *([""] if notes else []), *notes])

    def html(self) -> str:
        """Return the table as HTML: a heading, the table in a box that scrolls, and the notes."""
        kinds = ["number" if self.numeric(index) else "text" for index in range(len(self.columns))]
        return rendered("tables/table.html", table=self, kinds=kinds)

    def _repr_html_(self) -> str:
        return notebook_html([self])

    def csv(self) -> str:
        """Return the table as CSV: numbers in full, columns for the group and the note where there are any."""
        grouped, noted = any(row.group for row in self.rows), any(row.note for row in self.rows)
        header = [column.heading for column in self.columns] + ["Source"] * grouped + ["Note"] * noted
        return csv_text(header, ([*row.cells, *[row.group] * grouped, *[row.note] * noted] for row in self.rows))


def _markdown_line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


def csv_text(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return values as CSV, floating-point numbers in full; None and NaN become empty cells."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(header)
    for row in rows:
        writer.writerow(["" if cell is None or cell != cell else cell for cell in row])
    return stream.getvalue()


def stdout() -> Console:
    """Return the standard output as rich sees it: as wide as the terminal, and wide where it is a file or a pipe."""
    from rich.console import Console

    console = Console()
    return console if console.is_terminal or console.is_jupyter else Console(width=_PLAIN_WIDTH)


def notebook_html(tables: Iterable[Table]) -> str:
    """Return tables as HTML that brings its own look, for pages that have none for tables."""
    return f"<div class=saunet>{_NOTEBOOK}{''.join(table.html() for table in tables)}</div>"


def show(tables: Iterable[Table], console: Console | None = None) -> None:
    """Print tables, an empty line after each."""
    console = console or stdout()
    for table in tables:
        console.print(table.rich(), "")
