"""One table for every tool, and the drawings beside it."""

from __future__ import annotations

from saunet.tables.table import Cell, Column, Row, Table, columns, csv_text, notebook_html, show, stdout

__all__ = ["Cell", "Column", "Row", "Table", "columns", "csv_text", "notebook_html", "show", "stdout"]
