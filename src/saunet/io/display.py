"""Showing a result: in the notebook, or as a page in the browser."""

from __future__ import annotations

import tempfile
import webbrowser
from collections.abc import Callable
from pathlib import Path

from rich.console import Console


def display(result: object, page: Callable[[], str]) -> None:
    """Display a result in a notebook by its own representation; elsewhere open its page in the browser."""
    if Console().is_jupyter:
        from IPython.display import display as shown

        shown(result)  # type: ignore[no-untyped-call]
        return
    path = Path(tempfile.mkdtemp(prefix="saunet-")) / "shown.html"  # the browser reads it after this process has ended
    path.write_text(page(), encoding="utf-8")
    if not webbrowser.open(path.as_uri()):
        print(f"no browser was found; open {path}")


def iframe(page: str, title: str, height: int) -> str:
    """Return a whole page as an element of another one, with a world of its own."""
    import html

    return (
        f'<iframe title="{html.escape(title)}" sandbox="allow-scripts" srcdoc="{html.escape(page)}" '
        f'style="width: 100%; height: {height}px; border: 0"></iframe>'
    )
