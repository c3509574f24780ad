"""The documentation as tests see it: its fenced blocks, in order."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = sorted([*(ROOT / "docs").glob("*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md"])
_FENCE = re.compile(r"^```(?P<kind>\w*)\n(?P<text>.*?)^```$", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True)
class Block:
    """One fenced block. ``bash`` and ``python`` blocks run as printed; plain ones need data or a cluster."""

    page: str
    kind: str
    text: str


def blocks(*kinds: str) -> list[Block]:
    """Return all blocks of some kinds, page by page."""
    return [
        Block(page.name, found["kind"], found["text"])
        for page in PAGES
        for found in _FENCE.finditer(page.read_text(encoding="utf-8"))
        if found["kind"] in kinds
    ]


def commands(*kinds: str) -> list[tuple[str, str]]:
    """Return each command of the project's tools in such blocks, with its page; comments and line breaks removed."""
    found = []
    for block in blocks(*kinds):
        for line in block.text.replace("\\\n", " ").splitlines():
            command = re.sub(r"\s+#.*", "", line).strip()
            if re.match(r"saunet-[a-z]+(\s|$)", command):
                found.append((block.page, command))
    return found
