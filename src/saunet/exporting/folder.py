"""An exported folder read back: ``config.json`` says what to build, ``model.safetensors`` holds numbers and no code."""

from __future__ import annotations

import json
from pathlib import Path

from saunet.errors import CheckpointError, ConfigError
from saunet.runs.checkpoint import Checkpoint, read_checkpoint
from saunet.runs.record import ModelRecord

CONFIG, WEIGHTS = "config.json", "model.safetensors"


def read_model(path: str | Path) -> Checkpoint:
    """Read a trained model into memory, without running anything from it.

    Args:
        path: A checkpoint, or a folder written by ``saunet-export`` (or the safetensors file in it).

    Raises:
        CheckpointError: if it is missing, broken, not a saunet model, or names a component that is not registered.
        ConfigError: if the package safetensors is missing.
    """
    path = Path(path)
    if path.is_dir() and (path / CONFIG).is_file() and not (path / WEIGHTS).is_file():
        raise CheckpointError(
            f"{path} has no {WEIGHTS}; export with formats=[safetensors,...], or give the exported file itself"
        )
    if path.is_dir() and (path / WEIGHTS).is_file():
        path = path / WEIGHTS
    if path.suffix != ".safetensors":
        return read_checkpoint(path)
    if not path.is_file():
        raise CheckpointError(f"no model at {path}; check the path")
    return restored(path, read_config(path.with_name(CONFIG)))


def restored(path: Path, record: ModelRecord) -> Checkpoint:
    """Return the weights of a safetensors file together with their record.

    Raises:
        CheckpointError: if the file is broken or the record names a component that is not registered.
        ConfigError: if the package safetensors is missing.
    """
    try:
        from safetensors import SafetensorError
        from safetensors.torch import load_file
    except ImportError as missing:
        raise ConfigError("reading safetensors needs the package; run: pip install 'saunet[export]'") from missing
    try:
        record.check_registered()
    except CheckpointError as error:
        raise CheckpointError(f"{path}: {error}") from error
    try:
        return Checkpoint(path, record, load_file(path), None, None)
    except SafetensorError as reason:
        raise CheckpointError(f"{path} is damaged or truncated and cannot be read; copy it again") from reason
    except OSError as reason:
        raise CheckpointError(f"cannot read {path}: {reason.strerror or reason}") from reason


def read_config(path: Path) -> ModelRecord:
    """Read the record of an exported folder.

    Raises:
        CheckpointError: if it is missing or not one.
    """
    try:
        return ModelRecord.from_plain(json.loads(path.read_text(encoding="utf-8")))
    except OSError as reason:
        raise CheckpointError(f"cannot read {path}: {reason.strerror or reason}; it belongs to {WEIGHTS}") from reason
    except CheckpointError as error:
        raise CheckpointError(f"{path}: {error}") from error
    except ValueError as reason:
        raise CheckpointError(f"{path} is not JSON ({reason}); export the model again") from reason
