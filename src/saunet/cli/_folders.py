"""Run folders that a failing command leaves as it found them: what was there before is the user's."""

from __future__ import annotations

import logging
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from saunet.runs.folder import FILE

HYDRA = ".hydra"


@dataclass(frozen=True)
class Folder:
    """A run's folder as it was before the run.

    Args:
        path: The folder.
        names: What it held; None if it did not exist.
        config: Files of its ``.hydra``, which Hydra writes over, with their content.
    """

    path: Path
    names: frozenset[str] | None
    config: dict[Path, bytes] = field(default_factory=dict)

    @classmethod
    def as_it_is(cls, path: Path) -> Folder:
        """Note what a folder holds now."""
        if not path.is_dir():
            return cls(path, None)
        config = {file: file.read_bytes() for file in (path / HYDRA).glob("*.yaml")}
        return cls(path, frozenset(each.name for each in path.iterdir()), config)

    def remove_traces(self, job: str) -> None:
        """Undo what a run did that never began: a new folder goes, in an older one only what the run made goes.

        Args:
            job: Name of the tool, and of its log.
        """
        if not self.path.is_dir() or not self._bare(job):
            return
        if self.names is None:
            logging.shutdown()
            shutil.rmtree(self.path, ignore_errors=True)
            for parent in self.path.parents:  # outputs/NAME and outputs, where nothing else is in them
                if Path.cwd() not in parent.parents or any(parent.iterdir()):
                    break
                parent.rmdir()
            return
        for file, content in self.config.items():
            file.write_bytes(content)
        if HYDRA not in self.names:
            shutil.rmtree(self.path / HYDRA, ignore_errors=True)
        if FILE not in self.names:
            (self.path / FILE).unlink(missing_ok=True)
        log = self.path / f"{job}.log"
        if log.name not in self.names and log.is_file() and log.stat().st_size == 0:
            log.unlink()

    def _bare(self, job: str) -> bool:
        """Tell whether all that is new are records of a run: its config, its log, the heads of its loggers' files."""
        started = ("hparams.yaml", "events.out.tfevents", FILE, f"{job}.log")
        new = [each for each in self.path.iterdir() if each.name not in (self.names or ())]
        files = [file for each in new for file in (each.rglob("*") if each.is_dir() else [each]) if not file.is_dir()]
        return all(file.name.startswith(started) or file.parent.name == HYDRA for file in files)


_noted: list[Folder] = []


class NoteFolder(Callback):
    """Note the folder of a single run before Hydra writes into it."""

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Note it; its name may refer to Hydra's own settings."""
        before = HydraConfig.instance().cfg
        HydraConfig.instance().set_config(config)
        try:
            _noted[:] = [Folder.as_it_is(Path(str(config.hydra.run.dir)).resolve())]
        finally:
            HydraConfig.instance().cfg = before


def noted() -> Folder | None:
    """Return the folder of this process's run as it was before, if it was noted, and forget it."""
    return _noted.pop() if _noted else None
