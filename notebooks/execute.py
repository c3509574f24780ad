"""Execute every notebook of this folder from a clean state, and fail where a cell fails; the files stay as they are."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient

FOLDER = Path(__file__).parent


def _bare(output: Any) -> bool:
    """Return whether an output is a number or the like that a last line left behind, and nothing to look at."""
    return output.output_type == "execute_result" and output.data.get("text/plain", "").lstrip("-").isdigit()


def main() -> None:
    notebooks = sorted(FOLDER.glob("*.ipynb"))
    if not notebooks:
        sys.exit(f"no notebooks in {FOLDER}")
    for path in notebooks:
        start = time.monotonic()
        notebook = nbformat.read(path, as_version=4)
        kept = [cell for cell in notebook.cells if cell.cell_type == "code" and (cell.outputs or cell.execution_count)]
        if kept:
            sys.exit(f"{path.name} holds outputs; strip them with nbstripout {path}")
        NotebookClient(notebook, timeout=900, kernel_name="python3", resources={"metadata": {"path": FOLDER}}).execute()
        cells = (cell for cell in notebook.cells if cell.cell_type == "code")
        if stray := [cell.source for cell in cells if any(map(_bare, cell.outputs))]:
            sys.exit(f"{path.name} shows a bare value below a cell that ends in: {stray[0].splitlines()[-1]}")
        if len(sys.argv) > 1:  # a folder to keep the executed notebooks in
            nbformat.write(notebook, Path(sys.argv[1]) / path.name)
        print(f"{path.name}: executed in {time.monotonic() - start:.0f} s")


if __name__ == "__main__":
    main()
