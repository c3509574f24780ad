"""What a report consists of, and how it is written: one HTML page that fetches nothing, Markdown, CSV, pictures."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from importlib import resources
from pathlib import Path

from saunet.io.atomic import write_bytes
from saunet.tables import Table, markdown_line, markdown_text


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


_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


def as_html(document: Document) -> str:
    """Return the report as one self-contained page."""
    style = resources.files("saunet.reporting").joinpath("page.css").read_text(encoding="utf-8")
    titles = [section.title for section in document.sections] + (["Left out"] if document.missing else [])
    links = "".join(f'<a href="#{_anchor(title)}">{escape(title)}</a>' for title in titles)
    facts = "".join(f"<li>{escape(fact)}</li>" for fact in document.facts)
    return "\n".join(
        [
            '<!doctype html><html lang="en"><head><meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{escape(document.title)}</title><style>{style}</style></head><body>",
            f"<header><h1>{escape(document.title)}</h1><ul class=facts>{facts}</ul><nav>{links}</nav></header><main>",
            *map(_section, document.sections),
            _missing(document),
            "</main></body></html>",
            "",
        ]
    )


def _section(section: Section) -> str:
    intro = f"<p class=intro>{escape(section.intro)}</p>" if section.intro else ""
    blocks = "\n".join(map(_block, section.blocks))
    return f'<section id="{_anchor(section.title)}"><h2>{escape(section.title)}</h2>{intro}\n{blocks}</section>'


def _block(block: Table | Figure | Gallery) -> str:
    if isinstance(block, Table):
        return block.html()
    if isinstance(block, Figure):
        caption = f"<figcaption><b>{escape(block.title)}.</b> {escape(block.caption)}</figcaption>"
        return f"<figure>{_html_image(block.picture)}{caption}</figure>"
    scenes = "\n".join(map(_html_scene, block.scenes))
    return f"<h3>{escape(block.title)}</h3><p class=note>{escape(block.caption)}</p>{scenes}"


def _html_scene(scene: Scene) -> str:
    tiles = "".join(map(_tile, scene.tiles))
    pairs = " pairs" if len(scene.tiles) in (1, 2, 4) else ""
    return f'<div class=scene><h4>{escape(scene.title)}</h4><div class="tiles{pairs}">{tiles}</div></div>'


def _tile(tile: Tile) -> str:
    zooms = f"<div class=zooms>{''.join(map(_html_image, tile.zooms))}</div>" if tile.zooms else ""
    return f"<div class=tile><span>{escape(tile.label)}</span>{_html_image(tile.picture)}{zooms}</div>"


def _html_image(picture: Picture) -> str:
    content = base64.b64encode(picture.data).decode()
    return f'<img alt="{escape(picture.alt)}" src="data:{picture.media};base64,{content}">'


def _missing(document: Document) -> str:
    if not document.missing:
        return ""
    items = "".join(f"<li><b>{escape(one.what)}</b>: {escape(one.why)}</li>" for one in document.missing)
    intro = "<p class=intro>What has no data is not shown.</p>"
    return f"<section id={_anchor('Left out')}><h2>Left out</h2>{intro}<ul class=missing>{items}</ul></section>"


def _anchor(title: str) -> str:
    return "".join(letter if letter.isalnum() else "-" for letter in title.lower())


def as_markdown(document: Document, pictures: str = "figures") -> str:
    """Return the report as Markdown."""
    parts = [f"# {document.title}", *(f"- {fact}" for fact in document.facts)]
    for section in document.sections:
        parts += ["", f"## {section.title}", *(["", section.intro] if section.intro else [])]
        for block in section.blocks:
            parts.append("")
            if isinstance(block, Table):
                parts.append(block.markdown())
            elif isinstance(block, Figure):
                parts += [f"**{block.title}**", "", _image(block.picture, pictures), "", block.caption]
            else:
                parts.append(_gallery(block, pictures))
    if document.missing:
        parts += ["", "## Left out", "", "What has no data is not shown:", ""]
        parts += [f"- **{markdown_text(missing.what)}**: {markdown_text(missing.why)}" for missing in document.missing]
    return "\n".join(parts) + "\n"


def _gallery(gallery: Gallery, pictures: str) -> str:
    parts = [f"**{gallery.title}**", "", gallery.caption]
    for scene in gallery.scenes:
        parts += ["", f"*{markdown_text(scene.title)}*", "", _scene(scene, pictures)]
    return "\n".join(parts)


def _scene(scene: Scene, pictures: str) -> str:
    lines = [markdown_line([markdown_text(tile.label) for tile in scene.tiles]), "|" + "---|" * len(scene.tiles)]
    lines.append(markdown_line([_image(tile.picture, pictures) for tile in scene.tiles]))
    lines.append(markdown_line([" ".join(_image(zoom, pictures) for zoom in tile.zooms) for tile in scene.tiles]))
    return "\n".join(lines)


def _image(picture: Picture, folder: str) -> str:
    return f"![{markdown_text(picture.alt)}]({folder}/{picture.name})"


def write(document: Document, folder: Path) -> dict[str, Path]:
    """Write ``report.html``, ``report.md``, ``tables/*.csv`` and ``figures/``, each file whole or not at all."""
    content = {"report.html": as_html(document).encode(), "report.md": as_markdown(document).encode()}
    content |= {f"tables/{table.name}.csv": table.csv().encode() for table in document.tables}
    content |= {f"figures/{picture.name}": picture.data for picture in document.pictures}
    for name, data in content.items():
        write_bytes(folder / name, data)
    return {name: folder / name for name in content}
