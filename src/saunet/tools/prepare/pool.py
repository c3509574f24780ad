"""Many small pieces of work over several processes, with a progress bar, that ends cleanly however it ends."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Any, Generic, Literal, TypeVar

import cv2
import torch

from saunet.errors import DataError
from saunet.io.progress import bar

Item = TypeVar("Item")
Result = TypeVar("Result")
OnError = Literal["raise", "skip"]


@dataclass(frozen=True, slots=True)
class Done:
    """What a preparation of depth maps did."""

    made: int
    """Frames worked on now."""
    before: int
    """Frames that were finished before."""
    without: int | None
    """Frames that lack a scan; None where none is needed."""
    failures: tuple[str, ...]
    """One sentence for each frame that was skipped because a file is broken."""

    def __str__(self) -> str:
        scans = "" if self.without is None else f" {self.without} have no scan,"
        return f"{self.made} frames made, {self.before} were there,{scans} {len(self.failures)} skipped"


class Work(Generic[Item, Result]):
    """What to do with each item; the function is sent to every process once, so that items can be small.

    With ``on_error="skip"`` an item's `DataError` becomes a sentence in ``failures``. No workers: in this process.
    """

    def __init__(self, function: Callable[[Item], Result], workers: int = 0, on_error: OnError = "raise") -> None:
        self.function, self.workers, self.on_error = function, workers, on_error
        self.failures: list[str] = []

    def run(self, items: Sequence[Item], title: str) -> Iterator[tuple[Item, Result]]:
        """Yield each item with its result, in the order in which they are done."""
        with bar() as shown:
            task = shown.add_task(title, total=len(items))
            for item, outcome in self._outcomes(items):
                shown.advance(task)
                if isinstance(outcome, DataError):
                    if self.on_error == "raise":
                        raise outcome
                    self.failures.append(str(outcome))
                else:
                    yield item, outcome

    def _outcomes(self, items: Sequence[Item]) -> Iterator[tuple[Item, Result | DataError]]:
        if self.workers == 0 or len(items) < 2:
            for item in items:
                yield item, _attempt(self.function, item)
            return
        # Fresh processes, not forks: forking a process in which libraries have started threads can hang.
        count, context = min(self.workers, len(items)), multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(count, context, _begin, (self.function,))
        try:
            waiting = {pool.submit(_work, item): item for item in items}
            for future in as_completed(list(waiting)):
                yield waiting.pop(future), future.result()
        except BrokenProcessPool as reason:
            raise DataError(
                f"one of the {count} processes was killed, most often for want of memory; run again with fewer workers"
            ) from reason
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


_function: Callable[[Any], Any] | None = None


def _begin(function: Callable[[Any], Any]) -> None:
    """Make a process ready: one thread, deaf to Ctrl-C (its parent listens), and gone when its parent is gone."""
    global _function
    _function = function
    torch.set_num_threads(1)
    cv2.setNumThreads(0)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_follow_parent, daemon=True).start()


def _follow_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _work(item: Any) -> Any:
    assert _function is not None  # _begin ran first
    return _attempt(_function, item)


def _attempt(function: Callable[[Item], Result], item: Item) -> Result | DataError:
    try:
        return function(item)
    except DataError as error:
        return error
