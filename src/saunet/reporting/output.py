"""Writing a report to a folder: the page, its Markdown, its tables as CSV and its pictures."""

from __future__ import annotations

from pathlib import Path

from saunet.io.atomic import write_bytes
from saunet.reporting.document import Document
from saunet.reporting.markdown import as_markdown, table_csv
from saunet.reporting.page import as_html


def write(document: Document, folder: Path) -> dict[str, Path]:
    """Write ``report.html``, ``report.md``, ``tables/*.csv`` and ``figures/``, each file whole or not at all.

    Returns:
        The files by their names in the folder.

    Raises:
        DataError: if the folder cannot be written to.
    """
    content = {"report.html": as_html(document).encode(), "report.md": as_markdown(document).encode()}
    content |= {f"tables/{table.name}.csv": table_csv(table).encode() for table in document.tables}
    content |= {f"figures/{picture.name}": picture.data for picture in document.pictures}
    for name, data in content.items():
        write_bytes(folder / name, data)
    return {name: folder / name for name in content}
