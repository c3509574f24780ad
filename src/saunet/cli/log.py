"""Messages other than results: to the terminal, and with the time to a file in the run's folder."""

from __future__ import annotations

import logging
import os
import sys
import warnings
from pathlib import Path
from typing import Any

from saunet.io.said import PRINTED


class RunLog(logging.FileHandler):
    """A log in a run's folder, held back in memory until the tool writes its first file there.

    It keeps what goes through loggers, and what is printed with `saunet.io.said`. A refused command leaves neither a
    folder nor a line in the log of an earlier run. Each further process of a run has its own file.
    """

    def __init__(self, filename: str) -> None:
        path, rank = Path(filename), os.environ.get("LOCAL_RANK", "0")
        super().__init__(path if rank == "0" else path.with_stem(f"{path.stem}_rank{rank}"), delay=True)
        self._early: list[logging.LogRecord] = []
        self._before = self._changed() if rank == "0" else None  # the first process has started the others
        PRINTED.addHandler(self)

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record, once the tool has written to the folder."""
        self._early.append(record)
        self._write()

    def close(self) -> None:
        """Write the messages still held back: a tool may log nothing more after its first file."""
        PRINTED.removeHandler(self)
        self._write()
        super().close()

    def _write(self) -> None:
        if self.stream is not None or self._changed() not in (None, self._before):  # None: the folder was removed
            early, self._early = self._early, []
            for each in early:
                super().emit(each)

    def _changed(self) -> int | None:
        """Return when a file was last created or renamed in the folder; None while there is no folder."""
        folder = Path(self.baseFilename).parent
        return folder.stat().st_mtime_ns if folder.is_dir() else None


def _no_advertisement(record: logging.LogRecord) -> bool:
    return not record.getMessage().startswith(("💡", "TPU available", "Loading `train_dataloader` to estimate"))


_with_place = warnings.formatwarning


def _one_line(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None
) -> str:
    """Return one of our warnings without its location in the code, which tells the user of a command nothing."""
    if "saunet" in filename and issubclass(category, UserWarning):
        return f"warning: {message}\n"
    return _with_place(message, category, filename, lineno, line)


def _keep_warnings() -> None:
    """Let the log of a run keep the warnings too, which Python writes past all loggers."""
    shown = warnings.showwarning
    if getattr(shown, "kept", False):
        return

    def show(*words: Any, **named: Any) -> None:
        shown(*words, **named)
        PRINTED.info(warnings.formatwarning(*words[:4]).rstrip())

    show.kept = True  # type: ignore[attr-defined]
    warnings.showwarning = show


def quiet() -> None:
    """Send Lightning's messages, once it is imported, through our loggers, and only those that concern the user."""
    warnings.formatwarning = _one_line
    _keep_warnings()
    if "lightning.pytorch.utilities.rank_zero" in sys.modules:
        for name in ("lightning", "lightning.pytorch", "lightning.fabric"):
            logging.getLogger(name).handlers.clear()
            logging.getLogger(name).propagate = True
        for name in ("lightning.pytorch.utilities.rank_zero", "lightning.fabric.utilities.rank_zero"):
            logging.getLogger(name).addFilter(_no_advertisement)
    warnings.filterwarnings("ignore", message=r".*LeafSpec.*")
    warnings.filterwarnings("ignore", message=r".*does not have many workers.*")
    warnings.filterwarnings("ignore", message=r"Checkpoint directory .* exists and is not empty")  # we look ourselves
