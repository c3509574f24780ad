"""Several processes, started by ``torchrun``, that share the images of one evaluation."""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from torch import distributed

T = TypeVar("T")


@dataclass(frozen=True)
class Team:
    """The processes of an evaluation: this one's number and their count."""

    rank: int = 0
    size: int = 1

    @property
    def place(self) -> tuple[int, int] | None:
        """The argument for `DepthDataModule.batches`; None for a single process."""
        return (self.rank, self.size) if self.size > 1 else None

    def everyones(self, mine: T) -> list[T]:
        """Return each process's value, by its number; all processes must call this together."""
        if self.size == 1:
            return [mine]
        found: list[T | None] = [None] * self.size
        gather: Any = distributed.all_gather_object
        gather(found, mine)
        return found  # type: ignore[return-value]  # each was replaced

    def device(self, device: torch.device) -> torch.device:
        """Return this process's own GPU."""
        local = int(os.environ.get("LOCAL_RANK", self.rank))
        own = str(device) == "cuda" and self.size > 1  # "cuda:1" names one
        return torch.device("cuda", local % torch.cuda.device_count()) if own else device


ALONE = Team()


@contextlib.contextmanager
def joined() -> Iterator[Team]:
    """Join the processes started by ``torchrun``, if any; all but the first are silent."""
    size = int(os.environ.get("WORLD_SIZE", 1))
    if size == 1 or distributed.is_initialized():
        yield ALONE
        return
    distributed.init_process_group("gloo")
    try:
        rank = distributed.get_rank()
        with contextlib.redirect_stdout(io.StringIO()) if rank else contextlib.nullcontext():
            yield Team(rank, size)
    finally:
        distributed.destroy_process_group()
