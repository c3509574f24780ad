"""Checkpoints that Lightning writes, whole or not at all: a full disk or a missing right spoils no earlier one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lightning.pytorch.plugins.io import TorchCheckpointIO

from saunet.checkpoint import atomic_save
from saunet.errors import ConfigError


class AtomicCheckpointIO(TorchCheckpointIO):
    """Lightning's own storage, but that every local file is complete or keeps its former content.

    Lightning's writer passes over a refused permission in silence, so a run could end without a checkpoint. Give it as
    ``Trainer(plugins=[AtomicCheckpointIO()])``. Addresses such as ``s3://...`` are left to Lightning.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any | None = None) -> None:
        """Write a checkpoint.

        Args:
            checkpoint: State of model and trainer.
            path: The file, or an address of a remote one.
            storage_options: None; there is nothing to choose.

        Raises:
            CheckpointError: if the system refuses; an older file of that name stays as it was.
            ConfigError: if there are storage options.
        """
        if storage_options is not None:
            raise ConfigError(
                f"storage_options is {storage_options!r}; checkpoints are stored without any, leave it out"
            )
        if "://" in str(path):
            super().save_checkpoint(checkpoint, path)
        else:
            atomic_save(checkpoint, path)
