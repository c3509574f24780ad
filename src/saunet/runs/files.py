"""Small readers of what runs leave behind; a file that a killed run left half-written is treated as absent."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Any

from saunet.io import plain


def read_json(path: Path) -> Any:
    """Return a JSON file's content; None if it is missing or broken."""
    try:
        return plain.read_json(path)
    except (OSError, ValueError):
        return None


def read_yaml(path: Path) -> Any:
    """Return a YAML file's content as plain containers; None if it is missing or broken."""
    try:
        return plain.read_yaml(path)
    except (OSError, ValueError):
        return None


def read_mapping(path: Path) -> dict[str, Any]:
    """Return a YAML file's mapping; an empty one where there is none."""
    content = read_yaml(path)
    return content if isinstance(content, dict) else {}


def read_numbers(path: Path) -> list[dict[str, float]]:
    """Return the rows of a CSV file of numbers, each with the cells that hold a finite one."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            return [_numbers(row) for row in csv.DictReader(file)]
    except (OSError, csv.Error, UnicodeDecodeError):
        return []


def _numbers(row: dict[str | Any, str | Any]) -> dict[str, float]:
    found = {}
    for key, text in row.items():
        try:
            value = float(text)
        except (TypeError, ValueError):  # an empty cell, or a line that was cut short
            continue
        if math.isfinite(value):
            found[key] = value
    return found
