"""A report as Markdown beside a folder of pictures, and its tables as CSV."""

from __future__ import annotations

import csv
import io

from saunet.reporting.document import Document, Figure, Gallery, Picture, Scene, Table


def as_markdown(document: Document, pictures: str = "figures") -> str:
    """Return the report as Markdown.

    Args:
        document: The report.
        pictures: Folder of the pictures, relative to the page.
    """
    parts = [f"# {document.title}", *(f"- {fact}" for fact in document.facts)]
    for section in document.sections:
        parts += ["", f"## {section.title}", *(["", section.intro] if section.intro else [])]
        for block in section.blocks:
            parts.append("")
            if isinstance(block, Table):
                parts.append(table_markdown(block))
            elif isinstance(block, Figure):
                parts += [f"**{block.title}**", "", _image(block.picture, pictures), "", block.caption]
            else:
                parts.append(_gallery(block, pictures))
    if document.missing:
        parts += ["", "## Left out", "", "What has no data is not shown:", ""]
        parts += [f"- **{_escape(missing.what)}**: {_escape(missing.why)}" for missing in document.missing]
    return "\n".join(parts) + "\n"


def table_markdown(table: Table) -> str:
    """Return one table as Markdown; the best of each group is bold, a run's sentence follows its status."""
    headings = [column.heading for column in table.columns]
    lines = [f"**{table.title}**", "", _line(headings)]
    lines.append("|" + "|".join("---:" if column.digits is not None else "---" for column in table.columns) + "|")
    group = ""
    for row in table.rows:
        if row.group != group:
            group = row.group
            lines.append(_line([f"*{_escape(group)}*", *[""] * (len(headings) - 1)]))
        cells = []
        for index in range(len(row.cells)):
            text = _escape(table.text(row, index))
            cells.append(f"**{text}**" if table.best(row, index) else text)
        if row.note:
            cells[1] += f": {_escape(row.note)}"
        lines.append(_line(cells))
    return "\n".join([*lines, *([""] if table.notes else []), *(f"{_escape(note)}  " for note in table.notes)])


def table_csv(table: Table) -> str:
    """Return one table as CSV: numbers in full, a column for the group and the note where there are any."""
    grouped, noted = any(row.group for row in table.rows), any(row.note for row in table.rows)
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    extra = [*(["Source"] if grouped else []), *(["Note"] if noted else [])]
    writer.writerow([*(column.heading for column in table.columns), *extra])
    for row in table.rows:
        ends = [*([row.group] if grouped else []), *([row.note] if noted else [])]
        writer.writerow(["" if cell is None else cell for cell in row.cells] + ends)
    return stream.getvalue()


def _gallery(gallery: Gallery, pictures: str) -> str:
    parts = [f"**{gallery.title}**", "", gallery.caption]
    for scene in gallery.scenes:
        parts += ["", f"*{_escape(scene.title)}*", "", _scene(scene, pictures)]
    return "\n".join(parts)


def _scene(scene: Scene, pictures: str) -> str:
    lines = [_line([_escape(tile.label) for tile in scene.tiles]), "|" + "---|" * len(scene.tiles)]
    lines.append(_line([_image(tile.picture, pictures) for tile in scene.tiles]))
    lines.append(_line([" ".join(_image(zoom, pictures) for zoom in tile.zooms) for tile in scene.tiles]))
    return "\n".join(lines)


def _image(picture: Picture, folder: str) -> str:
    return f"![{_escape(picture.alt)}]({folder}/{picture.name})"


def _line(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _escape(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ").replace("<", "&lt;")
