"""A trained model read from files: ``config.json`` says what to build, safetensors hold numbers and no code."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from saunet.errors import CheckpointError
from saunet.io.plain import read_json
from saunet.runs.checkpoint import Checkpoint, read_checkpoint
from saunet.runs.record import ModelRecord
from saunet.weights.foreign import read_foreign
from saunet.weights.locate import CONFIG, POSE, WEIGHTS, locate


def read_model(source: str | Path) -> Checkpoint:
    """Read a trained model into memory, without running any code from it.

    It is a checkpoint, a folder written by ``saunet export`` (or the safetensors file in it), the name of a shipped
    model, a hub id (see `saunet.weights.locate.locate`), or a model of another system (see `saunet.weights.foreign`).
    """
    path = locate(source)
    if path.is_dir() and (path / CONFIG).is_file() and not (path / WEIGHTS).is_file():
        raise CheckpointError(
            f"{path} has no {WEIGHTS}; export with formats=[safetensors,...], or give the exported file itself"
        )
    if path.is_dir() and (path / WEIGHTS).is_file():
        path = path / WEIGHTS
    if path.suffix != ".safetensors":
        return _of_any_system(path)
    if not path.is_file():
        raise CheckpointError(f"no model at {path}; check the path")
    return restored(path, read_config(path.with_name(CONFIG)))


def _of_any_system(path: Path) -> Checkpoint:
    try:
        return read_checkpoint(path)
    except CheckpointError:
        foreign = read_foreign(path) if path.exists() else None
        if foreign is None:
            raise
        return foreign


def restored(path: Path, record: ModelRecord) -> Checkpoint:
    """Return the weights of a safetensors file, and of a pose network's beside it, together with their record."""
    try:
        record.check_registered()
    except CheckpointError as error:
        raise CheckpointError(f"{path}: {error}") from error
    state = _read(path)
    pose = path.with_name(POSE)
    if record.pose is not None and pose.is_file() and not any(name.startswith("pose.") for name in state):
        state |= _read(pose)
    return Checkpoint(path, record, state, None, None)


def write_safetensors(state: Mapping[str, Tensor], path: str | Path) -> None:
    plain = {name: value.detach().cpu().contiguous() for name, value in state.items()}
    Path(path).write_bytes(save(plain, {"format": "pt"}))  # save_file would let its owner alone read the file


def read_config(path: Path) -> ModelRecord:
    """Read the record of an exported model."""
    try:
        return ModelRecord.from_plain(read_json(path))
    except OSError as reason:
        raise CheckpointError(f"cannot read {path}: {reason.strerror or reason}; it belongs to {WEIGHTS}") from reason
    except CheckpointError as error:
        raise CheckpointError(f"{path}: {error}") from error
    except ValueError as reason:
        raise CheckpointError(f"{path} is not JSON ({reason}); export the model again") from reason


def _read(path: Path) -> dict[str, Tensor]:
    try:
        return dict(load_file(path))
    except SafetensorError as reason:
        raise CheckpointError(f"{path} is damaged or truncated and cannot be read; copy it again") from reason
    except OSError as reason:
        raise CheckpointError(f"cannot read {path}: {reason.strerror or reason}") from reason
