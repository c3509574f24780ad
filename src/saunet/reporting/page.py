"""A report as one HTML page: pictures are inside, nothing is fetched, and the page itself forbids it."""

from __future__ import annotations

import base64
from html import escape
from importlib import resources

from saunet.reporting.document import Document, Figure, Gallery, Picture, Scene, Section, Table, Tile

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
        return _table(block)
    if isinstance(block, Figure):
        caption = f"<figcaption><b>{escape(block.title)}.</b> {escape(block.caption)}</figcaption>"
        return f"<figure>{_image(block.picture)}{caption}</figure>"
    scenes = "\n".join(map(_scene, block.scenes))
    return f"<h3>{escape(block.title)}</h3><p class=note>{escape(block.caption)}</p>{scenes}"


def _table(table: Table) -> str:
    numeric = ["number" if _is_number(table, index) else "text" for index in range(len(table.columns))]
    arrows = {-1: " <i>↓</i>", 0: "", 1: " <i>↑</i>"}
    head = "".join(
        f"<th class={kind}>{escape(column.heading)}{arrows[column.better]}</th>"
        for column, kind in zip(table.columns, numeric, strict=True)
    )
    body, group = [], ""
    for row in table.rows:
        if row.group != group:
            group = row.group
            body.append(f'<tr class="group {row.kind}"><th colspan={len(table.columns)}>{escape(group)}</th></tr>')
        cells = []
        for index, kind in enumerate(numeric):
            text = escape(table.text(row, index))
            text = f"<b>{text}</b>" if table.best(row, index) else text
            if table.columns[index].heading == "Status":
                text = f'<span class="chip {escape(str(row.cells[index]))}">{text}</span>'
            cells.append(f"<td class={kind}>{text}</td>")
        body.append(f"<tr class={row.kind}>{''.join(cells)}</tr>")
        if row.note:
            body.append(f'<tr class="{row.kind} why"><td colspan={len(table.columns)}>{escape(row.note)}</td></tr>')
    notes = "".join(f"<p class=note>{escape(note)}</p>" for note in table.notes)
    return (
        f"<h3>{escape(table.title)}</h3><div class=scroll><table><thead><tr>{head}</tr></thead>"
        f"<tbody>{''.join(body)}</tbody></table></div>{notes}"
    )


def _scene(scene: Scene) -> str:
    tiles = "".join(map(_tile, scene.tiles))
    pairs = " pairs" if len(scene.tiles) in (1, 2, 4) else ""
    return f'<div class=scene><h4>{escape(scene.title)}</h4><div class="tiles{pairs}">{tiles}</div></div>'


def _tile(tile: Tile) -> str:
    zooms = f"<div class=zooms>{''.join(map(_image, tile.zooms))}</div>" if tile.zooms else ""
    return f"<div class=tile><span>{escape(tile.label)}</span>{_image(tile.picture)}{zooms}</div>"


def _image(picture: Picture) -> str:
    content = base64.b64encode(picture.data).decode()
    return f'<img alt="{escape(picture.alt)}" src="data:{picture.media};base64,{content}">'


def _missing(document: Document) -> str:
    if not document.missing:
        return ""
    items = "".join(f"<li><b>{escape(one.what)}</b>: {escape(one.why)}</li>" for one in document.missing)
    intro = "<p class=intro>What has no data is not shown.</p>"
    return f"<section id={_anchor('Left out')}><h2>Left out</h2>{intro}<ul class=missing>{items}</ul></section>"


def _is_number(table: Table, column: int) -> bool:
    return table.columns[column].digits is not None or any(
        isinstance(row.cells[column], int | float) for row in table.rows
    )


def _anchor(title: str) -> str:
    return "".join(letter if letter.isalnum() else "-" for letter in title.lower())
