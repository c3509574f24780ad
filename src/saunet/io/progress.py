"""The progress bar: on standard error, on a terminal or in a notebook only, gone when the work is done."""

from __future__ import annotations

from importlib.util import find_spec

from rich import progress
from rich.console import Console


def bar(show: bool = True, unit: str = "", taken: bool = False) -> progress.Progress:
    """Return a progress bar with counts and the time left; silent in a file or a pipe."""
    console = Console(stderr=True)
    columns: list[progress.ProgressColumn] = [progress.BarColumn(), progress.MofNCompleteColumn()]
    columns += [progress.TextColumn(unit)] if unit else []
    columns += [progress.TimeElapsedColumn()] if taken else []
    columns = [progress.TextColumn("{task.description}"), *columns, progress.TimeRemainingColumn()]
    return progress.Progress(*columns, console=console, disable=not (show and watched(console)), transient=True)


def watched(console: Console) -> bool:
    """Return whether somebody looks at a bar there: a terminal or a notebook, not a file or a pipe."""
    # In a notebook, rich draws with ipywidgets, and warns at every bar if it is missing.
    return console.is_terminal or (console.is_jupyter and find_spec("ipywidgets") is not None)
