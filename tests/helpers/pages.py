"""The documentation as tests see it: its fenced blocks, in order."""

from __future__ import annotations

import functools
import itertools
import re
from dataclasses import dataclass
from pathlib import Path

from hydra import compose
from omegaconf import DictConfig

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


def inline() -> list[tuple[str, str]]:
    """Return each page's code in the running text that sets a key of a tool, once a page."""
    found = dict.fromkeys(
        (page.name, code.replace("\\|", "|"))
        for page in PAGES
        for code in re.findall(r"`([^`\n]+)`", _FENCE.sub("", page.read_text(encoding="utf-8")))
    )
    return [(page, code) for page, code in found if re.match(r"(saunet [a-z]+ (\.\.\. )?)?[+~]?[a-z_@./]+=", code)]


def tools(page: str) -> list[str]:
    """Return the tools that a page names."""
    text = next(path for path in PAGES if path.name == page).read_text(encoding="utf-8")
    return list(dict.fromkeys(re.findall(r"\bsaunet ([a-z]+)", text)))


def lines(*kinds: str) -> list[tuple[str, str]]:
    """Return each line of such blocks, with its page; comments and line breaks removed, empty lines left out."""
    found = []
    for block in blocks(*kinds):
        for line in block.text.replace("\\\n", " ").splitlines():
            command = re.sub(r"\s+#.*", "", line).strip()
            if command:
                found.append((block.page, command))
    return found


def commands(*kinds: str) -> list[tuple[str, str]]:
    """Return each command of the project's tools in such blocks, with its page, whatever starts the tool.

    ``srun saunet train ...`` and ``torchrun ... -m saunet.cli.train ...`` are ``saunet train ...``. Lines after a
    prompt show what goes wrong.
    """
    found = []
    for page, line in lines(*kinds):
        plain = re.sub(r"-m saunet\.cli\.([a-z]+)", r"saunet \1", line)
        tool = re.search(r"(?:^|\s)(saunet [a-z]+(?:\s.*|$))", re.split(r"\s(?:\|\||&&|;|\|)\s", plain)[0])
        if tool and not line.startswith("$ "):
            found.append((page, tool[1]))
    return found


def mistakes(page: str) -> list[tuple[str, str]]:
    """Return each command that a page shows after a prompt, with the answer that it prints below."""
    shown = [line for where, line in lines("") if where == page]
    return [(line[2:], answer) for line, answer in itertools.pairwise(shown) if line.startswith("$ ")]


@functools.cache
def composed(tool: str, *choices: str) -> DictConfig:
    """Return a tool's configuration with some choices of groups; composing takes its time, so each is made once."""
    return compose(tool, overrides=list(choices), return_hydra_config=True)
