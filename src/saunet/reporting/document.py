"""What a report consists of, before anyone decides how it looks: sections of tables, figures and scenes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

Cell = str | float | int | None
Kind = Literal["plain", "published", "measured", "failed"]


@dataclass(frozen=True, slots=True)
class Column:
    """A column of a table."""

    heading: str
    digits: int | None = None
    """Digits after the point of its numbers; None for text and whole numbers."""
    better: Literal[-1, 0, 1] = 0
    """Whether smaller (-1) or larger (1) numbers are better."""


@dataclass(frozen=True, slots=True)
class Row:
    """A row of a table."""

    cells: tuple[Cell, ...]
    kind: Kind = "plain"
    group: str = ""
    """Rows of one group stand together under this heading and are compared with each other only."""
    note: str = ""
    """A sentence below the row, such as why a run failed."""


@dataclass(frozen=True, slots=True)
class Table:
    """A table; its name is that of its CSV file."""

    name: str
    title: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()

    def text(self, row: Row, column: int) -> str:
        """Return a cell as people read it: a dash where there is nothing."""
        return cell_text(row.cells[column], self.columns[column].digits)

    def best(self, row: Row, column: int) -> bool:
        """Tell whether a cell is the best, as printed, of at least two in its group."""
        better, value = self.columns[column].better, row.cells[column]
        if not better or not isinstance(value, int | float):
            return False
        rivals = [other.cells[column] for other in self.rows if other.group == row.group]
        numbers = [number for number in rivals if isinstance(number, int | float)]
        top = max(numbers) if better > 0 else min(numbers)
        digits = self.columns[column].digits
        return len(numbers) > 1 and cell_text(top, digits) == cell_text(value, digits)


@dataclass(frozen=True, slots=True)
class Picture:
    """An encoded image; its name is that of its file."""

    name: str
    data: bytes = field(repr=False)
    alt: str

    @property
    def media(self) -> str:
        """The media type, by the name's suffix."""
        return {"svg": "image/svg+xml", "png": "image/png"}.get(self.name.rpartition(".")[2], "image/jpeg")


@dataclass(frozen=True, slots=True)
class Figure:
    """A drawing with its caption."""

    title: str
    picture: Picture
    caption: str


@dataclass(frozen=True, slots=True)
class Tile:
    """One picture of a scene, with enlarged parts of it."""

    label: str
    picture: Picture
    zooms: tuple[Picture, ...] = ()


@dataclass(frozen=True, slots=True)
class Scene:
    """The same scene as input and as several models see it."""

    title: str
    tiles: tuple[Tile, ...]


@dataclass(frozen=True, slots=True)
class Gallery:
    """Scenes under one caption."""

    title: str
    scenes: tuple[Scene, ...]
    caption: str


@dataclass(frozen=True, slots=True)
class Missing:
    """Something that was not made, and why."""

    what: str
    why: str


@dataclass(frozen=True, slots=True)
class Section:
    """A part of the report under a heading."""

    title: str
    blocks: Sequence[Table | Figure | Gallery]
    intro: str = ""


@dataclass(frozen=True, slots=True)
class Document:
    """A whole report."""

    title: str
    facts: tuple[str, ...]
    """What stands below the title: when, from how many runs, by which version."""
    sections: tuple[Section, ...]
    missing: tuple[Missing, ...]

    @property
    def tables(self) -> list[Table]:
        """All tables."""
        return [block for section in self.sections for block in section.blocks if isinstance(block, Table)]

    @property
    def pictures(self) -> list[Picture]:
        """All pictures, those of scenes included."""
        found = []
        for section in self.sections:
            for block in section.blocks:
                if isinstance(block, Figure):
                    found.append(block.picture)
                elif isinstance(block, Gallery):
                    for scene in block.scenes:
                        for tile in scene.tiles:
                            found += [tile.picture, *tile.zooms]
        return found


def cell_text(value: Cell, digits: int | None) -> str:
    """Return a value as people read it; a dash for nothing."""
    if value is None:
        return "–"
    if isinstance(value, str):
        return value
    if digits is not None:
        return f"{value:.{digits}f}"
    return f"{value:,}" if isinstance(value, int) else f"{value:.4g}"
