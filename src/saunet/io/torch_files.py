"""The one reader of what ``torch.save`` wrote, for checkpoints and public weights; nothing in a file is ever run."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import torch

from saunet.errors import CheckpointError


def read_plain(path: Path, what: str) -> Any:
    """Return what a file holds, on the CPU: plain containers, numbers, text and tensors."""
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except MemoryError:
        raise
    except pickle.UnpicklingError as reason:
        if any(mark in str(reason) for mark in ("GLOBAL", "Unsupported class", "Trying to")):
            raise CheckpointError(
                f"{path} holds pickled objects, which could run code when read, so it is refused; "
                "save plain containers and tensors only, as saunet train does"
            ) from reason
        raise CheckpointError(f"{path} is not {what}, or is damaged; copy it again") from reason
    except OSError as reason:
        raise CheckpointError(f"cannot read {path}: {reason.strerror or reason}") from reason
    except Exception as reason:  # the unpickler trusts what it reads: a broken file can raise anything
        raise CheckpointError(f"{path} is damaged or truncated and cannot be read; copy it again") from reason
