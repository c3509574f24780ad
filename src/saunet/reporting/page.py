"""The parts of a report, and writing them: one self-contained HTML page, Markdown, CSV, pictures."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from saunet.io.atomic import write_bytes
from saunet.tables import Table
from saunet.tables.templates import rendered


@dataclass(frozen=True, slots=True)
class Picture:
    """An encoded image, named like its file."""

    name: str
    data: bytes = field(repr=False)
    alt: str

    @property
    def uri(self) -> str:
        media = {"svg": "image/svg+xml", "png": "image/png"}.get(self.name.rpartition(".")[2], "image/jpeg")
        return f"data:{media};base64,{base64.b64encode(self.data).decode()}"


@dataclass(frozen=True, slots=True)
class Figure:
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
    title: str
    scenes: tuple[Scene, ...]
    caption: str
    numbers: tuple[str, ...] = ()
    """Numbers of the paper's figures that it corresponds to."""


@dataclass(frozen=True, slots=True)
class Missing:
    """A part that was not made, and why."""

    what: str
    why: str


@dataclass(frozen=True, slots=True)
class Section:
    title: str
    blocks: Sequence[Table | Figure | Gallery]
    intro: str = ""

    @property
    def anchor(self) -> str:
        return "".join(letter if letter.isalnum() else "-" for letter in self.title.lower())


@dataclass(frozen=True, slots=True)
class Document:
    title: str
    facts: tuple[str, ...]
    """The line below the title: time, number of runs, version."""
    sections: tuple[Section, ...]
    missing: tuple[Missing, ...]

    @property
    def tables(self) -> list[Table]:
        return [block for section in self.sections for block in section.blocks if isinstance(block, Table)]

    @property
    def pictures(self) -> list[Picture]:
        blocks = [block for section in self.sections for block in section.blocks]
        tiles = [
            tile for block in blocks if isinstance(block, Gallery) for scene in block.scenes for tile in scene.tiles
        ]
        figures = [block.picture for block in blocks if isinstance(block, Figure)]
        return figures + [picture for tile in tiles for picture in (tile.picture, *tile.zooms)]


def as_html(document: Document, live: float | None = None) -> str:
    """Return the page as HTML; with ``live`` it reloads itself every this many seconds."""
    return rendered("reporting/page.html", page=document, live=live)


def as_markdown(document: Document) -> str:
    return rendered("reporting/page.md", page=document)


def write(document: Document, folder: Path) -> dict[str, Path]:
    """Write ``report.html``, ``report.md``, ``tables/*.csv`` and ``figures/``, each file whole or not at all."""
    content = {"report.html": as_html(document).encode(), "report.md": as_markdown(document).encode()}
    content |= {f"tables/{table.name}.csv": table.csv().encode() for table in document.tables}
    content |= {f"figures/{picture.name}": picture.data for picture in document.pictures}
    for name, data in content.items():
        write_bytes(folder / name, data)
    return {name: folder / name for name in content}
